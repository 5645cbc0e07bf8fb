"""The verbs that make a prior of data: training, export. Heavy imports wait for the verb."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import Positional, UseAppendAction, arg

from ..core.errors import InvalidArgument, needs_extra
from ..core.shards.finding import expand_shards
from .options import given, options_of

with needs_extra("torch", caller="train"):
    from ..prior.training.config import TrainConfig

if TYPE_CHECKING:
    TrainOptions = TrainConfig
else:
    TrainOptions = options_of(TrainConfig, leave_out=("network",))

ONLINE_SEED = 1 << 32  # plus the run's seed: what is made online is in no shard


def _named_shards(specs: list[str]) -> dict[str, Path]:
    """``NAME=FOLDER`` to a table of validation shards."""
    table: dict[str, Path] = {}
    for spec in specs:
        name, separator, folder = spec.partition("=")
        if not (name and separator and folder):
            raise InvalidArgument(f"train: --validation must be NAME=FOLDER, got {spec!r}")
        found = expand_shards(folder)
        for path, _ in found:
            table[name if len(found) == 1 else f"{name}/{path.name}"] = path
    return table


def _online(specs: list[str], *, seed: int, workers: int, mesh_root: Path | None) -> list[Any]:
    """``RECIPE=SHARE`` to sources of pairs."""
    from ..data_recipes.online import OnlinePairs
    from ..data_recipes.recipe import load_recipe
    from ..prior.training.blend import Online

    sources = []
    for spec in specs:
        name, _, number = spec.rpartition("=")
        try:
            share = float(number)
        except ValueError:
            share = 0.0
        if not (name and 0.0 < share <= 1.0):
            raise InvalidArgument(f"train: --online must be RECIPE=SHARE, the share in (0, 1], got {spec!r}")
        pairs = OnlinePairs(load_recipe(name), seed=ONLINE_SEED + seed, workers=workers, mesh_root=mesh_root)
        sources.append(Online(Path(name).stem, share, pairs))
    return sources


def _configured(file: Path | None, size: str | None, channels: tuple[str, ...], given: dict[str, Any]) -> TrainConfig:
    """The configuration of a file, or the default one, with what the command line says in its place."""
    from ..core.io import read_json
    from ..prior.networks.restoration import SIZES, NetworkConfig

    base = TrainConfig() if file is None else TrainConfig.from_dict(read_json(file, caller="train"))
    if size is not None and size not in SIZES:
        raise InvalidArgument(f"train: --size must be one of {', '.join(SIZES)}, got {size!r}")
    network = base.network if size is None else dataclasses.replace(SIZES[size], channels=base.network.channels)
    if channels:
        if not isinstance(network, NetworkConfig):
            raise InvalidArgument(
                f"train: --channels needs a restoration network, --config has a {type(network).__name__}"
            )
        network = dataclasses.replace(network, channels=channels)
    said = {key: value for key, value in given.items() if value is not None}
    return dataclasses.replace(base, **said, network=network)


def train(
    shards: Positional[list[str]],
    out: Path,
    validation: UseAppendAction[list[str]] = [],  # noqa: B006 (tyro reads the default, nobody changes it)
    config: Path | None = None,
    channels: tuple[str, ...] = (),
    size: str | None = None,
    online: UseAppendAction[list[str]] = [],  # noqa: B006
    online_workers: int = 1,
    mesh_root: Path | None = None,
    resume: bool = False,
    options: Annotated[TrainOptions, arg(name="")] = TrainOptions(),  # noqa: B008 (frozen)
) -> None:
    """Train a restoration prior from shards; writes model.safetensors, logs and checkpoints.

    Args:
        shards: FOLDER or FOLDER=WEIGHT, a shard or a folder of shards.
        out: folder of the run.
        validation: NAME=FOLDER, held out; may be given several times.
        config: JSON of a TrainConfig (each run writes its own); the options of a TrainConfig override it.
        channels: what the network sees: signed_opacity, surroundings, view_count, transmittance; the first alone if
            not given.
        size: of the network: xs, s, m or l.
        online: RECIPE=SHARE, a recipe whose pairs are made while the network trains and fill that share of every
            batch; may be given several times. Its samples are those of a seed apart from all that curate is given.
        online_workers: processes that make them, each recipe's own.
        mesh_root: folder with the meshes and their manifest.csv, for recipes that read meshes.
        resume: go on where a killed run stopped.
    """
    from ..prior.training.allocator import keep_freed_memory
    from ..prior.training.loop import train as run

    keep_freed_memory()
    chosen = _configured(config, size, channels, given(options))
    result = run(
        chosen,
        train_shards=[pair for spec in shards for pair in expand_shards(spec)],
        validation_shards=_named_shards(validation),
        out=out,
        resume=resume,
        progress=True,
        online=_online(online, seed=chosen.seed, workers=online_workers, mesh_root=mesh_root),
    )
    if os.environ.get("RANK", "0") != "0":
        return  # one process of torchrun speaks for all
    print(f"{result.steps} steps in {result.seconds:.0f} s, ended by {result.reason}; model: {result.model}")
    for shard, row in result.validation.items():
        print(f"  {shard}: IoU {row['iou_before']} -> {row['iou']}")


def export(
    checkpoint: Positional[Path],
    out: Path | None = None,
    precision: tuple[Literal["fp32", "fp16", "int8"], ...] = (),
    calibration: str = "procedural",
    calibration_cubes: int = 96,
    seed: int = 0,
) -> None:
    """Write a trained prior as portable ONNX files, compared with torch before they appear.

    Args:
        checkpoint: a model.safetensors; with --precision also an fp32 .onnx.
        out: the file to write, or with --precision a folder for NAME.onnx, NAME.fp16.onnx and NAME.int8.onnx; beside
            the checkpoint if not given.
        precision: any of fp32, fp16 (weights stored in half precision) and int8; fp32 if not given.
        calibration: for int8, a shard, a folder of shards, or a recipe's name: cubes like those the prior will meet.
        calibration_cubes: how many of them.
        seed: of a recipe's cubes.
    """
    from ..calibration import calibration_for
    from ..export.onnx.quantization import export_precisions
    from ..export.onnx.to_onnx import export_onnx
    from ..export.runtime import read_manifest

    if precision:
        inputs = None
        if "int8" in precision:
            inputs = calibration_for(checkpoint, calibration, cubes=calibration_cubes, seed=seed)
        written = export_precisions(
            checkpoint,
            out or checkpoint.parent,
            precisions=precision,
            calibration=inputs,
            source=Path(calibration).name,
        )
        files = list(written.values())
    else:
        files = [out or checkpoint.with_suffix(".onnx")]
        export_onnx(checkpoint, files[0])
    for path in files:
        manifest = read_manifest(path)
        print(f"{path}: {path.stat().st_size / 1e6:.2f} MB, {manifest.parameters} parameters, {manifest.body_sha256}")


def verify(
    onnx: Path | None = None, checkpoint: Path | None = None, cubes: int = 256, seed: int = 0, out: Path | None = None
) -> int:
    """State how far an ONNX file is from its checkpoint in torch; exit status 1 if too far for its precision.

    Args:
        onnx: the exported file; the shipped one if not given.
        checkpoint: its model.safetensors; the shipped one if not given.
        cubes: how many to compare: empty, full, random and structured ones.
        seed: of the cubes.
        out: also write the result as JSON here.
    """
    from ..core.results import build_results, write_results
    from ..denoisers import WEIGHTS
    from ..export.onnx.parity import verify as run

    onnx, checkpoint = onnx or WEIGHTS / "default.onnx", checkpoint or WEIGHTS / "default.safetensors"
    report = run(onnx, checkpoint, cubes=cubes, seed=seed)
    print(
        f"{report['precision']}: max error {report['max_error']:.2e}, mean {report['mean_error']:.2e}, "
        f"occupancy flips {report['flip_rate']:.2e} of the voxels of {report['cubes']} cubes: "
        f"{'passed' if report['passed'] else 'FAILED'}"
    )
    if out is not None:
        write_results(out, build_results([{"method": "onnx", **report}], seeds=[seed]))
    return 0 if report["passed"] else 1
