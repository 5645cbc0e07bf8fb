"""How fast cubes are made, beside slicing and voxelising with trimesh and beside open3d's voxel grid.

    OMP_NUM_THREADS=1 python -m benchmarks.data.curate             (about four minutes on two idle cores)
    OMP_NUM_THREADS=1 python -m benchmarks.data.curate --quick     (half a minute, for a look)
    OMP_NUM_THREADS=1 python -m benchmarks.data.curate --short     (the same with fewer cubes, into out/short)

Mesh rows cut cubes of a generated bumpy ball: edges log-uniform, from choosing where the cube lies to its packed
bits, no corruption. ``mesh/trimesh`` slices the mesh at the six faces of the cube and voxelises the rest, as the
published pipeline did before its external binary; ``mesh/open3d`` is given the cube's own triangles, found by our
tree, and pays for its voxel grid alone. ``procedural/every-voxel`` asks the same objects' distance at all voxels.
``csg/unghost`` builds boolean trees, cuts 64 cubes out of each and fills some. Every row says how its cubes agree with
ours (``iou``), and ours are compared with the 13 separating axes by the book, those of solids with winding numbers,
before anything is timed. ``milliseconds`` is processor time a cube; ``cubes_per_second`` wall time of all workers.
Writes curate.json and curate.png.
"""

from __future__ import annotations

import dataclasses
import multiprocessing
import resource
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from unghost.core.results import build_results, write_results
from unghost.data_recipes.meshes.crops import sample_mesh_cubes
from unghost.data_recipes.meshes.library import Mesh
from unghost.data_recipes.recipe import Recipe

from ..options import BenchmarkOptions, parse
from ..progress import Plan, say, wrote
from .cube_makers import (
    FACES,
    RECIPE,
    SEED,
    TOGETHER,
    Packed,
    ball,
    bumpy_ball,
    check_meshes,
    check_solids,
    every_voxel,
    generators,
    our_meshes,
    our_procedural,
    our_solids,
    pack,
    undilated,
    with_open3d,
    with_trimesh,
)

SWEEP_FACES = (1_000, 4_000, 16_000, 70_000, 250_000, 1_000_000)
SWEEP_EDGES = (0.01, 0.02, 0.04, 0.07, 0.1, 0.2)


@dataclass(frozen=True)
class Options(BenchmarkOptions):
    """What to measure.

    Attributes:
        workers: processes.
        cubes: of the rows of this project; the others make fewer, as many as their speed allows.
        quick: a tenth of all cubes, and no mesh of more than 70,000 faces.
    """

    SHORT: ClassVar[dict[str, Any]] = {"quick": True, "cubes": 1600}

    workers: int = 2
    cubes: int = 16_000
    quick: bool = False


def agreement(found: Packed, expected: Packed) -> float:
    """Mean IoU of the cubes that are not empty in both."""
    a, b = np.unpackbits(found, axis=1).astype(bool), np.unpackbits(expected, axis=1).astype(bool)
    either = (a | b).sum(axis=1)
    return float(((a & b).sum(axis=1)[either > 0] / either[either > 0]).mean())


def timed(method: Callable[[int, int], Packed], start: int, stop: int) -> tuple[Packed, float, float]:
    """Cubes, processor seconds, and the process's peak memory in megabytes."""
    before = time.process_time()
    cubes = method(start, stop)
    spent = time.process_time() - before
    unit = 1e6 if sys.platform == "darwin" else 1e3
    return cubes, spent, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit


@dataclass(frozen=True)
class Contender:
    """A way of making cubes: at what share of ours it is asked, and what it should agree with."""

    name: str
    method: Callable[[int, int], Packed]
    share: float
    same_as: Callable[[int, int], Packed]
    least_iou: float
    faces: int | None = None


CONTENDERS = (
    Contender("mesh/unghost", our_meshes, 1.0, our_meshes, 1.0, FACES),
    Contender("mesh/trimesh", with_trimesh, 0.01, undilated, 0.8, FACES),
    Contender("mesh/open3d", with_open3d, 0.01, undilated, 0.95, FACES),
    Contender("procedural/unghost", our_procedural, 1.0, our_procedural, 1.0),
    Contender("procedural/every-voxel", every_voxel, 0.1, our_procedural, 0.9999),
    Contender("csg/unghost", our_solids, 0.25, our_solids, 1.0),
)


def warm_up(method: Callable[[int, int], Packed], barrier: Any) -> None:
    """In a worker: load everything, then wait for the others."""
    method(0, 2)
    barrier.wait(timeout=600)


def measure(contender: Contender, options: Options) -> dict[str, Any]:
    """One row: fresh workers, warm ones, then the clock."""
    count = max(2 * options.workers, round(options.cubes * contender.share))
    length = max(1, min(256, count // (4 * options.workers)))
    bounds = [(contender.method, start, min(start + length, count)) for start in range(0, count, length)]
    context = multiprocessing.get_context("spawn")
    barrier = context.Barrier(options.workers + 1)
    with context.Pool(options.workers, warm_up, (contender.method, barrier)) as pool:
        barrier.wait(timeout=600)
        before = time.perf_counter()
        made = pool.starmap(timed, bounds, chunksize=1)
        wall = time.perf_counter() - before
    cubes = np.concatenate([part for part, _, _ in made])
    checked = min(count, 200)
    iou = agreement(cubes[:checked], np.concatenate([contender.same_as(i, i + 1) for i in range(checked)]))
    assert iou >= contender.least_iou, f"{contender.name}: IoU {iou}"
    spent, peak = sum(cpu for _, cpu, _ in made), max(memory for _, _, memory in made)
    return {
        "method": contender.name,
        "workers": options.workers,
        "cubes": count,
        "faces": contender.faces,
        "cubes_per_second": count / wall,
        "milliseconds": spent / count * 1e3,
        "peak_megabytes": peak,
        "iou": iou,
    }


def sweep(mesh: Mesh, recipe: Recipe, cubes: int) -> float:
    """Processor milliseconds a cube, one thread."""
    sample_mesh_cubes(generators(0, TOGETHER), mesh, recipe)
    before = time.process_time()
    for start in range(0, cubes, TOGETHER):
        pack(sample_mesh_cubes(generators(start, start + TOGETHER), mesh, recipe)[0])
    return (time.process_time() - before) / (-(-cubes // TOGETHER) * TOGETHER) * 1e3


def sweeps(options: Options, cubes: int) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    for faces in SWEEP_FACES:
        if options.quick and faces > FACES:
            continue
        soup = bumpy_ball(faces)
        before = time.process_time()
        mesh = Mesh.from_triangles(soup)
        seconds = time.process_time() - before
        held = [mesh.triangles, mesh.normals, mesh.cumulative_areas, mesh.tree.rows, *mesh.tree.levels]
        rows.append(
            {
                "method": "mesh/unghost",
                "sweep": "faces",
                "faces": len(mesh.triangles),
                "seconds": seconds,
                "megabytes": sum(array.nbytes for array in held) / 1e6,
                "milliseconds": sweep(mesh, RECIPE, cubes),
            }
        )
    for edge in SWEEP_EDGES:
        found = sweep(ball(), dataclasses.replace(RECIPE, edge_fraction=(edge, edge)), cubes)
        rows.append({"method": "mesh/unghost", "sweep": "edge_fraction", "edge_fraction": edge, "milliseconds": found})
    return rows


def plot(rows: Sequence[dict[str, Any]], path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 3.6), layout="constrained")
    for axes, key, label in zip(figure.subplots(1, 2), ("faces", "edge_fraction"), ("faces", "edge fraction")):
        points = [(row[key], row["milliseconds"]) for row in rows if row.get("sweep") == key]
        axes.loglog(*zip(*points), marker="o", label="unghost")
        for row in rows:
            if row["method"] in ("mesh/trimesh", "mesh/open3d"):
                axes.axhline(row["milliseconds"], linestyle=":", color="grey")
                axes.annotate(f"{row['method'][5:]}, {FACES:,} faces", (points[0][0], row["milliseconds"]), fontsize=8)
        axes.set(xlabel=label, ylabel="processor milliseconds a cube")
    figure.savefig(path, dpi=120)


def main() -> None:
    options = parse(Options, __doc__)
    command = options.command()
    if options.quick:
        options = dataclasses.replace(options, cubes=options.cubes // 10)
    say("checking cubes of meshes and of solids")
    check_meshes(6 if options.quick else 24)
    check_solids(4 if options.quick else 16)
    rows, plan = list[dict[str, Any]](), Plan(["row"] * (len(CONTENDERS) + 1), {"row": options.cubes / 500})
    for contender in CONTENDERS:
        plan.begin("row", contender.name)
        rows.append(measure(contender, options))
    plan.begin("row", "sweeps over faces and edge fractions")
    rows += sweeps(options, max(TOGETHER, options.cubes // 16))
    options.out.mkdir(parents=True, exist_ok=True)
    write_results(options.out / "curate.json", build_results(rows, command=command, seeds=[SEED]))
    plot(rows, options.out / "curate.png")
    for row in rows:
        say(" ".join(f"{k}={v:.3g}" if isinstance(v, float) else f"{k}={v}" for k, v in row.items()))
    wrote(options.out / "curate.json", options.out / "curate.png")


if __name__ == "__main__":
    main()
