"""Axis-aligned boxes ``(2, 3)``: corner of the smallest coordinates, corner of the largest."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .arrays import to_numpy
from .errors import InvalidArgument

FloatArray = NDArray[np.float64]


def as_aabb(aabb: ArrayLike | Any, *, caller: str = "as_aabb") -> FloatArray:
    """Validate a box and return it as float64 ``(2, 3)``, in scene units.

    Raises:
        ValueError: wrong shape, a value that is not finite, or min >= max on some axis.
    """
    box = np.array(to_numpy(aabb), dtype=np.float64)
    if box.shape != (2, 3):
        raise InvalidArgument(f"{caller}: aabb must have shape (2, 3), got {box.shape}")
    if not np.isfinite(box).all():
        raise InvalidArgument(f"{caller}: aabb must be finite, got {box.tolist()}")
    if not (box[0] < box[1]).all():
        axis = "xyz"[int(np.argmax(box[0] >= box[1]))]
        raise InvalidArgument(f"{caller}: aabb must have min < max on every axis, {axis} fails in {box.tolist()}")
    return box


def scene_extent(aabb: ArrayLike) -> float:
    """Longest side of the box, in scene units: the denominator of every ``edge_fraction``."""
    box = as_aabb(aabb, caller="scene_extent")
    return float((box[1] - box[0]).max())


def contains(aabb: ArrayLike, positions: NDArray[Any]) -> NDArray[np.bool_]:
    """Which ``positions (..., 3)`` lie in the closed box; result ``(...)``."""
    box = as_aabb(aabb, caller="contains")
    inside: NDArray[np.bool_] = ((positions >= box[0]) & (positions <= box[1])).all(axis=-1)
    return inside
