"""Exact voxelisation: a voxel is occupied when a triangle meets it (separating axes, Akenine-Moller 2001).

For one triangle the 13 axes fall into three groups: the three cube axes bound a box of voxels; the nine
cross products depend on two coordinates only; the normal gives, for each column of voxels along its
dominant axis, an interval of at most a few voxels (Schwarz and Seidel 2010). So only the voxels of those
intervals are ever looked at, all triangles at once.
"""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.frames import RESOLUTION

Array = NDArray[Any]
Occupancy = NDArray[np.bool_]

_BLOCK = 1 << 21  # columns expanded at once, which bounds memory


def _check(triangles: Array, resolution: int, caller: str) -> Array:
    triangles = np.asarray(triangles, dtype=np.float64)
    if triangles.ndim != 3 or triangles.shape[1:] != (3, 3):
        raise ValueError(f"{caller}: triangles must have shape (F, 3, 3), got {triangles.shape}")
    if resolution < 1:
        raise ValueError(f"{caller}: resolution must be >= 1, got {resolution}")
    if not np.isfinite(triangles).all():
        raise ValueError(f"{caller}: triangles must be finite, got {int((~np.isfinite(triangles)).sum())} other values")
    return triangles


def _expand(counts: Array) -> tuple[Array, Array]:
    """For ``counts (N,)``: which item each of ``counts.sum()`` entries belongs to, and its number in it."""
    owner = np.repeat(np.arange(len(counts)), counts)
    starts = np.cumsum(counts) - counts
    return owner, np.arange(len(owner)) - starts[owner]


class _EdgeTests:
    """The nine cross-product axes of every triangle, as three edge tests in each coordinate plane.

    In the plane (u, v) an edge with normal (nu, nv), turned inwards, passes a voxel centred at (cu, cv) when
    ``nu cu + nv cv >= least``: the voxel's corner furthest inside is not outside the edge. The edge's other
    bound is the opposite vertex, moved out by the same half width.
    """

    def __init__(self, triangles: Array) -> None:
        edges = np.roll(triangles, -1, axis=1) - triangles
        self.planes: list[tuple[Array, Array, Array, Array]] = []
        for axis in range(3):
            u, v = (axis + 1) % 3, (axis + 2) % 3
            nu, nv = -edges[..., v], edges[..., u]  # (F, 3)
            values = nu[:, :, None] * triangles[:, None, :, u] + nv[:, :, None] * triangles[:, None, :, v]
            half = 0.5 * (np.abs(nu) + np.abs(nv))
            self.planes.append((nu, nv, values.min(axis=2) - half, values.max(axis=2) + half))

    def passes(self, axis: int, owner: Array, cu: Array, cv: Array) -> Occupancy:
        """Whether voxels at ``(cu, cv) (N,)`` of the plane across ``axis`` pass triangle ``owner (N,)``'s tests."""
        nu, nv, low, high = self.planes[axis]
        result: Occupancy = np.ones(len(owner), dtype=bool)
        for edge in range(3):
            value = nu[owner, edge] * cu + nv[owner, edge] * cv
            result &= (value >= low[owner, edge]) & (value <= high[owner, edge])
        return result


def voxelize_triangles(triangles: Array, resolution: int = RESOLUTION) -> Occupancy:
    """Voxels that a triangle touches, exactly (closed voxels: touching a face counts).

    Args:
        triangles: ``(F, 3, 3)`` corners in cube coordinates, the cube being [-1/2, 1/2]^3; triangles may
            reach beyond it or lie outside. Triangles without area (needles, points) count as what they are.
        resolution: R.

    Returns:
        ``(R, R, R)`` bool, index order ``[x, y, z]``.

    Raises:
        ValueError: wrong shape, or values that are not finite.
    """
    triangles = _check(triangles, resolution, "voxelize_triangles")
    occupancy = np.zeros((resolution,) * 3, dtype=bool)
    corners = (triangles + 0.5) * resolution  # voxel i spans [i, i + 1]
    low, high = corners.min(axis=1), corners.max(axis=1)
    inside = np.flatnonzero(((high >= 0) & (low <= resolution)).all(axis=1))
    if len(inside) == 0:
        return occupancy
    corners, low, high = corners[inside], low[inside], high[inside]
    first = np.clip(np.ceil(low - 1), 0, resolution - 1).astype(np.int64)
    last = np.clip(np.floor(high), 0, resolution - 1).astype(np.int64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    dominant = np.abs(normals).argmax(axis=1)
    for axis in range(3):
        chosen = np.flatnonzero(dominant == axis)
        across = [(axis + 1) % 3, (axis + 2) % 3]
        columns = np.prod(last[chosen][:, across] - first[chosen][:, across] + 1, axis=1)
        blocks = np.split(chosen, np.flatnonzero(np.diff(np.cumsum(columns) // _BLOCK)) + 1)
        for block in blocks:
            if len(block):
                _mark(occupancy, axis, corners[block], normals[block], first[block], last[block])
    return occupancy


def _mark(occupancy: Occupancy, axis: int, corners: Array, normals: Array, first: Array, last: Array) -> None:
    """Mark the voxels of triangles whose normals are steepest along ``axis``, in voxel units."""
    u, v = (axis + 1) % 3, (axis + 2) % 3
    tests = _EdgeTests(corners)
    span_u, span_v = last[:, u] - first[:, u] + 1, last[:, v] - first[:, v] + 1
    owner, number = _expand(span_u * span_v)
    iu, iv = first[owner, u] + number // span_v[owner], first[owner, v] + number % span_v[owner]
    kept = tests.passes(axis, owner, iu + 0.5, iv + 0.5)
    owner, iu, iv = owner[kept], iu[kept], iv[kept]

    steep = normals[:, axis]
    flat = steep == 0  # no area: the plane says nothing
    safe = np.where(flat, 1.0, steep)
    level = np.einsum("fi,fi->f", normals, corners[:, 0])
    middle = (level[owner] - normals[owner, u] * (iu + 0.5) - normals[owner, v] * (iv + 0.5)) / safe[owner]
    half = (0.5 * np.abs(normals).sum(axis=1) / np.abs(safe))[owner]
    bottom = np.where(flat[owner], -np.inf, np.ceil(middle - half - 0.5))
    top = np.where(flat[owner], np.inf, np.floor(middle + half - 0.5))
    bottom, top = np.maximum(bottom, first[owner, axis]), np.minimum(top, last[owner, axis])
    column, step = _expand(np.maximum(top - bottom + 1, 0).astype(np.int64))
    owner, iu, iv, iw = owner[column], iu[column], iv[column], bottom[column].astype(np.int64) + step
    kept = tests.passes(u, owner, iv + 0.5, iw + 0.5) & tests.passes(v, owner, iw + 0.5, iu + 0.5)
    index: list[Array] = [iu, iu, iu]
    index[u], index[v], index[axis] = iu[kept], iv[kept], iw[kept]
    occupancy[index[0], index[1], index[2]] = True


def voxelize_triangles_slowly(triangles: Array, resolution: int = RESOLUTION) -> Occupancy:
    """The same by the book: every triangle, every voxel, all 13 axes. The oracle of the tests."""
    triangles = _check(triangles, resolution, "voxelize_triangles_slowly")
    occupancy = np.zeros((resolution,) * 3, dtype=bool)
    units = np.eye(3)
    for triangle in (triangles + 0.5) * resolution:
        edges = np.roll(triangle, -1, axis=0) - triangle
        axes = [*units, np.cross(edges[0], edges[1])] + [np.cross(unit, edge) for unit in units for edge in edges]
        for index in itertools.product(range(resolution), repeat=3):
            moved = triangle - (np.array(index) + 0.5)
            occupancy[index] |= all(
                (moved @ axis).min() <= np.abs(axis).sum() / 2 and (moved @ axis).max() >= -np.abs(axis).sum() / 2
                for axis in axes
            )
    return occupancy
