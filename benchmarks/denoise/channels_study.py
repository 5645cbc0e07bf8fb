"""What should the network see? The same network, data, steps and seed, with more and more channels; one table.

    python -m benchmarks.denoise.channels_study out/procedural=.25 out/meshes=.25 out/harvest=.5 --runs out/channels \\
        --meshes MESHES --harvest out/harvest-val --unseen out/harvest-mlp --capture CAPTURE

A bit (opacity over .1), the opacity, then surroundings, view counts and transmittance on top. Each is trained from
scratch and scored on the sets of ``run.py``; what has optional channels is scored once more with all of them
unknown (``blind``). Training resumes where it was killed. Writes docs/results/channels.json.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import tyro

from unghost import load_denoiser
from unghost.core.channels import CHANNEL_NAMES, SIGNED_OPACITY, SURROUNDINGS, TRANSMITTANCE, VIEW_COUNT
from unghost.core.occupancy import DEFAULT_OPACITY_THRESHOLD, opacity_from_signed, signed_from_occupancy
from unghost.core.results import build_results
from unghost.core.shards.finding import expand_shards
from unghost.core.shards.packing import dequantize_signed, quantize_signed
from unghost.core.shards.storage import Shard, read_shard, write_shard
from unghost.prior.networks.restoration import SIZES
from unghost.prior.training.config import TrainConfig
from unghost.prior.training.loop import train

from ..compact import rounded, write_lines
from ..options import (
    CAPTURE,
    HARVEST,
    MESHES,
    NOT_GIVEN,
    ROOT,
    SAMPLE,
    SHARDS,
    SHORT_RESULTS,
    BenchmarkOptions,
    parse,
)
from ..progress import Plan, say, wrote
from .run import Options as Measurement
from .run import all_sets, mean_over_severities, row_of
from .sets import MIXED, CubeSet, blind

FOG = ("harvest", "harvest-unseen-field", "capture")
BIT = "a bit"
VARIANTS: dict[str, tuple[str, ...]] = {
    BIT: (SIGNED_OPACITY,),
    "opacity": (SIGNED_OPACITY,),
    "opacity, surroundings": (SIGNED_OPACITY, SURROUNDINGS),
    "opacity, surroundings, views": (SIGNED_OPACITY, SURROUNDINGS, VIEW_COUNT),
    "opacity, views": (SIGNED_OPACITY, VIEW_COUNT),
    "opacity, views, transmittance": (SIGNED_OPACITY, VIEW_COUNT, TRANSMITTANCE),
    "opacity, surroundings, views, transmittance": CHANNEL_NAMES,
}


@dataclass(frozen=True)
class Options(BenchmarkOptions):
    """What to train on and to measure.

    Attributes:
        shards: FOLDER or FOLDER=WEIGHT, as ``unghost train`` takes them.
        runs: folder of the runs, one a variant.
        meshes: folder of meshes with a manifest.csv.
        harvest: folder of harvested shards of scenes that are not trained on.
        unseen: the same of a kind of field that is not trained on.
        capture: folder of a real capture.
        steps: of each run.
        batch_size: cubes a step.
        size: of the network: xs, s, m or l.
        seed: of the weights and of the stream of samples.
        cubes: of each set.
        cache: where the capture's fields and cubes are kept.
    """

    SHORT: ClassVar[dict[str, Any]] = {
        "shards": (str(SAMPLE),),
        "runs": SHORT_RESULTS / "channels",
        "harvest": SAMPLE,
        "steps": 2,
        "batch_size": 4,
        "size": "xs",
        "cubes": 6,
    }
    DATA: ClassVar[dict[str, str]] = {
        "shards": SHARDS,
        "meshes": MESHES,
        "harvest": HARVEST,
        "unseen": HARVEST,
        "capture": CAPTURE,
    }
    SHORT_WITHOUT: ClassVar[tuple[str, ...]] = ("meshes",)

    shards: tyro.conf.Positional[tuple[str, ...]] = ()
    meshes: Path = NOT_GIVEN
    runs: Path = ROOT / "out" / "channels"
    harvest: Path | None = None
    unseen: Path | None = None
    capture: Path | None = None
    steps: int = 2500
    batch_size: int = 48
    size: str = "s"
    seed: int = 0
    cubes: int = 200
    cache: Path = ROOT / "out" / "capture"


def as_bits(signed: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Signed opacity to -1 or +1 by the opacity threshold."""
    bits: np.ndarray[Any, Any] = signed_from_occupancy(opacity_from_signed(signed) > DEFAULT_OPACITY_THRESHOLD)
    return bits


def bit_shards(shards: Iterable[tuple[str | Path, float]], folder: Path) -> list[tuple[str | Path, float]]:
    """The same shards with inputs made bits, and with nothing about the cubes."""
    made: list[tuple[str | Path, float]] = []
    for number, (source, weight) in enumerate(shards):
        target = folder / f"{number:05d}"
        if not (target / "manifest.json").exists():
            shard = read_shard(source)
            inputs = quantize_signed(as_bits(dequantize_signed(np.array(shard.inputs))))
            write_shard(target, {"inputs": inputs, **_untouched(shard)}, shard.provenance, kind=shard.kind)
        made.append((str(target), weight))
    return made


def _untouched(shard: Shard) -> dict[str, Any]:
    return {name: np.array(getattr(shard, name)) for name in ("labels", "severity", "edge_fraction", "group")}


def seen(cubes: CubeSet, variant: str) -> CubeSet:
    """The set as a variant is shown it; scores are of the original one."""
    return dataclasses.replace(cubes, signed=as_bits(cubes.signed)) if variant == BIT else cubes


def trained(variant: str, options: Options, shards: Sequence[tuple[str | Path, float]]) -> Path:
    """The model of a variant, trained unless it is there."""
    folder = options.runs / variant.replace(" ", "-").replace(",", "")
    model = folder / "model.safetensors"
    if options.short or not model.exists():
        network = dataclasses.replace(SIZES[options.size], channels=VARIANTS[variant])
        config = TrainConfig(
            name=f"study {variant}",
            network=network,
            steps=options.steps,
            batch_size=options.batch_size,
            seed=options.seed,
            threads=options.threads,
            validate_seconds=0.0,
        )
        used = bit_shards(shards, options.runs / "bits") if variant == BIT else shards
        train(config, train_shards=used, out=folder, resume=not options.short)
    return model


def rows_of(variant: str, model: Path, sets: Sequence[CubeSet]) -> list[dict[str, Any]]:
    """Scores of a variant, and of the same one blind."""
    denoiser = load_denoiser(model)
    about = {"channels": list(VARIANTS[variant]), "parameters": denoiser.manifest.parameters}
    ways: list[tuple[str, Callable[[CubeSet], CubeSet]]] = [(variant, lambda cubes: cubes)]
    if len(VARIANTS[variant]) > 1:
        ways.append((f"{variant}, blind", blind))
    rows: list[dict[str, Any]] = []
    for name, shown in ways:
        for cubes in sets:
            known = shown(cubes)
            row = row_of(name, denoiser, known, denoiser.manifest.default_timestep, seen=seen(known, variant))
            rows.append({**row, **about})
        rows.append({**mean_over_severities(rows, name), **about})
    return rows


def wanted_sets(options: Options) -> list[CubeSet]:
    """The sets of the reference measurement, single families of corruption aside."""
    measurement = Measurement(
        meshes=options.meshes,
        harvest=options.harvest,
        unseen=options.unseen,
        capture=options.capture,
        cubes=options.cubes,
        cache=options.cache,
        short=options.short,
    ).shortened()
    return [cubes for cubes in all_sets(measurement) if cubes.about.get("family", MIXED) == MIXED]


def main() -> None:
    options = parse(Options, __doc__)
    shards = [pair for spec in options.shards for pair in expand_shards(spec)]
    plan = Plan(["train"] * len(VARIANTS), {"train": 0.3 * options.steps})
    models = {}
    for variant in VARIANTS:
        plan.begin("train", f"{options.steps} steps with {variant}")
        models[variant] = trained(variant, options, shards)
    sets, rows = wanted_sets(options), list[dict[str, Any]]()
    for variant, model in models.items():
        rows += rows_of(variant, model, sets)
        fog = [
            f"{row['set']} {row['ghosts_removed_98']:.3f}"
            for row in rows
            if row["method"] == variant and row["set"] in FOG
        ]
        say(f"{variant:46s} {'  '.join(fog)}")
        write_lines(
            options.out / "channels.json",
            build_results(
                rounded(rows),
                command=options.command(),
                seeds=[options.seed],
                size=options.size,
                steps=options.steps,
                batch_size=options.batch_size,
            ),
        )
    wrote(options.out / "channels.json")


if __name__ == "__main__":
    main()
