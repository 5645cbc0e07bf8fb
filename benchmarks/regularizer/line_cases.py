"""The rows of ``docs/stability.md`` about sight lines and their two losses."""

from __future__ import annotations

from fractions import Fraction
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unghost.core.cameras import Cameras, look_at
from unghost.core.grid_traversal import Block, GridTraversal
from unghost.core.sight_lines import SightLines
from unghost.core.sparse_points import SparsePoints
from unghost.regularizer.losses import end_point_loss, sight_line_loss

from .losses import SINGLE, Case, rival

BOX = np.array([[-1.0] * 3, [1.0] * 3])
SHAPE = (6, 5, 4)
PHOTOS = 6


def ring(unit: float = 1.0) -> Cameras:
    angle = np.linspace(0, 2 * np.pi, PHOTOS, endpoint=False) + 0.1
    origins = np.stack([2.5 * np.cos(angle), 2.5 * np.sin(angle), 0.5 * np.sin(3 * angle) + 0.2], axis=1)
    poses = look_at(origins, np.zeros((PHOTOS, 3)))
    poses[:, :, 3] *= unit
    return Cameras.create(poses, np.array([80.0, 80.0, 64.0, 48.0]), 128, 96)


def build(xyz: NDArray[Any], unit: float = 1.0, **options: Any) -> SightLines:
    """Every camera observes every point."""
    cameras, (point, camera) = ring(unit), np.divmod(np.arange(len(xyz) * PHOTOS), PHOTOS)
    points = SparsePoints.create(xyz, point=point, camera=camera, cameras=cameras)
    return SightLines.build(points, cameras, **{"aabb": BOX * unit, "pitch": 0.1 * unit, **options})


def cloud(count: int = 40, wide: float = 0.8) -> NDArray[np.float64]:
    xyz: NDArray[np.float64] = np.random.default_rng(0).uniform(-wide, wide, (count, 3))
    return xyz


def answers(lines: SightLines, places: NDArray[Any]) -> NDArray[np.float64]:
    """Crossings and support, which must be finite and at least 0."""
    found = np.stack([lines.crossings(places), lines.support(places)]).astype(np.float64)
    assert np.isfinite(found).all()
    assert (found >= 0).all()
    return found


def add_up(lines: SightLines) -> bool:
    """Whether every observation is a line or counted as dropped."""
    left = len(lines.starts) + sum(lines.report[name] for name in ("too_near", "outside", "outvoted"))
    return left == lines.report["observations"]


def exact_cells(start: NDArray[Any], end: NDArray[Any]) -> set[tuple[int, ...]]:
    """Cells that a segment passes through over a positive length, in rational arithmetic."""
    found = set()
    for cell in product(*map(range, SHAPE)):
        enter, leave = Fraction(0), Fraction(1)
        for low, begin, finish in zip(cell, map(Fraction, start.tolist()), map(Fraction, end.tolist())):
            first, last = sorted(((low - begin) / (finish - begin), (low + 1 - begin) / (finish - begin)))
            enter, leave = max(enter, first), min(leave, last)
        if leave > enter:
            found.add(cell)
    return found


def traversal() -> float:
    """Share of cells that differ from exact arithmetic: segments of every direction, some almost along an axis."""
    rng, wrong, total = np.random.default_rng(0), 0, 0
    starts, ends = rng.uniform(0, SHAPE, (2, 30, 3))
    for line in range(15):
        ends[line] = starts[line] + rng.choice([-1, 1], 3) * 10.0 ** -rng.integers(2, 12, 3)
        ends[line, line % 3] = rng.uniform(0, SHAPE[line % 3])
    ends = np.clip(ends, 1e-3, np.array(SHAPE) - 1e-3)
    block = Block(np.zeros(3, dtype=np.int64), SHAPE, SHAPE)
    for start, end in zip(starts, ends):
        count = GridTraversal(block, start[None], end[None]).count(np.ones(1, dtype=bool))
        assert count.max() == 1
        found, exact = set(map(tuple, np.argwhere(count).tolist())), exact_cells(start, end)
        wrong, total = wrong + len(found ^ exact), total + len(exact)
    return wrong / total


def unit(scale: float) -> float:
    """Largest difference of crossings and support, in the box and beyond it."""
    places = np.random.default_rng(1).uniform(-3, 3, (1000, 3))
    xyz = np.concatenate([cloud(), cloud(20, 3.0)])
    expected = answers(build(xyz, reach=4.0), places)
    assert (expected > 0).any(axis=1).all()
    found = answers(build(xyz * scale, scale, reach=4.0), places * scale)
    return float(np.abs(found - expected).max() / expected.max())


def at_a_camera() -> None:
    plain, with_it = build(cloud()), build(np.concatenate([cloud(), ring().origins[:1]]))
    assert with_it.report["too_near"] == plain.report["too_near"] + 1
    assert add_up(with_it)
    answers(with_it, ring().origins)


def duplicates() -> float:
    places = np.random.default_rng(1).uniform(-1, 1, (1000, 3))
    once, twice = (answers(build(np.tile(cloud(), (n, 1)), robust=False), places) for n in (1, 2))
    return float(np.abs(once - twice).max() / once.max())


def outside() -> None:
    lines = build(cloud() + 50.0)
    assert add_up(lines)
    assert lines.support_sum.max() == 0
    answers(lines, cloud())


def no_length() -> None:
    start = np.array([[2.5, 1.5, 0.5], [6.0, 5.0, 4.0]])
    block = Block(np.zeros(3, dtype=np.int64), SHAPE, SHAPE)
    count = GridTraversal(block, start, start).count(np.ones(2, dtype=bool))
    assert np.argwhere(count).tolist() == [[2, 1, 0], [5, 4, 3]]
    assert len(build(cloud(), margin_cells=1e3)) == 0


def single() -> None:
    for place in (np.zeros((1, 3)), BOX[:1], BOX[1:]):
        assert answers(build(place), place)[1] > 0


def far() -> None:
    direction = np.random.default_rng(0).normal(size=(40, 3))
    xyz = direction * np.logspace(3, 6, 40)[:, None]
    for scale in (1e-6, 1.0, 1e6):
        lines = build(xyz * scale, scale, reach=2.0**20, margin_sigmas=0.0)
        assert add_up(lines)
        rng = np.random.default_rng(0)
        places, ends = lines.sample(rng, 500)[0], lines.sample_ends(rng, 500, reach=0.2 * scale)[0]
        assert len(ends) in (0, 500)  # none, where nobody knows well enough where the points are
        assert np.isfinite(places).all()
        assert np.isfinite(ends).all()
        answers(lines, np.concatenate([places.reshape(-1, 3), xyz * scale]))
        uncertain = build(xyz * scale, scale, reach=2.0**20)
        assert uncertain.report["too_near"] == uncertain.report["observations"]


LINE_CASES = [
    Case("cells that sight lines pass through", "those of exact rational arithmetic", lambda _: traversal(), SINGLE),
    Case("sight lines, scene unit × 1e6", "the same crossings and support", lambda _: unit(1e6), SINGLE),
    Case("sight lines, scene unit × 1e-6", "the same crossings and support", lambda _: unit(1e-6), SINGLE),
    Case("sight lines, a point at a camera's centre", "no line; counted in `report`", lambda _: at_a_camera(), SINGLE),
    Case("sight lines, every point twice", "the same crossings and support", lambda _: duplicates(), SINGLE),
    Case("sight lines, all points outside the box", "no support; lines where they pass", lambda _: outside(), SINGLE),
    Case("sight lines of no length", "in one cell; none is left after the margin", lambda _: no_length(), SINGLE),
    Case("sight lines, a single point", "it has support, on the box's corners too", lambda _: single(), SINGLE),
    Case(
        "sight lines, points 1e3 to 1e6 boxes away, any unit",
        "finite in shells out to 2^20 times the box; those whose rays do not determine them are counted",
        lambda _: far(),
        SINGLE,
    ),
    Case(
        "sight-line loss, densities 0 to the largest",
        "between 0 and 1; small densities keep their digits (`expm1`)",
        rival(lambda d: sight_line_loss(d.reshape(-1, 1), 0.05), 0.0, 1.0),
    ),
    Case(
        "end-point loss, densities 0 to the largest",
        "between 0 and 1",
        rival(lambda d: end_point_loss(d.reshape(-1, 1), 0.05), 0.0, 1.0),
    ),
]
