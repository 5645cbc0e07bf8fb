"""Do training cubes look like those of a real capture's field? Statistics side by side, and one distance each.

    python -m benchmarks.data.harvest_statistics CAPTURE --train trajectory_1 --better trajectory_3 \
        --harvest out/harvest --unseen out/harvest-mlp

Sets: ``capture`` (fields of the capture, one a seed), ``harvest`` and its kinds of field, ``harvest-unseen-field`` (the
kind held out), the built-in recipes (``procedural`` as bits and as soft opacities, ``meshes`` if a folder is given),
``rooms``, and every family of corruption alone, on procedural cubes. The distance is that of
``unghost.data_recipes.inspection.statistics``: in [0, 1], over what a cube's *input* shows; agreement with the truth
stands beside it. Writes ``statistics.json`` and ``statistics.png``.
"""

from __future__ import annotations

import dataclasses
import itertools
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import tyro

from unghost.core.occupancy import signed_from_occupancy
from unghost.core.results import build_results, write_results
from unghost.core.shards.finding import find_shards
from unghost.core.shards.packing import quantize_signed
from unghost.core.shards.storage import read_shard
from unghost.data_recipes.corruptions.structured import CORRUPTIONS
from unghost.data_recipes.curation import curate
from unghost.data_recipes.harvest.config import HarvestConfig
from unghost.data_recipes.harvest.run import harvest
from unghost.data_recipes.inspection.statistics import (
    FEATURES,
    CubeStatistics,
    cube_statistics,
    feature_distances,
    sampling_floor,
    shard_statistics,
)
from unghost.data_recipes.pairs import make_chunk
from unghost.data_recipes.recipe import Recipe, load_recipe

from ..denoise.capture_cubes import STEPS, capture_shards, cubes_folder
from ..options import CAPTURE, HARVEST, MESHES, NOT_GIVEN, ROOT, SAMPLE, BenchmarkOptions, given, parse
from ..progress import say, wrote

SEED = 91


@dataclass(frozen=True)
class Options(BenchmarkOptions):
    """What to compare.

    Attributes:
        capture: folder of a real capture.
        harvest: folder of harvested shards.
        train: the sweep that the capture's fields see.
        better: the sweeps that its labelling field sees besides.
        unseen: folder of harvested shards of the kind of field that is held out.
        meshes: folder of meshes with a manifest.csv.
        cubes: measured of each set.
        seeds: of the capture's fields.
        rooms: scenes of the set ``rooms``.
        fit_steps: of the capture's fields.
        downscale: photo pixels per pixel that they are fitted to.
        cache: where fitted fields and the capture's cubes are kept.
    """

    SHORT: ClassVar[dict[str, Any]] = {
        "harvest": SAMPLE,
        "cubes": 12,
        "seeds": (0,),
        "rooms": 2,
        "fit_steps": 10,
        "downscale": 32,
    }
    DATA: ClassVar[dict[str, str]] = {"capture": CAPTURE, "harvest": HARVEST, "unseen": HARVEST, "meshes": MESHES}
    SHORT_WITHOUT: ClassVar[tuple[str, ...]] = ("capture",)

    capture: tyro.conf.Positional[Path] = NOT_GIVEN
    harvest: Path = NOT_GIVEN
    train: str = "trajectory_1"
    better: tuple[str, ...] = ("trajectory_3",)
    unseen: Path | None = None
    meshes: Path | None = None
    cubes: int = 600
    seeds: tuple[int, ...] = (0, 1, 2)
    rooms: int = 12
    fit_steps: int = STEPS
    downscale: float = 8
    cache: Path = ROOT / "out" / "capture"


def by_kind(folder: Path) -> dict[str, list[Path]]:
    """The shards of a harvest, by the kind of their field."""
    kinds: dict[str, list[Path]] = {}
    for path in find_shards(folder):
        kinds.setdefault(read_shard(path).provenance.get("field", "mixed"), []).append(path)
    return kinds


def corrupted(family: str, count: int) -> CubeStatistics:
    """Procedural cubes with one family of corruption at severities over (0, 1]."""
    recipe = dataclasses.replace(load_recipe("procedural"), clean_share=1.0, soft_share=0.0, empty_share=0.0)
    chunk = make_chunk(recipe, SEED, None, 0, count)
    inputs = np.empty(chunk.arrays["inputs"].shape, dtype=np.uint8)
    for row, stored in enumerate(chunk.arrays["inputs"]):
        rng = np.random.default_rng([SEED, row])
        damaged = CORRUPTIONS[family](rng, stored > 127, float(rng.uniform(0.02, 1.0)))
        inputs[row] = quantize_signed(signed_from_occupancy(damaged))
    return cube_statistics(inputs)


def synthetic_sets(options: Options, folder: Path) -> Iterator[tuple[str, CubeStatistics]]:
    """Recipes and rooms, made here."""
    base = load_recipe("procedural")
    wanted: list[tuple[str, Recipe]] = [
        ("procedural, bits", dataclasses.replace(base, soft_share=0.0)),
        ("procedural, soft", dataclasses.replace(base, soft_share=1.0)),
    ]
    wanted += [("meshes", load_recipe("meshes"))] if options.meshes else []
    for number, (name, recipe) in enumerate(wanted):
        root = options.meshes if recipe.source == "meshes" else None
        shards = curate(recipe, folder / str(number), count=options.cubes, seed=SEED, mesh_root=root)
        yield name, shard_statistics(shards, most=None)
    each = HarvestConfig(cubes=-(-options.cubes // options.rooms))
    harvest(folder / "rooms", scenes=options.rooms, seed=SEED, fit=False, config=each, mesh_root=options.meshes)
    yield "rooms", shard_statistics(find_shards(folder / "rooms"), most=options.cubes)
    for family in CORRUPTIONS:
        yield f"corruption {family}", corrupted(family, options.cubes)


def cut_shards(options: Options) -> list[Path]:
    """Shards of the capture's fields."""
    each = -(-options.cubes // len(options.seeds))
    return capture_shards(
        options.capture,
        cubes_folder(options.cache, each, options.fit_steps, options.downscale),
        train=options.train,
        better=options.better,
        cubes=each,
        seeds=options.seeds,
        cache=options.cache,
        steps=options.fit_steps,
        downscale=options.downscale,
    )


def all_sets(options: Options, folder: Path) -> Iterator[tuple[str, CubeStatistics]]:
    """The capture's first, if one is given."""
    if given(options.capture):
        yield "capture", shard_statistics(cut_shards(options), most=options.cubes)
    kinds = by_kind(options.harvest)
    yield "harvest", shard_statistics(list(itertools.chain(*kinds.values())), most=options.cubes)
    for kind, paths in sorted(kinds.items()):
        yield f"harvest, {kind} fields", shard_statistics(paths, most=options.cubes)
    if options.unseen:
        yield "harvest-unseen-field", shard_statistics(find_shards(options.unseen), most=options.cubes)
    yield from synthetic_sets(options, folder)


def rows_of(found: dict[str, CubeStatistics]) -> list[dict[str, Any]]:
    """A row a set: its distance to the first set's cubes (the capture's), feature by feature, and its summary."""
    rows, reference = [], next(iter(found.values()))
    for name, measured in found.items():
        parts = feature_distances(measured, reference)
        row: dict[str, Any] = {"method": name, "distance": round(float(np.mean(list(parts.values()))), 4)}
        row["distances"] = {feature: round(value, 4) for feature, value in parts.items()}
        rows.append({**row, **measured.summary()})
    return rows


def draw(path: Path, found: dict[str, CubeStatistics], rows: list[dict[str, Any]], floor: float) -> None:
    """Distances as bars, and the distributions of a few sets as steps."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    reference = next(iter(found))
    figure, axes = plt.subplots(2, 4, figsize=(16, 7.5), constrained_layout=True)
    ordered = sorted((row for row in rows if row["method"] != reference), key=lambda row: -row["distance"])
    bars = axes[0, 0]
    names = [row["method"].replace("corruption ", "") for row in ordered]
    colors = ["#2a7f62" if "harvest" in name else "#b8b8b8" for name in names]
    bars.barh(names, [row["distance"] for row in ordered], color=colors)
    bars.axvline(floor, color="#b03a2e", linewidth=1, label=f"two halves of the cubes of {reference}")
    bars.set_title(f"distance to the cubes of {reference}")
    bars.tick_params(axis="y", labelsize=7)
    bars.legend(fontsize=7, loc="lower right")
    shown = {
        "capture": "#b03a2e",
        "harvest": "#2a7f62",
        "harvest-unseen-field": "#1f5f99",
        "procedural, soft": "#d08c1d",
        "procedural, bits": "#8a8a8a",
    }
    for axis, feature in zip(axes.flat[1:], FEATURES):
        for name, color in shown.items():
            if name in found:
                values = np.sort(FEATURES[feature](found[name].features[feature]))
                axis.step(values, np.arange(1, len(values) + 1) / len(values), color=color, linewidth=1.5, label=name)
        axis.set_title(f"{feature.replace('_', ' ')} (as the distance maps it)", fontsize=9)
        axis.set_ylabel("share of cubes", fontsize=8)
        axis.set_ylim(0, 1)
    axis = axes.flat[7]
    for name, color in shown.items():
        if name in found:
            shares = found[name].opacity_histogram(20)
            axis.step(np.linspace(0.025, 0.975, 20), shares, where="mid", color=color, linewidth=1.5, label=name)
    axis.set_yscale("log")
    axis.set_title("opacity of all voxels", fontsize=9)
    axes.flat[1].legend(fontsize=8)
    figure.savefig(path, dpi=90)
    plt.close(figure)


def main() -> None:
    options = parse(Options, __doc__)
    found: dict[str, CubeStatistics] = {}
    with tempfile.TemporaryDirectory() as temporary:
        for name, measured in all_sets(options, Path(temporary)):
            say(f"{name}: {len(measured)} cubes")
            found[name] = measured
    rows, floor = rows_of(found), sampling_floor(next(iter(found.values())))
    results = build_results(
        rows,
        command=options.command(),
        seeds=[SEED, *options.seeds],
        capture=options.capture.resolve().name if given(options.capture) else None,
        sampling_floor=round(floor, 4),
        harvest_scenes=len(find_shards(options.harvest)),
    )
    options.out.mkdir(parents=True, exist_ok=True)
    write_results(options.out / "statistics.json", results)
    draw(options.out / "statistics.png", found, rows, floor)
    for row in rows:
        agreement = f"  IoU with the truth {row['iou']['mean']:.3f}" if "iou" in row else ""
        say(f"{row['method']:34s} distance {row['distance']:.3f}{agreement}")
    say(f"two halves of the cubes of {next(iter(found))}  {floor:.3f}")
    wrote(options.out / "statistics.json", options.out / "statistics.png")


if __name__ == "__main__":
    main()
