"""Signed distances of further solids, beside those of ``core.signed_distance``: negative inside.

Every function takes positions ``(..., 3)`` or their coordinates and returns ``(...)``, in the unit of the
positions. The solids are exact Euclidean distances, inside and outside, except where the docstring says
"exact outside": then the inside value is a bound (never more than the distance, and of the right sign).
They are written coordinate by coordinate: with positions whose axes come first in memory
(``(3, N)`` transposed) that is several times as fast as summing over a last axis.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[Any]

_ELLIPSOID_STEPS = 60
_AT_ONCE = 1 << 13  # positions times edges, which stays within a core's cache


def total(terms: Iterable[Array]) -> Array:
    """Sum of at least one array."""
    result: Array = functools.reduce(operator.add, terms)
    return result


def extrude(plane: Array, axial: Array, half: float) -> Array:
    """A plane figure's distances ``(...)`` extruded along an axis: ``axial (...)`` runs from -half to half.

    Example:
        >>> extrude(np.array([-1.0, 3.0]), np.array([0.0, 6.0]), 2.0).tolist()
        [-1.0, 5.0]
    """
    over = np.abs(axial) - half
    outside = np.sqrt(np.maximum(plane, 0.0) ** 2 + np.maximum(over, 0.0) ** 2)
    result: Array = outside + np.minimum(np.maximum(plane, over), 0.0)
    return result


def corner(offsets: list[Array]) -> Array:
    """Common part of half-spaces at right angles, given their signed distances."""
    squares = total(np.maximum(offset, 0.0) ** 2 for offset in offsets)
    result: Array = np.sqrt(squares) + np.minimum(np.maximum.reduce(offsets), 0.0)
    return result


def wedge(u: Array, v: Array, angle: float) -> Array:
    """Plane angle of ``angle`` radians, in (0, pi), around the positive u axis.

    Example:
        >>> wedge(np.array([1.0]), np.array([-1.0]), np.pi / 2).round(3).tolist()
        [0.0]
    """
    cosine, sine = np.cos(angle / 2), np.sin(angle / 2)
    height = np.abs(v)
    along = np.maximum(u * cosine + height * sine, 0.0)
    side = height * cosine - u * sine  # > 0 outside
    result: Array = np.copysign(np.hypot(u - along * cosine, height - along * sine), side)
    return result


def ellipsoid(positions: Array, radii: ArrayLike) -> Array:
    """Ellipsoid of ``radii (3,)``, its own axes.

    The nearest point is ``r_i^2 p_i / (t + r_i^2)`` with ``|(r_i p_i / (t + r_i^2))_i| = 1``; t by Newton's method on
    the reciprocal of that norm, which is almost straight (Hebden's trick), started below the root.

    Example:
        >>> ellipsoid(np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]]), [0.5, 0.5, 0.5]).round(6).tolist()
        [-0.5, 1.5]
    """
    axes = np.asarray(radii, dtype=np.float64)[:, None]
    squares = axes**2
    points = np.maximum(np.abs(np.moveaxis(positions, -1, 0).reshape(3, -1)), 1e-9 * axes.min())
    lifted = points * axes
    t = (lifted - squares).max(axis=0)
    for _ in range(4):
        t, miss = _ellipsoid_step(t, lifted, squares)
    rows = np.flatnonzero(miss > 1e-6)  # their squares are left, but for a few points in the principal planes
    for _ in range(_ELLIPSOID_STEPS):
        if len(rows) == 0:
            break
        t[rows], miss = _ellipsoid_step(t[rows], lifted[:, rows], squares)
        rows = rows[miss > 1e-6]
    result: Array = t * np.sqrt(((points / (t + squares)) ** 2).sum(axis=0))
    return result.reshape(positions.shape[:-1])


def _ellipsoid_step(t: Array, lifted: Array, squares: Array) -> tuple[Array, Array]:
    """One step of t, and how far the norm was from 1 before it (the error after it is about its square)."""
    inverse = 1.0 / (t + squares)
    terms = (lifted * inverse) ** 2
    norms = terms.sum(axis=0)
    miss = np.sqrt(norms) - 1.0
    return t + miss * norms / (terms * inverse).sum(axis=0), np.abs(miss)


def _edge_blocks(points: Array, coordinate: Array) -> Iterator[tuple[Array, Array]]:
    """Starts and ends of edges, ``(D, k, 1, ..)`` to broadcast; all at once for few positions, else one by one."""
    count = max(1, _AT_ONCE // max(coordinate.size, 1))
    shape = (points.shape[1], -1, *(1,) * coordinate.ndim)
    for first in range(0, len(points) - 1, count):
        block = points[first : first + count + 1].T
        yield block[:, :-1].reshape(shape), block[:, 1:].reshape(shape)


def polyline(coordinates: list[Array], points: Array) -> Array:
    """Unsigned distance to the segments between consecutive ``points (n >= 2, D)``; D coordinates ``(...)``.

    Example:
        >>> polyline([np.array([0.5]), np.array([2.0])], np.array([[0.0, 0.0], [1.0, 0.0]])).tolist()
        [2.0]
    """
    nearest: Array = np.full(coordinates[0].shape, np.inf)
    for start, end in _edge_blocks(points, coordinates[0]):
        axis = end - start
        offsets = [c - s for c, s in zip(coordinates, start)]
        along = total(o * a for o, a in zip(offsets, axis / np.maximum((axis**2).sum(axis=0), 1e-30)))
        along = np.minimum(np.maximum(along, 0.0), 1.0)
        squares = total((o - along * a) ** 2 for o, a in zip(offsets, axis))
        nearest = np.minimum(nearest, squares.min(axis=0))
    result: Array = np.sqrt(nearest)
    return result


def polygon(u: Array, v: Array, points: Array) -> Array:
    """Closed simple polygon ``points (n, 2)``; a point is inside when a ray from it crosses oddly many edges.

    Example:
        >>> square = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
        >>> polygon(np.array([0.0, 3.0]), np.array([0.0, 0.0]), square).tolist()
        [-1.0, 2.0]
    """
    closed = np.concatenate([points, points[:1]])
    inside = np.zeros(u.shape, dtype=bool)
    for (u0, v0), (u1, v1) in _edge_blocks(closed, u):
        rise = v1 - v0
        slope = (u1 - u0) / np.where(rise == 0, 1.0, rise)  # no ray crosses a level edge
        crosses = ((v0 > v) != (v1 > v)) & (u - u0 < slope * (v - v0))
        inside ^= np.logical_xor.reduce(crosses, axis=0)
    distance = polyline([u, v], closed)
    return np.where(inside, -distance, distance)


def bent_sheet(positions: Array, radius: float, half_angle: float, half_width: float, thickness: float) -> Array:
    """Sheet bent about y around ``(0, ., radius)``, touching the origin, with rounded rims.

    Args:
        radius: of the bend; more than half the thickness.
        half_angle: in (0, pi), on each side of the origin.
        half_width: along y.
        thickness: everywhere.
    """
    x, down = np.abs(positions[..., 0]), radius - positions[..., 2]
    sine, cosine = np.sin(half_angle), np.cos(half_angle)
    beyond = x * cosine > down * sine  # past the end of the arc
    if half_angle > np.pi / 2:
        beyond &= down < 0
    elif half_angle == np.pi / 2:
        beyond = down < 0
    else:
        beyond |= down < 0
    tip = np.sqrt((x - radius * sine) ** 2 + (down - radius * cosine) ** 2)
    arc = np.where(beyond, tip, np.abs(np.sqrt(x**2 + down**2) - radius))
    over = np.maximum(np.abs(positions[..., 1]) - half_width, 0.0)
    result: Array = np.sqrt(arc**2 + over**2) - thickness / 2
    return result


def _folded(coordinate: Array, pitch: float, reach: float) -> Array:
    """Distance along one axis to the nearest of the nodes at whole pitches within ``reach`` of 0."""
    result: Array = np.abs(coordinate - pitch * np.clip(np.round(coordinate / pitch), -reach, reach))
    return result


def lattice(positions: Array, pitch: float, half_bar: float, reach: int) -> Array:
    """Square bars along all three axes through the nodes ``-reach .. reach``, and no further.

    A point is within the endless lattice when two of its three distances to the nearest nodes are at most
    ``half_bar``. What is not lattice is what is not endless lattice, and what is beyond its hull.
    """
    hull = pitch * reach + half_bar
    near = [_folded(positions[..., axis], pitch, reach) - half_bar for axis in range(3)]
    out = [np.maximum(value, 0.0) ** 2 for value in near]
    past = [np.abs(positions[..., axis]) - hull for axis in range(3)]
    over = [np.maximum(value, 0.0) ** 2 for value in past]
    outside = np.sqrt(
        np.minimum(np.minimum(over[0] + out[1] + out[2], out[0] + over[1] + out[2]), out[0] + out[1] + over[2])
    )
    high = np.maximum(np.maximum(near[0], near[1]), near[2])
    middle = np.maximum(np.minimum(near[0], near[1]), np.minimum(np.maximum(near[0], near[1]), near[2]))
    inside = np.sqrt(np.minimum(middle, 0.0) ** 2 + np.minimum(high, 0.0) ** 2)
    inside = np.minimum(inside, -np.maximum(np.maximum(past[0], past[1]), past[2]))
    result: Array = np.where(outside > 0, outside, -inside)
    return result


def studs(positions: Array, pitch: float, radius: float, sunk: float, reach: int) -> Array:
    """Ground below z = 0 with balls at ``z = -sunk`` on a square grid of nodes ``-reach .. reach``; exact outside."""
    x, y = (_folded(positions[..., axis], pitch, reach) for axis in range(2))
    z = positions[..., 2]
    result: Array = np.minimum(z, np.sqrt(x**2 + y**2 + (z + sunk) ** 2) - radius)
    return result
