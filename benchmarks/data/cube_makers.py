"""The ways of making cubes that ``curate.py`` compares, ours and the rivals': ``(start, stop)`` to packed bits."""

from __future__ import annotations

import dataclasses
from functools import lru_cache
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from unghost.core.frames import RESOLUTION, CubeFrame, unit_lattice
from unghost.data_recipes.meshes.crops import choose_frame, cut_cubes, sample_mesh_cubes
from unghost.data_recipes.meshes.library import Mesh
from unghost.data_recipes.meshes.voxels import voxelize_triangles_slowly
from unghost.data_recipes.recipe import load_recipe
from unghost.data_recipes.solids import compose, csg

SEED = 3
TOGETHER = 16
FACES = 70_000
RECIPE = dataclasses.replace(load_recipe("meshes"), edge_fraction=(0.01, 0.1))
PROCEDURAL = load_recipe("procedural")
CSG = load_recipe("csg")

Occupancy = NDArray[np.bool_]
Packed = NDArray[np.uint8]


def bumpy_ball(faces: int) -> NDArray[np.float64]:
    """About ``faces`` triangles ``(F, 3, 3)`` of a ball with bumps: a cube's faces, gridded and blown up."""
    count = max(1, round(np.sqrt(faces / 12)))
    axis = np.tan(np.linspace(-np.pi / 4, np.pi / 4, count + 1))
    u, v = np.meshgrid(axis, axis, indexing="ij")
    soup = []
    for side in range(6):
        sign = 1.0 if side % 2 else -1.0
        grid = np.roll(np.stack([np.full_like(u, sign), sign * u, v], axis=-1), side // 2, axis=-1)
        way = grid / np.linalg.norm(grid, axis=-1, keepdims=True)
        x, y, z = np.moveaxis(way, -1, 0)
        bumps = 0.12 * np.sin(5 * x) * np.sin(4 * y + 1) + 0.05 * np.sin(17 * x) * np.sin(15 * y) * np.sin(13 * z)
        points = way * (1.0 + bumps + 0.01 * np.sin(41 * (x + y)) * np.sin(37 * z))[..., None]
        a, b, c, d = points[:-1, :-1], points[1:, :-1], points[1:, 1:], points[:-1, 1:]
        soup += [np.stack(corners, axis=-2).reshape(-1, 3, 3) for corners in ((a, b, c), (a, c, d))]
    return np.concatenate(soup)


@lru_cache(maxsize=1)
def ball(faces: int = FACES) -> Mesh:
    return Mesh.from_triangles(bumpy_ball(faces))


def generators(start: int, stop: int) -> list[np.random.Generator]:
    return [np.random.default_rng([SEED, index]) for index in range(start, stop)]


def pack(occupancy: Occupancy) -> Packed:
    return np.packbits(occupancy.reshape(len(occupancy), -1), axis=1)


def our_meshes(start: int, stop: int) -> Packed:
    parts = range(start, stop, TOGETHER)
    return np.concatenate(
        [pack(sample_mesh_cubes(generators(i, min(i + TOGETHER, stop)), ball(), RECIPE)[0]) for i in parts]
    )


def our_procedural(start: int, stop: int) -> Packed:
    return np.concatenate([pack(compose.sample_cube(rng, PROCEDURAL)[0][None]) for rng in generators(start, stop)])


def our_solids(start: int, stop: int) -> Packed:
    """Boolean trees, 64 cubes of each, from building the tree to the packed bits."""
    parts = [range(i, min(i + TOGETHER, stop)) for i in range(start, stop, TOGETHER)]
    made = [csg.csg_cubes_at(generators(part.start, part.stop), CSG, part, SEED) for part in parts]
    return pack(np.stack([cube for part in made for cube, _, _ in part]))


def every_voxel(start: int, stop: int) -> Packed:
    """The same objects and cubes, their distance asked at every voxel."""

    def plainly(distance: Any, *, thickness: float, solid: bool) -> Occupancy:
        values = distance(unit_lattice().reshape(-1, 3)).reshape((RESOLUTION,) * 3)
        shell = compose.shell_from_distance(values.astype(np.float32), thickness=thickness)
        return shell | (values < 0) if solid else shell

    with patch.object(compose, "shell_in_cube", plainly):
        return our_procedural(start, stop)


def frames(start: int, stop: int) -> list[CubeFrame]:
    return [choose_frame(rng, ball(), RECIPE) for rng in generators(start, stop)]


def undilated(start: int, stop: int) -> Packed:
    return pack(cut_cubes(ball(), frames(start, stop)))


@lru_cache(maxsize=1)
def welded_ball() -> Any:
    """The ball as trimesh holds a mesh read from a file: corners shared."""
    import trimesh

    return trimesh.Trimesh(**trimesh.triangles.to_kwargs(ball().triangles), process=True)


def with_trimesh(start: int, stop: int) -> Packed:
    import trimesh

    cubes = np.zeros((stop - start,) + (RESOLUTION,) * 3, dtype=bool)
    for cube, frame in zip(cubes, frames(start, stop)):
        vertices, faces = np.asarray(welded_ball().vertices), np.asarray(welded_ball().faces)
        for axis, side in ((axis, side) for axis in range(3) for side in (-1.0, 1.0)):
            normal = frame.rotation[:, axis] * side
            origin = frame.center - normal * frame.edge_length / 2
            vertices, faces = trimesh.intersections.slice_faces_plane(vertices, faces, normal, origin)[:2]
        if len(faces) == 0:
            continue
        lattice = frame.to_local(vertices) * RESOLUTION + (RESOLUTION - 1) / 2  # trimesh's: centres at whole numbers
        grid = trimesh.Trimesh(lattice, faces, process=False).voxelized(pitch=1.0)
        index = np.rint(grid.points).astype(int)
        cube[tuple(index[((index >= 0) & (index < RESOLUTION)).all(axis=1)].T)] = True
    return pack(cubes)


def with_open3d(start: int, stop: int) -> Packed:
    import open3d

    cubes = np.zeros((stop - start,) + (RESOLUTION,) * 3, dtype=bool)
    corner = np.full(3, 0.5)
    for cube, frame in zip(cubes, frames(start, stop)):
        reach = np.abs(frame.rotation).sum(axis=1) * frame.edge_length / 2
        rows = ball().tree.touching((frame.center - reach)[None], (frame.center + reach)[None])[1]
        soup = frame.to_local(ball().triangles[rows]).reshape(-1, 3)
        mesh = open3d.geometry.TriangleMesh(
            open3d.utility.Vector3dVector(soup), open3d.utility.Vector3iVector(np.arange(len(soup)).reshape(-1, 3))
        )
        grid = open3d.geometry.VoxelGrid.create_from_triangle_mesh_within_bounds(mesh, 1 / RESOLUTION, -corner, corner)
        index = np.array([voxel.grid_index for voxel in grid.get_voxels()], dtype=np.int64).reshape(-1, 3)
        cube[tuple(index[((index >= 0) & (index < RESOLUTION)).all(axis=1)].T)] = True  # it goes on beyond its bounds
    return pack(cubes)


def check_meshes(count: int) -> None:
    """Cubes of the ball, of few triangles and of many, against the 13 axes; a batch against one by one."""
    drawn = sorted(frames(0, 40 * count), key=lambda frame: frame.edge_length)[::40][:count]
    for cube, frame in zip(cut_cubes(ball(), drawn), drawn):
        reach = np.full((1, 3), frame.edge_length)
        rows = ball().tree.touching(frame.center - reach, frame.center + reach)[1]
        assert np.array_equal(cube, voxelize_triangles_slowly(frame.to_local(ball().triangles[rows])))
        assert np.array_equal(cube, cut_cubes(ball(), [frame])[0])


def winding_numbers(triangles: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """How often a closed mesh ``(F, 3, 3)`` winds about each of ``points (N, 3)``: its solid angles, summed."""
    sums = np.zeros(len(points))
    for row, point in enumerate(points):
        a, b, c = np.moveaxis(triangles - point, 1, 0)
        i, j, k = (np.linalg.norm(side, axis=1) for side in (a, b, c))
        above = np.einsum("fi,fi->f", a, np.cross(b, c))
        below = i * j * k + (a * b).sum(1) * k + (b * c).sum(1) * i + (c * a).sum(1) * j
        sums[row] = np.arctan2(above, below).sum() / (2 * np.pi)
    return sums


def check_solids(count: int) -> None:
    """Cubes of boolean trees: their surface against the 13 axes, what is filled against winding numbers."""
    plain = dataclasses.replace(CSG, max_dilation=0, empty_share=0.0, edge_fraction=(0.05, 0.2), cubes_per_mesh=2)
    for index in range(count):
        shell, full = (
            csg.csg_cubes_at(generators(index, index + 1), dataclasses.replace(plain, solid_share=share), [index], SEED)
            for share in (0.0, 1.0)
        )
        (surface, frame, number), (filled, _, _) = *shell, *full
        rng = np.random.default_rng([SEED, number, csg.STREAM])
        closed = csg.ClosedMesh.from_solid(csg.random_solid(rng))
        assert np.array_equal(surface, voxelize_triangles_slowly(frame.to_local(closed.mesh.triangles)))
        assert (filled >= surface).all()
        places = rng.choice(np.flatnonzero(~surface), size=40)
        inside = winding_numbers(closed.triangles, frame.lattice().reshape(-1, 3)[places]) > 0.5
        assert np.array_equal(filled.reshape(-1)[places], inside)
