"""How well the training photos see a place through the field itself: the share of light that the best of them gets.

A ghost hangs in space that photos look through; what lies behind a surface is seen by none, and a surface by some. So
this tells more of a voxel than its opacity does. For every camera a coarse fan of rays is followed once through the
field; a place is then looked up between four of those rays. numpy only; no gradient.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..cameras import Cameras
from ..errors import InvalidArgument
from ..interpolate import interpolate_grid

FAN = (32, 24)  # rays across and down a photo
STEPS = 96  # samples along a ray
CLEARANCE = 1.5  # field cells before a place that do not count: what is there does not hide itself
QUERY = 1 << 18  # points asked at a time

DensityFn = Callable[[NDArray[Any]], NDArray[Any]]


@dataclass(frozen=True)
class TransmittanceMaps:
    """What is left of the light along a fan of rays from each of ``N`` cameras.

    Attributes:
        cameras: those of the photos.
        columns, rows: pixel coordinates ``(X,)`` and ``(Y,)`` of the rays, ascending; ``(N, X)`` and ``(N, Y)`` of
            cameras that differ in size.
        through: ``(N, Y, X, STEPS + 1)`` float32 in [0, 1], at distances ``0, step, 2 step, ...`` along a ray.
        step: ``(N,)``, scene units.
        clearance: scene units.
    """

    cameras: Cameras
    columns: NDArray[np.float64]
    rows: NDArray[np.float64]
    through: NDArray[np.float32]
    step: NDArray[np.float64]
    clearance: float

    @classmethod
    def build(
        cls, density_fn: DensityFn, cameras: Cameras, *, aabb: NDArray[np.float64], field_pitch: float
    ) -> TransmittanceMaps:
        """Follow the rays.

        Args:
            density_fn: ``(M, 3)`` float32 to ``(M,)`` or ``(M, 1)``, per scene unit, >= 0. Also asked outside ``aabb``,
                between a camera and the box.
            cameras: ``N`` of them, >= 0.
            aabb: ``(2, 3)``; rays end where the last of it could be.
            field_pitch: side of the field's cells, > 0.

        Raises:
            ValueError: a pitch that is not finite and > 0, or densities that are NaN or negative.
        """
        if not 0 < field_pitch < np.inf:
            raise InvalidArgument(f"TransmittanceMaps: field_pitch must be finite and > 0, got {field_pitch}")
        across, down = _fan(cameras)
        corners = np.stack(np.meshgrid(*np.asarray(aabb, dtype=np.float64).T, indexing="ij"), axis=-1).reshape(-1, 3)
        reach = np.linalg.norm(corners[None] - cameras.origins[:, None], axis=2).max(axis=1, initial=0.0)
        step = reach / STEPS
        height, width = down.shape[-1], across.shape[-1]
        through = np.ones((len(cameras), height, width, STEPS + 1), dtype=np.float32)
        for index in range(len(cameras)):
            origins, directions = _fan_rays(cameras, index, across, down)
            distance = (np.arange(STEPS) + 0.5) * step[index]
            points = (origins[:, None] + distance[:, None] * directions[:, None]).reshape(-1, 3).astype(np.float32)
            parts = [np.asarray(density_fn(points[i : i + QUERY])).reshape(-1) for i in range(0, len(points), QUERY)]
            density = np.concatenate(parts).astype(np.float64).reshape(height, width, STEPS)
            if not (density >= 0).all():
                raise InvalidArgument(
                    f"TransmittanceMaps: density must be >= 0, {int((~(density >= 0)).sum())} are not"
                )
            depth = np.cumsum(np.minimum(density * step[index], 1e3), axis=2)
            through[index, ..., 1:] = np.exp(-depth)
        return cls(cameras, across, down, through, step, CLEARANCE * field_pitch)

    def best_view(self, positions: NDArray[np.floating]) -> NDArray[np.float32]:
        """The largest share of light ``(...)`` in [0, 1] that a camera gets from ``positions (..., 3)``.

        0 where no camera has a place in its frustum, 1 beside a camera.
        """
        points = np.asarray(positions, dtype=np.float64).reshape(-1, 3)
        best = np.zeros(len(points), dtype=np.float32)
        for index in range(len(self.cameras)):
            pixels, _, visible = self.cameras.project(index, points)
            chosen = np.flatnonzero(visible)
            if not len(chosen):
                continue
            distance = np.linalg.norm(points[chosen] - self.cameras.origins[index], axis=1) - self.clearance
            best[chosen] = np.maximum(best[chosen], self._look_up(index, pixels[chosen], distance))
        return best.reshape(np.shape(positions)[:-1])

    def _look_up(self, index: int, pixels: NDArray[np.float64], distance: NDArray[np.float64]) -> NDArray[np.float32]:
        """Trilinear between the four rays about ``pixels (n, 2)`` and the two samples about ``distance (n,)``."""
        _, height, width, _ = self.through.shape
        columns, rows = (each if each.ndim == 1 else each[index] for each in (self.columns, self.rows))
        row = np.interp(pixels[:, 1], rows, np.arange(height))
        column = np.interp(pixels[:, 0], columns, np.arange(width))
        places = np.stack([row, column, distance / self.step[index]], axis=1)
        result: NDArray[np.float32] = np.minimum(interpolate_grid(self.through[index], places), np.float32(1.0))
        return result


def _fan(cameras: Cameras) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Pixel coordinates of the rays: across and down, at pixel centres unless the cameras differ in size."""
    if not cameras.same_size:
        across, down = ((np.arange(count) + 0.5) * size[:, None] / count for count, size in zip(FAN, cameras.sizes.T))
        return across, down
    columns, rows = (
        np.unique(np.floor((np.arange(count) + 0.5) * size / count)) + 0.5
        for count, size in zip(FAN, (cameras.width, cameras.height))
    )
    return columns, rows


def _fan_rays(
    cameras: Cameras, index: int, across: NDArray[np.float64], down: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Origins and directions ``(Y * X, 3)`` of one camera's rays, row by row."""
    if not cameras.same_size:
        pixels = np.stack(np.meshgrid(across[index], down[index]), axis=-1)
        origins, directions = cameras.rays(index, pixels.reshape(-1, 2))
        return origins, directions
    rows, columns = (each.astype(np.int64) for each in (down, across))
    origins, directions = (part[np.ix_(rows, columns)].reshape(-1, 3) for part in cameras.rays(index))
    return origins, directions
