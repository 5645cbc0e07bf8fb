"""Cubes cut out of meshes: choosing where they lie, and cutting many at once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ...core.frames import RESOLUTION, CubeFrame, random_rotations
from ..recipe import Recipe
from ..solids.compose import draw_offset, random_dilation
from ..solids.primitives import log_uniform
from .voxels import voxelize_batch

if TYPE_CHECKING:
    from .library import Mesh

Occupancy = NDArray[np.bool_]

_BEYOND = 1.8  # longer than the diagonal of a box of longest side 1


def choose_frame(rng: np.random.Generator, mesh: Mesh, recipe: Recipe) -> CubeFrame:
    """Where a cube of a mesh lies, in the mesh's normalised coordinates.

    The edge is log-uniform; the centre a point uniform in area, moved as the recipe says (on the surface, near
    it, away from it); the rotation uniform on SO(3). A share of the cubes lies beside the mesh, truly empty.
    """
    fraction = log_uniform(rng, *recipe.edge_fraction)
    empty = rng.random() < recipe.empty_share
    point, normal = mesh.surface_point(rng)
    center = point + draw_offset(rng, recipe, normal) * fraction
    rotation = random_rotations(rng, 1)[0]
    if empty:
        center = center + rotation[:, 0] * (_BEYOND + fraction)
    return CubeFrame(center, fraction, rotation)


def cut_cubes(mesh: Mesh, frames: Sequence[CubeFrame], *, resolution: int = RESOLUTION) -> Occupancy:
    """Exact occupancy of a mesh's surface in many cubes, ``(N, R, R, R)`` bool.

    Cubes of one call share its overhead: 16 at a time cost a third of what they cost one by one.
    """
    if len(frames) == 0:
        return np.zeros((0,) + (resolution,) * 3, dtype=bool)
    centers = np.stack([frame.center for frame in frames])
    reaches = np.stack([np.abs(frame.rotation).sum(axis=1) * (frame.edge_length / 2) for frame in frames])
    cubes, rows = mesh.tree.touching(centers - reaches, centers + reaches)
    ends = np.searchsorted(cubes, np.arange(len(frames) + 1))
    soup = mesh.triangles[rows]
    for frame, start, stop in zip(frames, ends[:-1], ends[1:]):
        soup[start:stop] = frame.to_local(soup[start:stop])
    return voxelize_batch(soup, cubes, len(frames), resolution=resolution)


def sample_mesh_cubes(
    rngs: Sequence[np.random.Generator], mesh: Mesh, recipe: Recipe
) -> tuple[Occupancy, list[CubeFrame]]:
    """One clean cube of a mesh from each generator; sample i of a batch equals sample i alone.

    Returns:
        ``occupancy (N, 32, 32, 32)`` bool, dilated 0 to ``recipe.max_dilation`` times; the cubes in the mesh's
        normalised coordinates, where an edge length is an edge fraction.
    """
    frames = [choose_frame(rng, mesh, recipe) for rng in rngs]
    occupancy = cut_cubes(mesh, frames)
    for row, rng in enumerate(rngs):
        occupancy[row] = random_dilation(rng, occupancy[row], recipe.max_dilation)
    return occupancy, frames
