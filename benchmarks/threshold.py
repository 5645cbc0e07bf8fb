"""Choose the removal threshold of a prior, and write it into its checkpoint.

    python benchmarks/threshold.py unghost/weights/default.safetensors

`clean` is run on demo rooms that are used for nothing else (the demo shows room 0), at every candidate. The
largest one that keeps the wanted share of the surface, mean over the rooms, goes into the manifest. How the
thresholds of single cubes differ from it: `clean` has the last word on pieces, pores and skirts of surfaces.
Writes ``threshold.json`` and the checkpoint; export it anew afterwards.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from unghost import load_denoiser
from unghost.core.results import build_results, write_results
from unghost.demo import score
from unghost.demo_room import AABB, SHAPE, build_room
from unghost.grids import cell_centers, grid_density_fn
from unghost.prior.checkpoint import load_model, save_model
from unghost.regularizer.clean import clean

ROOT = Path(__file__).resolve().parents[1]
CANDIDATES = tuple(tenth / 10 for tenth in range(-4, 10))


@dataclass(frozen=True)
class Options:
    """What to choose, and from what.

    Attributes:
        checkpoint: a .safetensors file; rewritten with the threshold.
        denoiser: the same model for running it (ONNX is quicker).
        rooms: seeds of the rooms.
        kept: share of the surface that must stay.
        out: where threshold.json goes.
    """

    checkpoint: tyro.conf.Positional[Path]
    denoiser: str = "default"
    rooms: tuple[int, ...] = (10, 11, 12, 13)
    kept: float = 0.985
    out: Path = ROOT / "docs" / "results"


def row_of(denoiser: Any, threshold: float, rooms: tuple[int, ...]) -> dict[str, Any]:
    """Mean scores of ``clean`` at ``threshold``."""
    advised = _Advising(denoiser, threshold)
    found = []
    for seed in rooms:
        room = build_room(seed)
        mask = clean(grid_density_fn(room.density, AABB), AABB, denoiser=advised, field_pitch=room.pitch)
        found.append(score(room, np.asarray(mask.keep(cell_centers(AABB, SHAPE)))))
    keys = ("floater_recall", "floater_precision", "surface_kept", "iou_before", "iou")
    return {"method": "clean", "threshold": threshold, **{k: float(np.mean([s[k] for s in found])) for k in keys}}


class _Advising:
    """A denoiser with another threshold in its manifest."""

    def __init__(self, denoiser: Any, threshold: float) -> None:
        self.kind, self._denoiser = denoiser.kind, denoiser
        self.manifest = dataclasses.replace(denoiser.manifest, removal_threshold=threshold)

    def __call__(self, channels: Any, timestep: Any, edge_fraction: Any) -> Any:
        """See ``core.manifest.Denoiser``."""
        return self._denoiser(channels, timestep, edge_fraction)


def main() -> None:
    options = tyro.cli(Options, description=__doc__)
    denoiser = load_denoiser(options.denoiser)
    rows: list[dict[str, Any]] = []
    for threshold in CANDIDATES:
        rows.append(row_of(denoiser, threshold, options.rooms))
        print(" ".join(f"{k}={v:.3f}" if isinstance(v, float) else v for k, v in rows[-1].items()), flush=True)
        if rows[-1]["surface_kept"] < options.kept:
            break
    good = [row["threshold"] for row in rows if row["surface_kept"] >= options.kept]
    if not good:
        raise SystemExit(f"no candidate keeps {options.kept} of the surface; the checkpoint is as it was")
    model = load_model(options.checkpoint)
    save_model(
        options.checkpoint, model.network, dataclasses.replace(model.manifest, removal_threshold=max(good))
    )  # fmt: skip
    command = f"python benchmarks/threshold.py {options.checkpoint.name} --kept {options.kept:g}"
    results = build_results(
        rows, command=command, seeds=options.rooms, chosen=max(good), prior=denoiser.manifest.body_sha256
    )
    write_results(options.out / "threshold.json", results)
    print(f"threshold {max(good):g} written to {options.checkpoint.name}")


if __name__ == "__main__":
    main()
