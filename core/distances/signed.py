"""Signed distances of simple solids, in the solid's own coordinates: negative inside, positive outside.

Every function takes ``positions (..., 3)`` and returns ``(...)``, in the unit of the positions.
All are exact Euclidean distances except where the docstring says "bound": then the value never
exceeds the true distance in magnitude (safe for sphere tracing) and has its sign and its zero set.
Formulas follow the well-known derivations of I. Quilez, "3D SDFs".
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Distances = NDArray[Any]


def _length(vectors: Distances) -> Distances:
    result: Distances = np.sqrt(np.einsum("...i,...i->...", vectors, vectors))
    return result


def half_space(positions: NDArray[Any], normal: ArrayLike, offset: float) -> Distances:
    """Points with ``normal . p <= offset`` are inside; ``normal`` is normalised here."""
    direction = np.asarray(normal, dtype=np.float64)
    result: Distances = positions @ (direction / np.linalg.norm(direction)) - offset
    return result


def sphere(positions: NDArray[Any], radius: float) -> Distances:
    """Ball around the origin."""
    return _length(positions) - radius


def ellipsoid(positions: NDArray[Any], radii: ArrayLike) -> Distances:
    """Bound: ``k0 (k0 - 1) / k1``, scaled so that it never overestimates for aspect ratios up to 4."""
    axes = np.asarray(radii, dtype=np.float64)
    k0 = _length(positions / axes)
    k1 = _length(positions / axes**2)
    outside = k0 * (k0 - 1.0) / np.maximum(k1, 1e-12)
    return np.where(k0 < 1.0, (k0 - 1.0) * axes.min(), np.minimum(outside, _length(positions)) * 0.7)


def box(positions: NDArray[Any], half_extents: ArrayLike) -> Distances:
    """Axis-aligned box around the origin."""
    q = np.abs(positions) - np.asarray(half_extents, dtype=np.float64)
    result: Distances = _length(np.maximum(q, 0.0)) + np.minimum(q.max(axis=-1), 0.0)
    return result


def rounded_box(positions: NDArray[Any], half_extents: ArrayLike, radius: float) -> Distances:
    """Box whose edges are rounded by ``radius`` (part of the half extents)."""
    return box(positions, np.asarray(half_extents, dtype=np.float64) - radius) - radius


def _from_profile(radial: Distances, axial: Distances) -> Distances:
    """2D box distance from the two signed excesses."""
    outside = np.hypot(np.maximum(radial, 0.0), np.maximum(axial, 0.0))
    result: Distances = outside + np.minimum(np.maximum(radial, axial), 0.0)
    return result


def cylinder(positions: NDArray[Any], radius: float, half_height: float) -> Distances:
    """Solid cylinder along z."""
    return _from_profile(_length(positions[..., :2]) - radius, np.abs(positions[..., 2]) - half_height)


def tube(positions: NDArray[Any], radius: float, thickness: float, half_height: float) -> Distances:
    """Open pipe along z: wall of ``thickness`` centred on ``radius``."""
    radial = np.abs(_length(positions[..., :2]) - radius) - thickness / 2
    return _from_profile(radial, np.abs(positions[..., 2]) - half_height)


def capsule(positions: NDArray[Any], start: ArrayLike, end: ArrayLike, radius: float) -> Distances:
    """Ball of ``radius`` swept from ``start`` to ``end`` (both ``(3,)``)."""
    a, b = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    axis = b - a
    along = np.clip((positions - a) @ axis / max(float(axis @ axis), 1e-30), 0.0, 1.0)
    return _length(positions - a - along[..., None] * axis) - radius


def torus(positions: NDArray[Any], major: float, minor: float) -> Distances:
    """Ring around z: circle of radius ``major``, thickness radius ``minor``."""
    result: Distances = np.hypot(_length(positions[..., :2]) - major, positions[..., 2]) - minor
    return result


def cone(positions: NDArray[Any], radius: float, height: float) -> Distances:
    """Solid cone along z: base of ``radius`` at z = 0, apex at z = ``height``."""
    radial, z = _length(positions[..., :2]), positions[..., 2]
    side = np.array([radius, -height], dtype=np.float64)  # from apex to rim, in (radial, axial)
    offset = np.stack([radial, z - height], axis=-1)
    along = np.clip(offset @ side / (side @ side), 0.0, 1.0)
    to_side = _length(offset - along[..., None] * side)
    to_base = np.hypot(np.maximum(radial - radius, 0.0), z)
    inside = (z > 0) & (z < height) & (radial < radius * (1.0 - z / height))
    nearest = np.minimum(to_side, to_base)
    return np.where(inside, -nearest, nearest)


def polyline_tube(positions: NDArray[Any], points: NDArray[Any], radius: float) -> Distances:
    """Ball of ``radius`` swept along ``points (n >= 2, 3)``."""
    return union([capsule(positions, start, end, radius) for start, end in itertools.pairwise(points)])


def union(distances: Sequence[Distances]) -> Distances:
    """Bound inside, exact outside."""
    return np.minimum.reduce(list(distances))


def difference(solid: Distances, cut: Distances) -> Distances:
    """Bound: ``solid`` without ``cut``."""
    return np.maximum(solid, -cut)


def shell(distance: Distances, thickness: float) -> Distances:
    """The wall of ``thickness`` centred on a solid's surface."""
    return np.abs(distance) - thickness / 2


def smooth_union(first: Distances, second: Distances, radius: float) -> Distances:
    """Bound: union with a fillet of about ``radius`` (polynomial smooth minimum)."""
    blend = np.maximum(radius - np.abs(first - second), 0.0) / radius
    return np.minimum(first, second) - blend**2 * radius / 4
