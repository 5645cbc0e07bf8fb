"""What sight lines cost: tracing observations through a grid, looking places up, a step of their loss.

    python -m benchmarks.regularizer.sight_lines
    python -m benchmarks.regularizer.sight_lines --short    with a twentieth of the observations

A ball on a floor in the box [-1, 1]^3, photographed from a ring of 100 cameras round it; eight of the nearest 30
cameras observe each point, one point in twenty lies anywhere. Counts are checked against a slow twin, line by line and
cell by cell, on some of the lines. Rows: a grid of 128 cells a side over the box; without the vote on wrong points;
over a box that holds the cameras, too; over one twice as wide as that with cells of the same size (eight times as many,
all new ones empty); with shells out to 16 times the box. Look-ups where the points are. A step of the loss (4,096 lines
of 12 places, their ends of 8) on a field that costs next to nothing, and on a trilinear grid of 128 nodes a side, whose
own answers are timed apart. What is compared is timed in turns; ``ratio`` is that of processor times to the first row
of each kind, and for the doubled box to the undoubled. Writes docs/results/sight_lines.json.
"""

from __future__ import annotations

import functools
import statistics
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray

from unghost import load_denoiser
from unghost.core.cameras import Cameras, look_at
from unghost.core.grid_traversal import GridTraversal
from unghost.core.lattice import lattice_origin
from unghost.core.results import build_results, write_results
from unghost.core.sight_lines import SightLines
from unghost.core.sparse_points import SparsePoints
from unghost.regularizer.density_regularizer import DensityRegularizer

from ..options import BenchmarkOptions, parse
from ..progress import say, wrote
from ..timing import Clock
from .grid_field import GridField

BOX = np.array([[-1.0] * 3, [1.0] * 3])
CELLS = 128
TRACK = 8  # observations a point
REACH = 16.0
WIDE = 1.6 * BOX  # holds the cameras


@dataclass(frozen=True)
class Options(BenchmarkOptions):
    """What to time.

    Attributes:
        observations: to trace.
        repeats: of which the median is taken.
        twin: lines that the slow twin checks.
    """

    SHORT: ClassVar[dict[str, Any]] = {"observations": 10_000, "repeats": 2, "twin": 20}

    observations: int = 200_000
    repeats: int = 9
    twin: int = 200


def scene(observations: int, photos: int = 100) -> tuple[SparsePoints, Cameras]:
    """The points and the cameras; see the module."""
    rng, count = np.random.default_rng(0), observations // TRACK
    angle = np.linspace(0, 2 * np.pi, photos, endpoint=False)
    origins = np.stack([1.5 * np.cos(angle), 1.5 * np.sin(angle), 0.3 + 0.5 * np.sin(3 * angle)], axis=1)
    poses = look_at(origins, np.zeros((photos, 3)))
    cameras = Cameras.create(poses, np.array([400.0, 400.0, 400.0, 300.0]), 800, 600)
    outward = rng.normal(size=(count, 3))
    xyz = 0.6 * outward / np.linalg.norm(outward, axis=1, keepdims=True)
    floor = np.arange(count) % 2 == 0
    xyz[floor] = np.stack([*rng.uniform(-0.98, 0.98, (2, floor.sum())), np.full(floor.sum(), -0.7)], axis=1)
    wrong = rng.random(count) < 0.05
    xyz[wrong] = rng.uniform(-1, 1, (wrong.sum(), 3))
    nearest = np.argsort(np.linalg.norm(xyz[:, None] - origins, axis=-1), axis=1)[:, :30]
    chosen = rng.permuted(np.tile(np.arange(30), (count, 1)), axis=1)[:, :TRACK]
    camera = np.take_along_axis(nearest, chosen, axis=1).ravel()
    return SparsePoints.create(xyz, point=np.repeat(np.arange(count), TRACK), camera=camera, cameras=cameras), cameras


def check_counts(lines: SightLines, number: int) -> None:
    """Compare the cells of some lines with those whose three slabs the line meets over a positive length.

    Where a line begins or ends on a face between cells, as those of shells do, either cell is right. Lines that do so
    on an edge are left out: which cells they pass through there is a matter of rounding.
    """
    origin, shape = (
        lattice_origin(lines.aabb, lines.pitch, lines.crossed_block.grid_shape),
        np.array(lines.crossed_block.grid_shape),
    )
    some = np.linspace(0, len(lines.starts) - 1, number).astype(np.int64)
    starts, ends = ((each[some] - origin) / lines.pitch for each in (lines.starts, lines.ends))
    at_edge = [(np.abs(each - np.round(each)) < 1e-9).sum(axis=1) > 1 for each in (starts, ends)]
    starts, ends = (each[~(at_edge[0] | at_edge[1])] for each in (starts, ends))
    assert len(starts) > 0.5 * number
    count = GridTraversal(lines.crossed_block, starts, ends).count(np.ones(len(starts), dtype=bool))
    least, most = np.zeros(shape, dtype=np.int64), np.zeros(shape, dtype=np.int64)
    for start, end in zip(starts, ends):
        low = np.maximum(np.floor(np.minimum(start, end)).astype(np.int64) - 1, 0)
        high = np.minimum(np.floor(np.maximum(start, end)).astype(np.int64) + 2, shape)
        cells = low + np.stack(np.meshgrid(*map(np.arange, high - low), indexing="ij"), axis=-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            first, second = (cells - start) / (end - start), (cells + 1 - start) / (end - start)
        enter = np.maximum(np.minimum(first, second).max(axis=-1), 0.0)
        leave = np.minimum(np.maximum(first, second).min(axis=-1), 1.0)
        part = tuple(slice(a, b) for a, b in zip(low, high))
        overlap = (leave - enter) * np.linalg.norm(end - start)
        least[part] += overlap > 1e-9
        most[part] += overlap > -1e-9
    found = lines.crossed_block.whole(count)
    assert ((found >= least) & (found <= most)).all(), "counts differ from the slow twin"


def in_turns(
    works: Mapping[str, Callable[[], Any]], repeats: int
) -> tuple[dict[str, dict[str, float]], dict[str, Any]]:
    """Median wall and processor seconds of each, called in turns after one uncounted round, and their last results."""
    spent: dict[str, list[tuple[float, float]]] = {name: [] for name in works}
    results = {name: work() for name, work in works.items()}
    for _ in range(repeats):
        for name, work in works.items():
            clock = Clock()
            results[name] = work()
            now = clock.read()
            spent[name].append((now["seconds"], now["cpu_seconds"]))
    return {
        name: {
            "seconds": statistics.median(wall for wall, _ in each),
            "cpu_seconds": statistics.median(cpu for _, cpu in each),
        }
        for name, each in spent.items()
    }, results


def rows_of(names: dict[str, str], times: dict[str, dict[str, float]], **more: Any) -> list[dict[str, Any]]:
    """A row each; ``ratio`` to the first, of processor times."""
    base = next(iter(times.values()))["cpu_seconds"]
    rows = []
    for name, method in names.items():
        rows.append({"method": method, **times[name], "ratio": times[name]["cpu_seconds"] / base, **more})
        say(
            f"{method}: {times[name]['seconds'] * 1e3:.1f} ms, {times[name]['cpu_seconds'] * 1e3:.1f} of processor time"
        )
    return rows


def build_rows(points: SparsePoints, cameras: Cameras, options: Options) -> list[dict[str, Any]]:
    """Building and looking up."""
    pitch = 2.0 / CELLS

    def build(**changes: Any) -> SightLines:
        return SightLines.build(points, cameras, **{"aabb": BOX, "pitch": pitch, **changes})

    names = {
        "box": f"build, {CELLS}^3 cells",
        "no vote": f"build, {CELLS}^3 cells, no vote",
        "wide": f"build, {CELLS}^3 cells, box with the cameras",
        "twice": f"build, {2 * CELLS}^3 cells, box with the cameras doubled",
        "shells": f"build, {CELLS}^3 cells, shells to {REACH:.0f} times the box",
    }
    works: dict[str, Callable[[], SightLines]] = {
        "box": build,
        "no vote": lambda: build(robust=False),
        "wide": lambda: build(aabb=WIDE, pitch=1.6 * pitch),
        "twice": lambda: build(aabb=2 * WIDE, pitch=1.6 * pitch),
        "shells": lambda: build(reach=REACH),
    }
    times, built = in_turns(works, options.repeats)
    check_counts(built["box"], options.twin)
    for shell in built["shells"].shells:
        if len(shell.starts) >= options.twin:
            check_counts(shell, options.twin)
    assert (built["shells"].crossed == built["box"].crossed).all()
    rows = rows_of(names, times, observations=len(points.point))
    assert built["wide"].crossed.sum() == built["twice"].crossed.sum()
    rows[3]["ratio"] = rows[3]["cpu_seconds"] / rows[2]["cpu_seconds"]
    for row, name in zip(rows, names):
        levels = [built[name], *built[name].shells]
        held = sum(each.crossed.nbytes + each.supported.nbytes for each in levels)
        row |= {"lines": len(built[name]), "megabytes": held / 1e6}
    where = points.xyz[np.random.default_rng(1).integers(len(points), size=options.observations)]
    places = where + np.random.default_rng(2).normal(0, pitch, where.shape)
    asked = {name: functools.partial(built[name].crossings, places) for name in ("box", "wide", "twice", "shells")}
    times, found = in_turns(asked, options.repeats)
    assert (found["shells"][np.abs(places).max(axis=1) <= 1] == found["box"][np.abs(places).max(axis=1) <= 1]).all()
    methods = {
        "box": "look-up of crossings near points",
        "wide": "look-up of crossings near points, box with the cameras",
        "twice": "look-up of crossings near points, box with the cameras doubled",
        "shells": f"look-up of crossings near points, shells to {REACH:.0f} times the box",
    }
    look_ups = rows_of(methods, times, positions=len(places))
    look_ups[2]["ratio"] = look_ups[2]["cpu_seconds"] / look_ups[1]["cpu_seconds"]
    return rows + look_ups


def step_rows(points: SparsePoints, cameras: Cameras, options: Options) -> list[dict[str, Any]]:
    """A step of the loss, forward and backward, without and with the queries of a field that costs something."""
    regularizer = DensityRegularizer(
        load_denoiser(),
        aabb=BOX,
        cameras=cameras,
        points=points,
        field_pitch=2.0 / CELLS,
        cubes=0,
        visibility_weight=0.0,
        sight_line_reach=1.0,
    )
    level = torch.tensor(0.3, requires_grad=True)
    density: NDArray[Any] = np.random.default_rng(0).random((CELLS,) * 3)
    grid, asked = GridField(density, 2.0 / CELLS), list[torch.Tensor]()

    def constant(positions: torch.Tensor) -> torch.Tensor:
        asked.append(positions)
        return level.expand(len(positions))

    def step(field: Callable[[torch.Tensor], torch.Tensor]) -> float:
        asked.clear()
        grid.zero_grad()
        level.grad = None
        loss = regularizer(field)["sight_lines"]
        loss.backward()
        return loss.item()

    step(constant)
    held = list(asked)

    def queries() -> None:
        grid.zero_grad()
        torch.cat([grid(positions) for positions in held]).mean().backward()

    works: dict[str, Callable[[], Any]] = {
        "own": lambda: step(constant),
        "queries": queries,
        "step": lambda: step(grid),
    }
    times, found = in_turns(works, options.repeats * 3)
    assert 0 < found["own"] < 1
    assert 0 < found["step"] < 1
    settings = regularizer.settings
    names = {
        "own": "sight-line loss step, beside the field's answers",
        "queries": "the field's answers of such a step, trilinear grid",
        "step": "sight-line loss step, trilinear grid",
    }
    positions = sum(map(len, held))
    return rows_of(names, times, lines=settings.sight_lines, places=settings.sight_line_samples, positions=positions)


def main() -> None:
    options = parse(Options, __doc__)
    torch.set_num_threads(options.threads)
    points, cameras = scene(options.observations)
    rows = build_rows(points, cameras, options) + step_rows(points, cameras, options)
    results = build_results(rows, command=options.command(), seeds=[0], threads=options.threads)
    write_results(options.out / "sight_lines.json", results)
    wrote(options.out / "sight_lines.json")


if __name__ == "__main__":
    main()
