"""What a harvested cube is stored with: the opacity about it, and how many photos saw each of its voxels."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.aabb import contains
from ..core.cameras import Cameras
from ..core.frames import RESOLUTION, cube_lattices, unit_lattice
from ..core.occupancy import EMPTY, opacity_from_density, signed_from_opacity
from ..core.shards import MAX_VIEW_COUNT, SURROUNDINGS_EDGE, SURROUNDINGS_RESOLUTION

DensityFn = Callable[[NDArray[Any]], NDArray[np.float32]]
POOLED = 2  # points along an axis of each voxel of the surroundings


def signed_opacity(
    density_fn: DensityFn,
    lattice: NDArray[np.float64],
    pitch: NDArray[np.float64],
    aabb: NDArray[np.float64],
) -> NDArray[np.float32]:
    """Signed opacity at the points of some cubes, empty outside the box.

    Args:
        density_fn: ``(M, 3)`` float32 to ``(M,)``, per scene unit.
        lattice: ``(N, R, R, R, 3)``.
        pitch: ``(N,)``, what a cell is taken to measure, scene units.
        aabb: ``(2, 3)``.

    Returns:
        ``(N, R, R, R)`` float32 in [-1, 1].
    """
    density = density_fn(lattice.reshape(-1, 3).astype(np.float32)).reshape(lattice.shape[:-1])
    signed: NDArray[np.float32] = signed_from_opacity(opacity_from_density(density, pitch[:, None, None, None]))
    signed = signed.astype(np.float32)
    signed[~contains(aabb, lattice)] = EMPTY
    return signed


def surroundings(
    density_fn: DensityFn,
    centers: NDArray[np.float64],
    edges: NDArray[np.float64],
    rotations: NDArray[np.float64],
    pitch: NDArray[np.float64],
    aabb: NDArray[np.float64],
) -> NDArray[np.float32]:
    """The mean signed opacity of 16^3 voxels over a cube of three times the edge, same centre and rotation.

    Such a voxel is six of the cube's wide, several cells of the field, so that one point would miss a surface
    or take it for the whole voxel: each is the mean over 2 x 2 x 2 points.

    Args:
        density_fn, pitch, aabb: as :func:`signed_opacity` has them.
        centers, edges, rotations: ``(N, 3)``, ``(N,)``, ``(N, 3, 3)`` of the cubes (not of their surroundings).

    Returns:
        ``(N, 16, 16, 16)`` float32 in [-1, 1].
    """
    coarse = SURROUNDINGS_RESOLUTION
    lattice = cube_lattices(centers, SURROUNDINGS_EDGE * edges, rotations, resolution=POOLED * coarse)
    signed = signed_opacity(density_fn, lattice, pitch, aabb)
    blocks = signed.reshape(len(signed), coarse, POOLED, coarse, POOLED, coarse, POOLED)
    pooled: NDArray[np.float32] = blocks.mean(axis=(2, 4, 6))
    return pooled


def frustum_normals(cameras: Cameras) -> NDArray[np.float64]:
    """The four sides of each frustum ``(N, 4, 3)``: a point ``p`` is in view if ``(p - origin) . normal >= 0`` for all.

    That is the definition of :meth:`Cameras.project` for pinholes: with the depth ``d`` along the optical axis,
    ``0 <= fx x / d + cx <= width`` becomes ``fx x + cx d >= 0`` and ``(width - cx) d - fx x >= 0``; their sum says
    that ``d >= 0``. Likewise for the rows.

    Raises:
        ValueError: a camera has distortion; its field of view has no flat sides.
    """
    if cameras.distortion.any():
        raise ValueError("frustum_normals: cameras must have no distortion")
    fx, fy, cx, cy = cameras.intrinsics.T
    zero = np.zeros_like(fx)
    local = np.array([
        [fx, zero, -cx], [-fx, zero, cx - cameras.width], [zero, -fy, -cy], [zero, fy, cy - cameras.height],
    ])  # fmt: skip
    normals: NDArray[np.float64] = np.einsum("nab,sbn->nsa", cameras.camera_to_world[:, :, :3], local)
    return normals


def count_views(
    cameras: Cameras, centers: NDArray[np.float64], edges: NDArray[np.float64], rotations: NDArray[np.float64]
) -> NDArray[np.uint8]:
    """How many cameras have each voxel of some cubes in view: ``(N, 32, 32, 32)`` uint8, at most 255.

    It is :meth:`Cameras.view_count` without depth: whoever cleans a field knows its cameras, not what was hidden
    from them. Along a side of a frustum everything is linear, so that a cube wholly within or beyond a side is
    settled at once; on 32^3 voxels and pinholes this is some fifty times as fast.

    Args:
        cameras: those of the photos, as the field was told.
        centers, edges, rotations: ``(N, 3)``, ``(N,)``, ``(N, 3, 3)``, scene units.
    """
    counts = np.zeros((len(centers), *(RESOLUTION,) * 3), dtype=np.int64)
    if cameras.distortion.any():
        for index in range(len(centers)):
            counts[index] = cameras.view_count(cube_lattices(centers[[index]], edges[[index]], rotations[[index]])[0])
        return np.minimum(counts, MAX_VIEW_COUNT).astype(np.uint8)
    normals, axis = frustum_normals(cameras), unit_lattice()[:, 0, 0, 0]
    for index, (center, edge, rotation) in enumerate(zip(centers, edges, rotations)):
        middle = ((center - cameras.origins)[:, None] * normals).sum(axis=-1)  # (cameras, 4): value at the centre
        slope = normals @ rotation * edge  # (cameras, 4, 3): change across the cube, along each of its axes
        reach = np.abs(slope).sum(axis=-1) * axis[-1]
        for camera in np.flatnonzero((middle + reach >= 0).all(axis=1)):
            inside = np.ones((RESOLUTION,) * 3, dtype=bool)
            for side in np.flatnonzero(middle[camera] < reach[camera]):
                x, y, z = slope[camera, side][:, None] * axis
                inside &= (middle[camera, side] + x)[:, None, None] + y[:, None] + z >= 0
            counts[index] += inside
    return np.minimum(counts, MAX_VIEW_COUNT).astype(np.uint8)
