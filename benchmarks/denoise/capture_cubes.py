"""Cubes of a real capture's field, labelled by a field that saw more: what a harvest cannot make, a prior must meet.

There is no truth of a real room. What stands for it is the *pseudo ground truth* of the protocol: a field fitted to the
training sweep and to others, seen from all of their photos. Its own fog must not count as truth, so labels are not its
opacity but what its depth maps say by a vote of the photos, in the words of ``data_recipes.harvest_labels``:

surface  two photos or more have their depth within three quarters of a cell there, and no more look through; and what
         is opaque up to four cells behind such depths, if no photo looks through
free     two photos or more look through, more than one and a half cells in front of their depth, and more than see a
         surface there; and a training photo looks there
ignore   the rest

The evidence in the cubes, support and crossings, is of points triangulated from the training sweep's photos alone.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import unghost.fields
from unghost.core.aabb import contains
from unghost.core.cameras import Cameras
from unghost.core.occupancy import FREE_LABEL, IGNORE_LABEL, SURFACE_LABEL
from unghost.core.shards.storage import write_shard
from unghost.data_recipes.harvest import labels as labels_module
from unghost.data_recipes.harvest import run as harvest_module
from unghost.data_recipes.harvest.config import HarvestConfig
from unghost.data_recipes.harvest.labels import BEHIND_BAND, FREE_BAND, SURFACE_BAND
from unghost.data_recipes.harvest.run import harvest_cubes
from unghost.evaluation.captures.loading import load_capture
from unghost.evaluation.captures.triangulation import triangulate
from unghost.evaluation.scoring.depths import optical_depth

from ..fit_cache import FitCache, code_hash, file_hash
from ..progress import say
from ..two_trajectory.real_capture import Options as CaptureOptions
from ..two_trajectory.real_capture import fit_field, render
from ..two_trajectory.scenes import Sweep

STEPS = 360  # of fitting a field, as in docs/results/capture.json
DOWNSCALE = 8.0  # photo pixels per pixel that it is fitted to
VOTES = 2
LOOSE = 0.004  # of the depth: what half a pixel is off on a slanted surface


@dataclass(frozen=True)
class PseudoTruth:
    """Labels by the depth maps of a better field.

    Attributes:
        cameras: of the training photos.
        aabb: ``(2, 3)``, outside of which nothing counts.
        all_cameras: ``n`` cameras of all photos that the better field saw.
        depth: ``(n, H, W)`` its depth along the optical axis of each, inf for nothing.
    """

    cameras: Cameras
    aabb: NDArray[np.float64]
    all_cameras: Cameras
    depth: NDArray[np.float64]

    def votes(self, points: NDArray[np.float64], pitch: float) -> NDArray[np.int64]:
        """How many photos say of ``points (N, 3)``: looked through, surface, just behind it: ``(3, N)``."""
        votes = np.zeros((3, len(points)), dtype=np.int64)
        for index in range(len(self.all_cameras)):
            pixels, depth, visible = self.all_cameras.project(index, points)
            rows = np.flatnonzero(visible)
            column, line = np.floor(pixels[rows]).astype(np.int64).T
            shape = self.depth.shape[1:]
            there = self.depth[index][np.clip(line, 0, shape[0] - 1), np.clip(column, 0, shape[1] - 1)]
            gap, loose = there - depth[rows], LOOSE * depth[rows]
            votes[0, rows] += gap > FREE_BAND * pitch + loose
            votes[1, rows] += np.abs(gap) <= SURFACE_BAND * pitch + loose
            votes[2, rows] += (-gap > SURFACE_BAND * pitch + loose) & (-gap <= BEHIND_BAND * pitch)
        return votes

    def labels(
        self, positions: NDArray[np.float64], field_pitch: float, opaque: NDArray[np.bool_], hidden: NDArray[np.bool_]
    ) -> NDArray[np.uint8]:
        """As ``data_recipes.harvest_labels.Labeller`` has it."""
        points = positions.reshape(-1, 3)
        through, surface, behind = self.votes(points, field_pitch).reshape(3, *positions.shape[:-1])
        counts = contains(self.aabb, positions)
        labels = np.full(counts.shape, IGNORE_LABEL, dtype=np.uint8)
        labels[counts & (through >= VOTES) & (through > surface)] = FREE_LABEL
        labels[counts & opaque & ~hidden & (behind >= VOTES) & (through == 0)] = SURFACE_LABEL
        labels[counts & (surface >= VOTES) & (surface >= through)] = SURFACE_LABEL
        return labels


def cubes_folder(cache: Path, cubes: int, steps: int = STEPS, downscale: float = DOWNSCALE) -> Path:
    """Where so many cubes a seed are kept, under the hash of the rules that cut and label them."""
    rules = "".join(file_hash(source)[:6] for source in (__file__, harvest_module.__file__, labels_module.__file__))
    fits = "" if (steps, downscale) == (STEPS, DOWNSCALE) else f"-{steps}-{downscale:g}"
    return cache / f"cubes-{cubes}{fits}-{rules}"


def capture_shards(
    capture: Path,
    out: Path,
    *,
    train: str,
    better: tuple[str, ...],
    cubes: int,
    seeds: tuple[int, ...],
    cache: Path,
    steps: int = STEPS,
    downscale: float = DOWNSCALE,
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
        steps: of fitting each.
        downscale: photo pixels per pixel that they are fitted to.
    """
    options = CaptureOptions(capture, train, better[0], steps=steps, downscale=downscale, cache=cache)
    loaded, fits = load_capture(capture, downscale=options.downscale), FitCache(cache)

    def sweep(*names: str) -> Sweep:
        chosen = np.concatenate([loaded.split(name) for name in names])
        return Sweep(loaded.cameras.select(chosen), loaded.images(chosen))

    say(f"pseudo ground truth: {', '.join((train, *better))}")
    both = sweep(train, *better)
    pseudo, record = fit_field(options, fits, "pseudo", both, 0)
    key = {"field": record["sha256"], "code": code_hash(unghost.fields), "photos": both.digest()}
    views = fits.views("pseudo-all", key, functools.partial(render, pseudo, both.cameras))
    truth = PseudoTruth(
        sweep(train).cameras, pseudo.aabb, both.cameras, optical_depth(np.asarray(views["depth"]), both.cameras)
    )
    targets = [out / f"seed-{seed}" for seed in seeds]
    points = None if all(target.exists() for target in targets) else triangulate(loaded, loaded.split(train))
    shards = []
    for seed in seeds:
        target = out / f"seed-{seed}"
        shards.append(target)
        if target.exists():
            continue
        say(f"field of {train}, seed {seed}")
        fitted, record = fit_field(options, fits, "field", sweep(train), seed)
        assert points is not None
        rng = np.random.default_rng([seed, 0xCA9])
        arrays = harvest_cubes(rng, fitted, truth, HarvestConfig(cubes=cubes), points=[points])
        arrays["group"] = np.full(cubes, seed, dtype=np.int32)
        provenance = {
            "recipe": "capture",
            "capture": capture.resolve().name,
            "train": train,
            "better": list(better),
            "seed": seed,
            "points": len(points),
            "field": "dense",
            "sha256": record["sha256"],
            "licence": "see the capture",
        }
        write_shard(target, arrays, provenance, kind="harvest")
    return shards
