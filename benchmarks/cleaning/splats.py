"""Floaters among 3D Gaussian splats: `unghost clean` beside what people use today, on scenes whose floaters are known.

    python -m benchmarks.cleaning.splats --splats 500000

Rooms of procedural furniture (`scenes/generator.py`) are covered with flat splats, as a trainer leaves them; floaters
are added to the free space: blobs (clusters), haze (wide faint splats) and needles (long thin ones), and every
Gaussian's origin is remembered. Rivals: Open3D's statistical and radius outlier removal (on the middles, with
the parameters that people copy), a threshold on the opacity, and the largest component of an occupancy grid. Each row:
floaters removed, true splats kept, seconds (imports and loading aside). Writes docs/results/splats.json.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from unghost.cleaning.splats import box_of, pitch_of
from unghost.core.results import build_results, write_results
from unghost.facade import clean_splats
from unghost.scenes.generator import random_scene
from unghost.splats.ply import Gaussians

from ..options import BenchmarkOptions, parse
from ..progress import Plan, say, wrote

KINDS = ("surface", "blob", "haze", "needle")
REFERENCE = 40_000  # splats of a scene whose sizes are as written in `make`
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Options(BenchmarkOptions):
    """What to measure.

    Attributes:
        splats: Gaussians of a scene, floaters included.
        floaters: share of them that are floaters.
        seeds: of the scenes.
    """

    SHORT: ClassVar[dict[str, Any]] = {"splats": 5000, "seeds": (900,)}

    splats: int = 500_000
    floaters: float = 0.08
    seeds: tuple[int, ...] = (900, 901, 902)


@dataclass(frozen=True)
class Scene:
    """Gaussians, and of which kind each is (an index into ``KINDS``)."""

    gaussians: Gaussians
    kind: NDArray[np.int64]


def on_surfaces(rng: np.random.Generator, scene: Any, count: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """Points on the scene's surfaces within [-1.5, 1.5]^3, and their normals."""
    points, normals = [np.zeros((0, 3))], [np.zeros((0, 3))]
    while sum(map(len, points)) < count:
        tried = rng.uniform(-1.5, 1.5, (200_000, 3))
        distance = scene.signed_distance(tried)
        near = tried[np.abs(distance) < 0.05]
        for _ in range(4):
            near = near - scene.signed_distance(near)[:, None] * slope(scene, near)
        near = near[np.abs(scene.signed_distance(near)) < 1e-3]
        points.append(near)
        normals.append(slope(scene, near))
    return np.concatenate(points)[:count], np.concatenate(normals)[:count]


def slope(scene: Any, points: NDArray[Any]) -> NDArray[Any]:
    """Unit gradient of the scene's distance."""
    step = 1e-4
    found = np.stack(
        [scene.signed_distance(points + d) - scene.signed_distance(points - d) for d in np.eye(3) * step], axis=1
    )
    unit: NDArray[Any] = found / np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1e-12)
    return unit


def facing(normals: NDArray[Any]) -> NDArray[Any]:
    """Quaternions (w, x, y, z) that turn +z to the normals."""
    z = normals[:, 2]
    turned = np.column_stack([1.0 + z, -normals[:, 1], normals[:, 0], np.zeros(len(z))])
    turned[z < -0.999999] = [0.0, 1.0, 0.0, 0.0]
    quaternions: NDArray[Any] = turned / np.linalg.norm(turned, axis=1, keepdims=True)
    return quaternions


def make(seed: int, options: Options) -> Scene:
    """A furnished room in splats, with floaters in its free space.

    Whatever their number, the surface is covered as often (sizes go with its inverse square root), and floaters fill
    the same share of the room (inverse cube root).
    """
    rng = np.random.default_rng(seed)
    scene = random_scene(rng)
    ghosts = round(options.floaters * options.splats)
    true = options.splats - ghosts
    flat, deep = (REFERENCE / options.splats) ** 0.5, (REFERENCE / options.splats) ** (1 / 3)
    means, normals = on_surfaces(rng, scene, true)
    means = means + rng.normal(0, 0.002 * flat, means.shape)
    side = rng.lognormal(np.log(0.012 * flat), 0.5, (true, 1))
    extents = np.hstack([side, side * rng.uniform(0.4, 1.0, (true, 1)), side * rng.uniform(0.02, 0.15, (true, 1))])
    parts = [(means, extents, facing(normals), rng.normal(2.0, 1.5, true), np.zeros(true, int))]
    free = rng.uniform(-1.2, 1.2, (200_000, 3))
    free = free[scene.signed_distance(free) > 0.12]
    each = np.diff(np.linspace(0, ghosts, 4).astype(int))
    turns = [rng.normal(size=(count, 4)) for count in each]
    places = free[rng.integers(0, len(free), 60)][rng.integers(0, 60, each[0])]
    blob = places + rng.normal(0, 0.025, places.shape)
    parts.append(
        (
            blob,
            rng.lognormal(np.log(0.012 * deep), 0.5, (each[0], 3)),
            turns[0],
            rng.normal(0, 1.5, each[0]),
            np.full(each[0], 1),
        )
    )
    haze = free[rng.integers(0, len(free), each[1])]
    parts.append(
        (
            haze,
            rng.lognormal(np.log(0.04 * deep), 0.4, (each[1], 3)),
            turns[1],
            rng.normal(-2.5, 0.8, each[1]),
            np.full(each[1], 2),
        )
    )
    needle = free[rng.integers(0, len(free), each[2])]
    thin = rng.lognormal(np.log(0.004 * deep), 0.3, (each[2], 3)) * [15, 1, 1]
    parts.append((needle, thin, turns[2], rng.normal(0, 1.5, each[2]), np.full(each[2], 3)))
    columns = [np.concatenate(column) for column in zip(*parts)]
    return Scene(Gaussians.create(*columns[:4]), columns[4])


def open3d_cloud(gaussians: Gaussians) -> Any:
    import open3d

    return open3d.geometry.PointCloud(open3d.utility.Vector3dVector(gaussians.means))


def statistical(gaussians: Gaussians) -> Mask:
    """Open3D, 20 neighbours, 2 standard deviations."""
    return indexed(gaussians, open3d_cloud(gaussians).remove_statistical_outlier(20, 2.0)[1])


def radius(gaussians: Gaussians) -> Mask:
    """Open3D, 16 points within twice the cell."""
    reach = 2.0 * pitch_of(gaussians, box_of(gaussians), None)
    return indexed(gaussians, open3d_cloud(gaussians).remove_radius_outlier(16, reach)[1])


def indexed(gaussians: Gaussians, kept: Any) -> Mask:
    mask = np.zeros(len(gaussians), dtype=bool)
    mask[np.asarray(kept, dtype=np.int64)] = True  # a list, which may be empty
    return mask


def faint(gaussians: Gaussians) -> Mask:
    """Opacity of at least .1."""
    return np.asarray(gaussians.opacity() >= 0.1)


def component(gaussians: Gaussians) -> Mask:
    """Middles in the largest component (26 neighbours) of the cells that hold any of opacity .1 or more."""
    from scipy import ndimage

    box = box_of(gaussians)
    pitch = pitch_of(gaussians, box, None)
    cells = np.floor((gaussians.means - box[0]) / pitch).astype(int)
    shape = tuple(np.ceil((box[1] - box[0]) / pitch).astype(int) + 1)
    inside = ((cells >= 0) & (cells < shape)).all(axis=1)
    grid = np.zeros(shape, dtype=bool)
    solid = inside & (gaussians.opacity() >= 0.1)
    grid[tuple(cells[solid].T)] = True
    labels, _ = ndimage.label(grid, np.ones((3, 3, 3)))
    largest = np.bincount(labels.ravel())[1:].argmax() + 1
    mask: NDArray[np.bool_] = ~inside
    mask[inside] = labels[tuple(cells[inside].T)] == largest
    return mask


def ours(gaussians: Gaussians) -> Mask:
    """The shipped prior, no cameras."""
    return clean_splats(gaussians).keep


METHODS: dict[str, Callable[[Gaussians], Mask]] = {
    "unghost": ours,
    "statistical outliers": statistical,
    "radius outliers": radius,
    "opacity": faint,
    "largest component": component,
}


def row_of(name: str, seed: int, scene: Scene) -> dict[str, Any]:
    begun = time.perf_counter()
    keep = METHODS[name](scene.gaussians)
    seconds = time.perf_counter() - begun
    ghost = scene.kind > 0
    row = {
        "method": name,
        "seed": seed,
        "splats": len(keep),
        "floater_recall": float((~keep)[ghost].mean()),
        "surface_kept": float(keep[~ghost].mean()),
        "seconds": seconds,
    }
    row |= {f"recall_{kind}": float((~keep)[scene.kind == index].mean()) for index, kind in enumerate(KINDS) if index}
    say(" ".join(f"{key}={value:.3f}" if isinstance(value, float) else f"{value}" for key, value in row.items()))
    return row


def main() -> None:
    options = parse(Options, __doc__)
    rows = []
    small = make(0, dataclasses.replace(options, splats=3000))
    for method in METHODS.values():  # imports, and loading the prior, are not timed
        method(small.gaussians)
    plan = Plan(["scene"] * len(options.seeds), {"scene": options.splats / 2500})
    for seed in options.seeds:
        plan.begin("scene", f"scene {seed}, {options.splats} splats")
        scene = make(seed, options)
        rows += [row_of(name, seed, scene) for name in METHODS]
    results = build_results(rows, command=options.command(), seeds=list(options.seeds), floaters=options.floaters)
    write_results(options.out / "splats.json", results)
    wrote(options.out / "splats.json")


if __name__ == "__main__":
    main()
