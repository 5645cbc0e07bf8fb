"""Depth along a pixel's unit ray, and depth along the camera's optical axis.

Views that differ in size stand on one canvas (:attr:`~unghost.core.cameras.Cameras.canvas`).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.cameras import Cameras
from ...core.errors import InvalidArgument


def optical_depth(depth: NDArray[Any], cameras: Cameras) -> NDArray[np.float64]:
    """Distance along unit rays ``(n, H, W)`` to depth along the optical axis: times the cosine."""
    return np.asarray(depth, dtype=np.float64) * _cosines("optical_depth", depth, cameras)


def ray_depth(depth: NDArray[Any], cameras: Cameras) -> NDArray[np.float64]:
    """Inverse of :func:`optical_depth`."""
    return np.asarray(depth, dtype=np.float64) / _cosines("ray_depth", depth, cameras)


def _cosines(caller: str, depth: NDArray[Any], cameras: Cameras) -> NDArray[np.float64]:
    """Of each pixel's ray with the optical axis ``(n, H, W)``; 1 beside a view that is smaller than the canvas."""
    shape = (len(cameras), *cameras.canvas)
    if np.shape(depth) != shape:
        raise InvalidArgument(f"{caller}: depth must have shape {shape}, got {np.shape(depth)}")
    cosines = np.ones(shape)
    for index in range(len(cameras)):
        cosines[index][cameras.window(index)] = cameras.rays(index)[1] @ -cameras.camera_to_world[index, :, 2]
    return cosines
