"""Cubes of a real capture's field, labelled by a field that saw more: what a harvest cannot make, a prior must meet.

There is no truth of a real room. What stands for it is the *pseudo ground truth* of the protocol, a field fitted to
the training sweep and to another one: a voxel is true where that field is opaque, free where it is not, even one cell
around, and a training photo looks there. Everything else does not count.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from capture import Options as CaptureOptions
from capture import Sweep, fit_field
from fit_cache import FitCache, say
from numpy.typing import NDArray

from unghost.core.aabb import contains
from unghost.core.cameras import Cameras
from unghost.core.occupancy import (
    DEFAULT_OPACITY_THRESHOLD,
    FREE_LABEL,
    IGNORE_LABEL,
    SURFACE_LABEL,
    opacity_from_density,
)
from unghost.core.shards import write_shard
from unghost.data_recipes.harvest import harvest_cubes
from unghost.data_recipes.harvest_config import HarvestConfig
from unghost.evaluation.captures import load_capture
from unghost.fields.radiance import RadianceField

SURELY_EMPTY = 0.05  # opacity over one cell
STEPS = 360  # of fitting a field, as in docs/results/capture.json


@dataclass(frozen=True)
class PseudoTruth:
    """Labels by a better field.

    Attributes:
        better: fitted to more photos.
        cameras: of the training photos.
    """

    better: RadianceField
    cameras: Cameras
    offsets: NDArray[np.float64] = field(
        default_factory=lambda: np.array([o for o in itertools.product((-1, 0, 1), repeat=3) if np.abs(o).sum() == 1.0])
    )

    def _opacity(self, positions: NDArray[np.float64], pitch: float) -> NDArray[Any]:
        with torch.no_grad():
            density = self.better.density_fn(torch.from_numpy(positions.astype(np.float32)))[..., 0]
        opacity: NDArray[Any] = opacity_from_density(density.numpy(), pitch)
        return opacity

    def labels(
        self, positions: NDArray[np.float64], field_pitch: float, opaque: NDArray[np.bool_]
    ) -> NDArray[np.uint8]:
        """As ``data_recipes.harvest_labels.Labeller`` has it."""
        here = self._opacity(positions, field_pitch)
        about = np.maximum.reduce(
            [here, *(self._opacity(positions + field_pitch * o, field_pitch) for o in self.offsets)]
        )
        counts = contains(self.better.aabb, positions)
        counts &= self.cameras.view_count(positions.reshape(-1, 3)).reshape(counts.shape) > 0
        labels = np.full(counts.shape, IGNORE_LABEL, dtype=np.uint8)
        labels[counts & (about < SURELY_EMPTY)] = FREE_LABEL
        labels[counts & (here > DEFAULT_OPACITY_THRESHOLD)] = SURFACE_LABEL
        return labels


def capture_shards(
    capture: Path, out: Path, *, train: str, better: tuple[str, ...], cubes: int, seeds: tuple[int, ...], cache: Path
) -> list[Path]:
    """Cut cubes out of fields fitted to the sweep ``train``, one shard a seed.

    Args:
        capture: folder with transforms.json and splits.json.
        out: folder for the shards ``seed-0``, ...; those already there are kept.
        train: the sweep that the fields see.
        better: the sweeps that the labelling field sees besides.
        cubes: a seed.
        seeds: of fits and cubes.
        cache: where fitted fields are kept.
    """
    options = CaptureOptions(capture, train, better[0], steps=STEPS, cache=cache)
    loaded, fits = load_capture(capture, downscale=options.downscale), FitCache(cache)

    def sweep(*names: str) -> Sweep:
        chosen = np.concatenate([loaded.split(name) for name in names])
        return Sweep(loaded.cameras.select(chosen), loaded.images(chosen))

    say(f"pseudo ground truth: {', '.join((train, *better))}")
    truth = PseudoTruth(fit_field(options, fits, "pseudo", sweep(train, *better), 0)[0], sweep(train).cameras)
    shards = []
    for seed in seeds:
        target = out / f"seed-{seed}"
        shards.append(target)
        if target.exists():
            continue
        say(f"field of {train}, seed {seed}")
        fitted, record = fit_field(options, fits, "field", sweep(train), seed)
        arrays = harvest_cubes(np.random.default_rng([seed, 0xCA9]), fitted, truth, HarvestConfig(cubes=cubes))
        arrays["group"] = np.full(cubes, seed, dtype=np.int32)
        provenance = {
            "recipe": "capture", "capture": capture.resolve().name, "train": train, "better": list(better),
            "seed": seed, "field": "dense", "sha256": record["sha256"], "licence": "see the capture",
        }  # fmt: skip
        write_shard(target, arrays, provenance)
    return shards
