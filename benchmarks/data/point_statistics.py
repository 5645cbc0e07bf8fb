"""Do simulated sparse points look like triangulated ones? Their measures side by side.

    python -m benchmarks.data.point_statistics --captures FOLDER=SWEEP FOLDER=SWEEP

Real points are triangulated from the photos of one sweep: of captures, and of synthetic scenes that are rendered at
``--match-width`` pixels. Simulated ones (:func:`unghost.scenes.sparse_points.simulate_sparse_points`) are of the same
synthetic scenes as if matched at that width, and of scenes of a harvest as the harvest draws them. Of a capture the
surface is unknown, so that its rows lack the distance to it. Writes ``points.json`` and ``points.png``.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

import unghost.evaluation.captures
from unghost.core.results import build_results, write_results
from unghost.core.sparse_points import SparsePoints
from unghost.data_recipes.harvest.config import HarvestConfig
from unghost.data_recipes.harvest.run import photograph_scene
from unghost.evaluation.captures.loading import load_capture
from unghost.evaluation.captures.triangulation import LONGEST_SIDE, triangulate
from unghost.scenes.generator import PhotographedScene, photograph_larger
from unghost.scenes.sparse_points import MatchingConfig, simulate_sparse_points

from ..fit_cache import FitCache, code_hash
from ..options import CAPTURE, ROOT, BenchmarkOptions, parse
from ..progress import say, wrote
from ..two_trajectory.points import FIELDS, with_points
from ..two_trajectory.scenes import synthetic_scene
from .point_figure import draw
from .point_measures import Measured, PointSet, measure

Array = NDArray[Any]

SEED = 17
FEWEST = 30  # points of a simulated set; a harvest uses smaller ones too, but their shares say nothing


@dataclass(frozen=True)
class Options(BenchmarkOptions):
    """What to compare.

    Attributes:
        captures: folder of a capture and the sweep whose photos are matched, ``FOLDER=SWEEP``.
        scenes: synthetic scenes.
        scene_seed: of these.
        match_width: width of their matched photos, pixels.
        draws: simulated sets of each scene.
        harvest: scenes of a harvest of seed 0, without meshes; widths of matched photos are drawn as the harvest draws
            them, and pixels are those of ``match_width``.
        photos: of each scene, in which texture is measured.
        cache: where triangulated points are kept.
    """

    SHORT: ClassVar[dict[str, Any]] = {
        "scenes": ("room-1",),
        "match_width": 160,
        "draws": 2,
        "harvest": 1,
        "photos": 2,
    }
    DATA: ClassVar[dict[str, str]] = {"captures": f"{CAPTURE}, each FOLDER=SWEEP"}
    SHORT_WITHOUT: ClassVar[tuple[str, ...]] = ("captures",)

    captures: tuple[str, ...] = ()
    scenes: tuple[str, ...] = ("room-1", "room-7", "objects-3")
    scene_seed: int = 555
    match_width: int = 384
    draws: int = 8
    harvest: int = 5
    photos: int = 4
    cache: Path = ROOT / "out" / "points"


@dataclass(frozen=True)
class Row:
    """The sets of one scene and of one origin: one real set, or several simulated ones."""

    origin: str
    scene: str
    sets: list[Measured]

    def summary(self) -> dict[str, Any]:
        """Medians over the sets, and where there are several the quantiles 0.1 and 0.9 of each measure."""
        numbers = {name: [each.numbers[name] for each in self.sets] for name in self.sets[0].numbers}
        row: dict[str, Any] = {"method": self.origin, "scene": self.scene, "sets": len(self.sets)}
        row |= {name: round(float(np.nanmedian(values)), 4) for name, values in numbers.items()}
        if len(self.sets) > 1:
            row["spread"] = {
                name: [round(float(np.nanquantile(values, at)), 4) for at in (0.1, 0.9)]
                for name, values in numbers.items()
            }
        return row


def captured_set(word: str, cache: FitCache, photos: int) -> tuple[str, PointSet]:
    """Points of a sweep of a capture, ``FOLDER=SWEEP``; errors and cameras are of photos as they are matched."""
    folder, _, sweep = word.partition("=")
    whole = load_capture(folder, downscale=1)
    indices = whole.split(sweep)
    name = f"{whole.folder.resolve().name} {sweep}"
    shrunk = max(1.0, max(whole.photo_size(int(indices[0]))) / LONGEST_SIDE)
    capture = load_capture(folder, downscale=shrunk)
    code = code_hash(unghost.evaluation.captures)
    key = {"photos": [capture.names[index] for index in indices], "side": LONGEST_SIDE, "code": code}

    def make() -> dict[str, Array]:
        points = triangulate(capture, indices)
        return {field: getattr(points, field) for field in FIELDS}

    stored = cache.views(f"capture-{name.replace(' ', '-')}", key, make)
    found = SparsePoints(*(stored[field] for field in FIELDS))
    points = dataclasses.replace(found, error=found.error / shrunk)
    chosen = spread_over(len(indices), photos)
    grey = {index: capture.images([indices[index]])[0].mean(axis=-1) for index in chosen}
    return name, PointSet(points, capture.cameras.select(indices), grey)


def scene_photos(photographed: PhotographedScene, width: int, photos: int) -> dict[int, Array]:
    """A few of a synthetic scene's photos, as they are matched, in grey levels."""
    chosen = np.array(spread_over(len(photographed.cameras), photos))
    part = dataclasses.replace(photographed, true_cameras=photographed.true_cameras.select(chosen))
    return dict(zip(chosen.tolist(), photograph_larger(part, width=width)[0].mean(axis=-1)))


def simulated_sets(
    number: int, photographed: PhotographedScene, grey: dict[int, Array], *, width: int, fixed: bool, draws: int
) -> Iterator[PointSet]:
    """Simulated points of one scene; ``fixed``: as if matched at ``width`` pixels."""
    config = dataclasses.replace(MatchingConfig(), width=(width, width)) if fixed else MatchingConfig()
    cameras = photographed.cameras.resized(width / photographed.cameras.width)
    for turn in range(draws):
        points = simulate_sparse_points(np.random.default_rng([SEED, number, turn]), photographed, config)
        if len(points) >= FEWEST:
            yield PointSet(points, cameras, grey, photographed.scene.signed_distance)


def spread_over(count: int, wanted: int) -> list[int]:
    """Positions of ``wanted`` of ``count`` photos, evenly spread."""
    return sorted(set(np.linspace(0, count - 1, wanted + 2).round().astype(int)[1:-1].tolist()))


def all_rows(options: Options) -> Iterator[Row]:
    """Captures, synthetic scenes twice, and a harvest."""
    cache = FitCache(options.cache)
    rng = np.random.default_rng(SEED)
    for word in options.captures:
        name, found = captured_set(word, cache, options.photos)
        yield Row("triangulated, capture", name, [measure(found, rng)])
    width = options.match_width
    for name in options.scenes:
        scene = with_points(synthetic_scene(options.scene_seed, name), cache, match_width=width)
        photographed, points = scene.photographed, scene.points
        assert photographed is not None
        assert points is not None
        grey = scene_photos(photographed, width, options.photos)
        cameras = photographed.cameras.resized(width / photographed.cameras.width)
        real = PointSet(points, cameras, grey, photographed.scene.signed_distance)
        yield Row("triangulated, synthetic", name, [measure(real, rng)])
        number = int(name.rpartition("-")[2])
        made = simulated_sets(number, photographed, grey, width=width, fixed=True, draws=options.draws)
        if sets := [measure(each, rng) for each in made]:
            yield Row("simulated", name, sets)
    for number in range(options.harvest):
        try:
            photographed = photograph_scene(np.random.default_rng([0, number]), HarvestConfig())
        except RuntimeError:
            continue  # no free path through the scene: a harvest leaves it out, too
        grey = scene_photos(photographed, width, options.photos)
        made = simulated_sets(number, photographed, grey, width=width, fixed=False, draws=options.draws)
        if sets := [measure(each, rng) for each in made]:
            yield Row("simulated, harvest", f"scene-{number}", sets)


def compared(rows: list[Row]) -> dict[str, dict[str, Any]]:
    """Each measure over the real sets and over the simulated ones.

    Returns:
        name of a measure -> ``real``: lowest, median and highest of the real sets; ``simulated``: quantiles 0.1, 0.5
        and 0.9 of the simulated ones; ``outside``: whether the medians differ by more than the real sets do among
        themselves (their highest less their lowest).
    """
    groups = {
        kind: [each.numbers for row in rows if row.origin.startswith(kind) for each in row.sets]
        for kind in ("triangulated", "simulated")
    }
    found = {}
    for name in sorted({name for numbers in groups["triangulated"] for name in numbers}):
        real, made = ([numbers[name] for numbers in groups[kind] if name in numbers] for kind in groups)
        low, middle, high = (float(np.quantile(real, at)) for at in (0, 0.5, 1))
        simulated = [round(float(np.nanquantile(made, at)), 4) for at in (0.1, 0.5, 0.9)]
        found[name] = {
            "real": [round(each, 4) for each in (low, middle, high)],
            "simulated": simulated,
            "outside": bool(abs(simulated[1] - middle) > high - low),
        }
    return found


def main() -> None:
    options = parse(Options, __doc__)
    rows = list[Row]()
    for row in all_rows(options):
        rows.append(row)
        numbers = row.summary()
        say(f"{row.origin:24s} {row.scene:28s} {numbers['points']:6.0f} points, {numbers['views']:.2f} views")
    results = build_results(
        [row.summary() for row in rows],
        command=options.command(),
        seeds=[SEED, options.scene_seed],
        matching=dataclasses.asdict(MatchingConfig()),
        compared=compared(rows),
    )
    options.out.mkdir(parents=True, exist_ok=True)
    write_results(options.out / "points.json", results)
    draw(options.out / "points.png", {f"{row.origin}: {row.scene}": (row.origin, row.sets) for row in rows})
    wrote(options.out / "points.json", options.out / "points.png")


if __name__ == "__main__":
    main()
