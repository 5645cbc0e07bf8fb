"""Make a trained model one of the shipped ones: choose its removal threshold, store and export it.

    python -m benchmarks.release.ship out/run/model.safetensors default
    python -m benchmarks.release.ship out/other/model.safetensors m --half

`clean` is run on demo rooms that are used for nothing else (the demo shows room 0), at every candidate. The
largest one that keeps the wanted share of the surface, mean over the rooms, goes into the manifest. How the
thresholds of single cubes differ from it: `clean` has the last word on pieces, pores and skirts of surfaces. A model
that takes support and crossings gets the room's cameras and simulated sparse points; one that takes view counts alone
does without cameras here.

With `--calibrate`, folders of harvested shards that were not trained on, the network's last layer is changed so that
``(x0_pred + 1) / 2`` is the probability that an opaque voxel is surface (`calibration.py`), and the threshold must keep
the wanted share of the surface there, too (`--kept-harvest`).

Writes NAME.safetensors and NAME.onnx among the weights, and the candidates' scores into ``threshold_NAME.json``.
"""

from __future__ import annotations

import dataclasses
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import tyro

from unghost import load_denoiser
from unghost.cleaning.pipeline import clean
from unghost.core.channels import SUPPORT
from unghost.core.results import build_results, write_results
from unghost.demo.run import score
from unghost.denoisers import WEIGHTS
from unghost.export.onnx.quantization import export_precisions
from unghost.fields.adapters.grids import cell_centers, grid_density_fn
from unghost.prior.checkpoint import load_model, save_model
from unghost.prior.networks.restoration import RestorationNet
from unghost.scenes.labelled_room.observations import room_cameras, room_points
from unghost.scenes.labelled_room.room import AABB, SHAPE, Room, build_room

from ..options import NOT_GIVEN, SHORT_RESULTS, BenchmarkOptions, give_up, parse
from ..progress import say, wrote
from .calibration import bake, calibration_error, fit_platt, judged_voxels, kept_and_removed

CANDIDATES = (-0.98, -0.95, *(tenth / 10 for tenth in range(-9, 10)))


@dataclass(frozen=True)
class Options(BenchmarkOptions):
    """What to ship, and what to choose from.

    Attributes:
        checkpoint: a model.safetensors of ``unghost train``.
        name: of the shipped model: NAME.safetensors, NAME.onnx.
        half: store the weights in half precision; the model computes in float32 all the same.
        rooms: seeds of the rooms.
        kept: share of the surface that must stay.
        candidates: thresholds to try at most, of those from -.98 up to .9.
        calibrate: folders of harvested shards to calibrate on; none for no calibration.
        kept_harvest: share of the surface that must stay there.
        cubes: of each shard.
        weights: where the shipped models are.
    """

    SHORT: ClassVar[dict[str, Any]] = {
        "checkpoint": WEIGHTS / "xs.safetensors",
        "name": "xs",
        "rooms": (10,),
        "candidates": 2,
        "weights": SHORT_RESULTS / "weights",
    }
    DATA: ClassVar[dict[str, str]] = {"checkpoint": "a model.safetensors of `unghost train`, and a NAME"}

    checkpoint: tyro.conf.Positional[Path] = NOT_GIVEN
    name: tyro.conf.Positional[str] = ""
    half: bool = False
    rooms: tuple[int, ...] = (10, 11, 12, 13)
    kept: float = 0.985
    candidates: int = len(CANDIDATES)
    calibrate: tuple[Path, ...] = ()
    kept_harvest: float = 0.97
    cubes: int = 96
    weights: Path = WEIGHTS


class _Advising:
    """A denoiser with another threshold in its manifest."""

    def __init__(self, denoiser: Any, threshold: float) -> None:
        self.kind, self._denoiser = denoiser.kind, denoiser
        self.manifest = dataclasses.replace(denoiser.manifest, removal_threshold=threshold)

    def __call__(self, channels: Any, timestep: Any, edge_fraction: Any) -> Any:
        """See ``core.manifest.Denoiser``."""
        return self._denoiser(channels, timestep, edge_fraction)


def observed(room: Room, seed: int) -> dict[str, Any]:
    """Cameras in a room, and its sparse points."""
    cameras = room_cameras(room, seed=seed)
    return {"cameras": cameras, "points": room_points(room, cameras, seed=seed)}


def row_of(denoiser: Any, threshold: float, rooms: tuple[int, ...]) -> dict[str, Any]:
    """Mean scores of ``clean`` at ``threshold``."""
    advised = _Advising(denoiser, threshold)
    found = []
    for seed in rooms:
        room = build_room(seed)
        known = observed(room, seed) if SUPPORT in denoiser.manifest.channels else {}
        mask = clean(grid_density_fn(room.density, AABB), AABB, denoiser=advised, field_pitch=room.pitch, **known)
        found.append(score(room, np.asarray(mask.keep(cell_centers(AABB, SHAPE)))))
    keys = ("floater_recall", "floater_precision", "surface_kept", "iou_before", "iou")
    means: dict[str, float | None] = {}
    for key in keys:
        values = [scores[key] for scores in found if scores[key] is not None]  # no precision where nothing is removed
        means[key] = float(np.mean(values)) if values else None
    return {"method": "clean", "threshold": threshold, **means}


def choose(denoiser: Any, options: Options) -> tuple[float, list[dict[str, Any]]]:
    """The threshold, and a row for each candidate up to the first that keeps too little."""
    rows: list[dict[str, Any]] = []
    for threshold in CANDIDATES[: options.candidates]:
        rows.append(row_of(denoiser, threshold, options.rooms))
        say(" ".join(f"{k}={v:.3f}" if isinstance(v, float) else v for k, v in rows[-1].items()))
        if rows[-1]["surface_kept"] < options.kept:
            break
    good = [row["threshold"] for row in rows if row["surface_kept"] >= options.kept]
    if not good:
        raise SystemExit(f"no candidate keeps {options.kept} of the surface; nothing is written")
    return max(good), rows


def calibrated(options: Options) -> tuple[Any, dict[str, Any], list[dict[str, Any]]]:
    """The model with its last layer calibrated, what to note of it, and what each candidate keeps of the cubes."""
    model = load_model(options.checkpoint)
    if not options.calibrate:
        return model, {}, []
    if not isinstance(model.network, RestorationNet):
        raise SystemExit("ship: --calibrate is for restoration priors; nothing is written")
    timestep = model.manifest.default_timestep
    logits, surface = judged_voxels(model.network, options.calibrate, timestep=timestep, cubes=options.cubes)
    scale, shift = fit_platt(logits, surface)
    bake(model.network, scale, shift)
    stated = scale * logits + shift
    note = {
        "scale": scale,
        "shift": shift,
        "voxels": len(logits),
        "shards": [folder.name for folder in options.calibrate],
        "error_before": calibration_error(logits, surface),
        "error": calibration_error(stated, surface),
    }
    rows = []
    for threshold in CANDIDATES:
        kept, removed = kept_and_removed(stated, surface, threshold)
        rows.append({"method": "harvest", "threshold": threshold, "surface_kept": kept, "floater_recall": removed})
    return model, {"calibration": note}, rows


def written(options: Options, folder: Path, threshold: float, model: Any, about: dict[str, Any]) -> dict[str, Path]:
    """The two files of the model in ``folder``."""
    manifest = dataclasses.replace(
        model.manifest, removal_threshold=threshold, training={**model.manifest.training, **about}
    )
    checkpoint = folder / f"{options.name}.safetensors"
    save_model(checkpoint, model.network, manifest, half=options.half)
    precision = "fp16" if options.half else "fp32"
    exported = export_precisions(checkpoint, folder, precisions=(precision,))[precision]
    return {".safetensors": checkpoint, ".onnx": exported}


def record(options: Options, rows: list[dict[str, Any]]) -> None:
    """The candidates and their scores, one file a model."""
    results = build_results(rows, command=options.command(), seeds=options.rooms, kept=options.kept)
    write_results(options.out / f"threshold_{options.name}.json", results)


def ship(options: Options) -> None:
    """Calibrate, choose the threshold, write the files and the record."""
    options.weights.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch:
        model, about, harvested = calibrated(options)
        say(" ".join(f"{key}={value}" for key, value in about.get("calibration", {}).items()))
        threshold, rows = choose(load_denoiser(written(options, Path(scratch), 0.0, model, about)[".onnx"]), options)
        bearable = [row["threshold"] for row in harvested if row["surface_kept"] >= options.kept_harvest]
        if harvested:
            threshold = min(threshold, max(bearable, default=CANDIDATES[0]))
        rows += harvested
        for suffix, path in written(options, Path(scratch), threshold, model, about).items():
            (options.weights / f"{options.name}{suffix}").write_bytes(path.read_bytes())
    rows = [row | {"chosen": row["method"] == "clean" and row["threshold"] == threshold} for row in rows]
    record(options, rows)
    say(f"{options.name}: threshold {threshold:g}")
    files = [options.weights / f"{options.name}{suffix}" for suffix in (".safetensors", ".onnx")]
    wrote(*files, options.out / f"threshold_{options.name}.json")


def main() -> None:
    options = parse(Options, __doc__)
    if not options.name:
        give_up(Options, "needs NAME, the name of the shipped model")
    ship(options)


if __name__ == "__main__":
    main()
