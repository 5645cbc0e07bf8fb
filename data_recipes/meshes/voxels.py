"""Exact voxelisation: a voxel is occupied when a triangle meets it (separating axes, Akenine-Moller 2001).

The 13 axes of a triangle and a voxel fall into three groups: the cube's axes bound a box of voxels; the
nine cross products are edge tests within the three coordinate planes; the normal bounds the plane.
For fixed ``u`` the edge tests of plane (u, v) leave an interval of ``v``, and those of (u, w) an interval of
``w``; for fixed ``v`` those of (v, w) leave another one; for fixed (u, v) the plane leaves a third. So every
test is solved for an interval once a row, and a column of voxels is the intersection of three intervals:
only rows and occupied columns are ever looked at, all triangles of all cubes at once. ``w`` is the axis along
which the normal is steepest, so that columns are short (Schwarz and Seidel 2010).

Voxels are closed: touching a face, an edge or a corner counts, and a triangle that lies in the face between
two voxels marks both. All comparisons are exact where the corners are multiples of a power of two (which voxel
faces are, for a resolution that is a power of two); elsewhere they are off by the rounding of float64.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.errors import InvalidArgument
from ...core.frames import RESOLUTION

Array = NDArray[Any]
Occupancy = NDArray[np.bool_]

_BLOCK = 1 << 16  # columns expanded at once: bounds memory and stays within a core's cache


def _check(triangles: Array, resolution: int, caller: str) -> Array:
    triangles = np.asarray(triangles, dtype=np.float64)
    if triangles.ndim != 3 or triangles.shape[1:] != (3, 3):
        raise InvalidArgument(f"{caller}: triangles must have shape (F, 3, 3), got {triangles.shape}")
    if resolution < 1:
        raise InvalidArgument(f"{caller}: resolution must be >= 1, got {resolution}")
    if not np.isfinite(triangles).all():
        raise InvalidArgument(
            f"{caller}: triangles must be finite, got {int((~np.isfinite(triangles)).sum())} other values"
        )
    return triangles


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
    occupancy: Occupancy = _voxelize(triangles, np.zeros(len(triangles), dtype=np.intp), 1, resolution)[0]
    return occupancy


def voxelize_batch(triangles: Array, cubes: Array, count: int, *, resolution: int = RESOLUTION) -> Occupancy:
    """:func:`voxelize_triangles` for many cubes at once, at a fraction of the cost a cube.

    Args:
        triangles: ``(F, 3, 3)`` corners, each in the coordinates of its own cube.
        cubes: ``(F,)`` whole numbers in [0, count): the cube that each triangle belongs to.
        count: N, cubes; those without a triangle come out empty.
        resolution: R.

    Returns:
        ``(N, R, R, R)`` bool.

    Raises:
        ValueError: wrong shapes, values that are not finite, or cube numbers out of range.
    """
    triangles = _check(triangles, resolution, "voxelize_batch")
    cubes = np.asarray(cubes)
    if cubes.shape != triangles.shape[:1] or not np.issubdtype(cubes.dtype, np.integer):
        raise InvalidArgument(
            f"voxelize_batch: cubes must be whole numbers of shape ({len(triangles)},), got {cubes.dtype} {cubes.shape}"
        )
    if count < 0:
        raise InvalidArgument(f"voxelize_batch: count must be >= 0, got {count}")
    if len(cubes) and not 0 <= cubes.min() <= cubes.max() < count:
        raise InvalidArgument(f"voxelize_batch: cubes must lie in [0, {count}), got {cubes.min()} to {cubes.max()}")
    return _voxelize(triangles, cubes.astype(np.intp), count, resolution)


def _voxelize(triangles: Array, cubes: Array, count: int, resolution: int) -> Occupancy:
    occupancy = np.zeros((count,) + (resolution,) * 3, dtype=bool)
    corners = (triangles.transpose(2, 1, 0) + 0.5) * resolution  # (axis, corner, F); voxel i spans [i, i + 1]
    low, high = corners.min(axis=1), corners.max(axis=1)
    inside = np.flatnonzero(((high >= 0) & (low <= resolution)).all(axis=0))
    if len(inside) == 0:
        return occupancy
    corners, cubes = corners[:, :, inside], cubes[inside]
    first = np.clip(np.ceil(low[:, inside] - 1), 0, resolution - 1).astype(np.intp)
    last = np.clip(np.floor(high[:, inside]), 0, resolution - 1).astype(np.intp)
    normals = _cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    order = (np.abs(normals).argmax(axis=0) + np.array([[1], [2], [0]])) % 3  # u, v, w of every triangle
    rows = np.arange(len(inside))
    strides = np.array([resolution**2, resolution, 1])[order]
    turned = _Turned(
        corners[order[:, None], np.arange(3)[None, :, None], rows],
        normals[order, rows],
        first[order, rows],
        last[order, rows],
        strides,
        cubes * resolution**3,
    )
    columns = np.cumsum((turned.last[:2] - turned.first[:2] + 1).prod(axis=0))
    cuts = [0, *(np.flatnonzero(np.diff(columns // _BLOCK)) + 1), len(inside)]
    flat = occupancy.reshape(-1)
    for start, stop in itertools.pairwise(cuts):
        turned.part(start, stop).mark(flat)
    return occupancy


def _cross(a: Array, b: Array) -> Array:
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def _expand(counts: Array) -> tuple[Array, Array]:
    """For ``counts (N,)``: which item each of ``counts.sum()`` entries belongs to, and its number in it."""
    owner = np.repeat(np.arange(len(counts)), counts)
    starts = np.cumsum(counts) - counts
    return owner, np.arange(len(owner)) - starts[owner]


def _interval(lower: Array, upper: Array) -> tuple[Array, Array]:
    """First and last whole ``i`` with ``lower <= i + 1/2 <= upper``."""
    return np.ceil(lower - 0.5), np.floor(upper - 0.5)


def _solve_edges(p: Array, q: Array, owner: Array, middle: Array) -> tuple[Array, Array]:
    """Which ``q`` pass the edge tests of a plane (p, q) in rows at ``p = middle``.

    An edge with inward normal (np, nq) passes a voxel centred at (cp, cq) when ``np cp + nq cq >= least``: the
    voxel's corner furthest inside is not outside the edge. Three such tests and the bounding box decide whether
    a triangle and a square meet; where the triangle is a line, its edges run both ways and bound both sides.

    Args:
        p, q: ``(3, F)`` corners.
        owner: ``(N,)`` triangle of every row.
        middle: ``(N,)``, p at the middle of its voxels.

    Returns:
        First and last index along q, ``(N,)`` each, unclipped; last < first where nothing passes.
    """
    dp, dq = np.roll(p, -1, axis=0) - p, np.roll(q, -1, axis=0) - q
    turn = np.where(dp[0] * dq[1] - dq[0] * dp[1] < 0, -1.0, 1.0)
    along_p, along_q = -dq * turn, dp * turn
    half = 0.5 * (np.abs(along_p) + np.abs(along_q))
    least = np.minimum.reduce([along_p * p[corner] + along_q * q[corner] for corner in range(3)]) - half
    lower, upper = np.full(len(owner), -np.inf), np.full(len(owner), np.inf)
    for edge in range(3):
        slope = along_q[edge][owner]
        rest = least[edge][owner] - along_p[edge][owner] * middle
        bound = rest / np.where(slope == 0, 1.0, slope)
        np.maximum(lower, bound, out=lower, where=slope > 0)
        np.minimum(upper, bound, out=upper, where=slope < 0)
        upper[(slope == 0) & (rest > 0)] = -np.inf
    return _interval(lower, upper)


@dataclass(frozen=True)
class _Turned:
    """Triangles in voxel units with their axes turned to (u, v, w), w being where the normal is steepest."""

    corners: Array  # (3 axes, 3 corners, F)
    normals: Array  # (3, F)
    first: Array  # (3, F), of the bounding box within the cube
    last: Array
    strides: Array  # (3, F), in the flat occupancy
    offsets: Array  # (F,), of the cube in the flat occupancy

    def part(self, start: int, stop: int) -> _Turned:
        """Some of the triangles."""
        return _Turned(*(getattr(self, name)[..., start:stop] for name in self.__dataclass_fields__))

    def mark(self, flat: Occupancy) -> None:
        """Mark every voxel that a triangle meets, in the flat occupancy of all cubes."""
        u, v, w = self.corners
        (first_u, first_v, first_w), (last_u, last_v, last_w) = self.first, self.last
        owner, number = _expand(last_u - first_u + 1)
        iu = first_u[owner] + number
        v_first, v_last = _solve_edges(u, v, owner, iu + 0.5)
        w_first, w_last = _solve_edges(u, w, owner, iu + 0.5)
        v_first = np.maximum(v_first, first_v[owner]).astype(np.intp)
        v_last = np.minimum(v_last, last_v[owner])
        w_first, w_last = np.maximum(w_first, first_w[owner]), np.minimum(w_last, last_w[owner])

        counts = v_last - v_first + 1
        counts = np.where((counts > 0) & (w_last >= w_first), counts, 0).astype(np.intp)
        row, number = _expand(counts)
        triangle, iv = owner[row], v_first[row] + number
        below, above = self._plane(owner, iu + 0.5, row, triangle, iv + 0.5)
        other_first, other_last, place = self._other_rows(v, w, triangle, iv)
        bottom = np.maximum(np.maximum(below, w_first[row]), other_first[place])
        top = np.minimum(np.minimum(above, w_last[row]), other_last[place])

        su, sv, sw = self.strides
        hit = np.flatnonzero(top >= bottom)
        row, triangle, iv, bottom, top = row[hit], triangle[hit], iv[hit], bottom[hit].astype(np.intp), top[hit]
        base = (self.offsets[owner] + iu * su[owner])[row] + iv * sv[triangle] + bottom * sw[triangle]
        column, step = _expand((top - bottom).astype(np.intp) + 1)
        flat[base[column] + step * sw[triangle][column]] = True

    def _plane(
        self, owner: Array, u_middle: Array, row: Array, triangle: Array, v_middle: Array
    ) -> tuple[Array, Array]:
        """First and last voxel of columns that the planes of the triangles pass, unclipped."""
        nu, nv, nw = np.where(self.normals[2] < 0, -self.normals, self.normals)
        flat = nw == 0  # no area: the plane says nothing
        half = 0.5 * (np.abs(nu) + np.abs(nv) + nw)
        levels = nu * self.corners[0] + nv * self.corners[1] + nw * self.corners[2]  # (3, F), equal but for rounding
        half = np.where(flat, np.inf, half)
        reach = np.stack([levels.min(axis=0) - half, levels.max(axis=0) + half])
        safe = np.where(flat, 1.0, nw)[triangle]
        rest = (reach[:, owner] - nu[owner] * u_middle)[:, row] - nv[triangle] * v_middle
        return _interval(rest[0] / safe, rest[1] / safe)

    def _other_rows(self, v: Array, w: Array, triangle: Array, iv: Array) -> tuple[Array, Array, Array]:
        """Intervals of w in the rows of plane (v, w), and the row of each column ``(triangle, iv)``."""
        spans = self.last[1] - self.first[1] + 1
        owner, number = _expand(spans)
        found = _solve_edges(v, w, owner, self.first[1][owner] + number + 0.5)
        return *found, (np.cumsum(spans) - spans - self.first[1])[triangle] + iv


def voxelize_triangles_slowly(triangles: Array, resolution: int = RESOLUTION) -> Occupancy:
    """The same by the book: every triangle, every voxel, all 13 axes. The oracle of the tests."""
    triangles = _check(triangles, resolution, "voxelize_triangles_slowly")
    occupancy = np.zeros((resolution,) * 3, dtype=bool)
    x, y, z = np.meshgrid(*[np.arange(resolution) + 0.5] * 3, indexing="ij", sparse=True)
    units = np.eye(3)
    for triangle in (triangles + 0.5) * resolution:
        edges = np.roll(triangle, -1, axis=0) - triangle
        axes = [*units, np.cross(edges[0], edges[1])] + [np.cross(unit, edge) for unit in units for edge in edges]
        meets: Occupancy = np.ones_like(occupancy)
        for axis in axes:
            center, half = axis[0] * x + axis[1] * y + axis[2] * z, np.abs(axis).sum() / 2
            corners = triangle @ axis
            meets &= (corners.min() <= center + half) & (corners.max() >= center - half)
        occupancy |= meets
    return occupancy
