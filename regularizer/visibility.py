"""Points for the visibility loss, and which of them too few cameras see. numpy only."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.aabb import as_aabb
from ..core.cameras import Cameras
from ..core.errors import InvalidArgument
from .view_grid import OPEN, ViewGrid

FloatArray = NDArray[np.float64]
PointKind = Literal["mixed", "rays", "uniform"]

SAMPLES_PER_RAY = 32


def grow_box(aabb: ArrayLike, reach: float) -> FloatArray:
    """The box ``reach`` times as wide about its centre; ``reach`` >= 1."""
    box = as_aabb(aabb, caller="grow_box")
    if not (np.isfinite(reach) and reach >= 1.0):
        raise InvalidArgument(f"grow_box: reach must be finite and >= 1, got {reach}")
    middle, half = box.mean(axis=0), (box[1] - box[0]) / 2
    return np.stack([middle - half * reach, middle + half * reach])


def camera_sphere(cameras: Cameras) -> tuple[FloatArray, float]:
    """Centre ``(3,)`` and radius of a sphere round all camera centres (tight up to the choice of centre)."""
    middle = (cameras.origins.min(axis=0) + cameras.origins.max(axis=0)) / 2
    return middle, float(np.linalg.norm(cameras.origins - middle, axis=1).max())


def ray_points(rng: np.random.Generator, count: int, *, cameras: Cameras, aabb: ArrayLike) -> FloatArray:
    """Points on rays that start on a sphere round the cameras and pass through the scene and out again.

    As in the paper; departures: the rays aim at a random place in the middle half of the box rather than
    all at its centre, points are uniform along the ray (a callable has no proposal sampler), and they stay
    in ``aabb``, because a field need not be defined elsewhere: pass a larger box to go farther.

    Returns:
        ``(count, 3)``, scene units.
    """
    box = as_aabb(aabb, caller="ray_points")
    middle, radius = camera_sphere(cameras)
    n_rays = -(-count // SAMPLES_PER_RAY)
    outward = rng.normal(size=(n_rays, 3))
    starts = middle + radius * outward / np.linalg.norm(outward, axis=1, keepdims=True)
    aims = box.mean(axis=0) + (rng.random((n_rays, 3)) - 0.5) * (box[1] - box[0]) / 2
    along = aims - starts
    flat = np.abs(along) < 1e-12 * (box[1] - box[0])
    along = np.where(flat, 1e-12 * (box[1] - box[0]), along)
    crossings = (box[:, None] - starts) / along  # parameters 0 at the start, 1 at the aim
    enter = np.maximum(crossings.min(axis=0).max(axis=1), 0.0)
    leave = crossings.max(axis=0).min(axis=1)
    fraction = rng.random((n_rays, SAMPLES_PER_RAY))
    parameter = enter[:, None] + fraction * (leave - enter)[:, None]
    points = starts[:, None] + parameter[..., None] * along[:, None]
    return np.clip(points.reshape(-1, 3)[:count], box[0], box[1])


def visibility_points(
    rng: np.random.Generator, count: int, *, aabb: ArrayLike, cameras: Cameras, kind: PointKind = "mixed"
) -> FloatArray:
    """Where to ask whether a camera looks: on rays (:func:`ray_points`), uniform in the box, or half of each.

    Returns:
        ``(count, 3)``, scene units.
    """
    box = as_aabb(aabb, caller="visibility_points")
    shares = {"mixed": 0.5, "rays": 1.0, "uniform": 0.0}
    if kind not in shares:
        raise InvalidArgument(f"visibility_points: kind must be one of {sorted(shares)}, got {kind!r}")
    if len(cameras) == 0:
        raise InvalidArgument("visibility_points: cameras must not be empty")
    n_ray_points = round(shares[kind] * count)
    uniform = box[0] + rng.random((count - n_ray_points, 3)) * (box[1] - box[0])
    if n_ray_points == 0:
        return uniform
    return np.concatenate([ray_points(rng, n_ray_points, cameras=cameras, aabb=box), uniform])


class ViewCounter:
    """Counts views up to ``min_views`` and no further: points that are seen enough leave the race early.

    The answer to "seen by fewer than ``min_views``" is exactly that of :meth:`Cameras.view_count`. Cameras
    are asked in the order that settled most points so far, which fixed cameras make worth remembering. In a box
    that is known beforehand most cells are settled once and for all (:class:`.view_grid.ViewGrid`).

    Args:
        cameras: fixed.
        min_views: where counting stops, >= 1.
        aabb: ``(2, 3)``, where most points will be; None for no cells.
        depth_maps: ``(cameras, height, width)`` depth along the optical axis, inf for nothing: a point that something
            hides from a camera is not seen by it. Of cameras that differ in size, a list of ``(height, width)``.
        tolerance: relative, of that comparison.
    """

    def __init__(
        self,
        cameras: Cameras,
        *,
        min_views: int = 1,
        aabb: ArrayLike | None = None,
        depth_maps: NDArray[Any] | Sequence[NDArray[Any]] | None = None,
        tolerance: float = 0.05,
    ) -> None:
        if min_views < 1:
            raise InvalidArgument(f"ViewCounter: min_views must be >= 1, got {min_views}")
        self.min_views, self.tolerance = int(min_views), tolerance
        self._depth = None if depth_maps is None else _checked(depth_maps, cameras)
        box = None if aabb is None else as_aabb(aabb, caller="ViewCounter")
        self._grid = None if box is None else ViewGrid(cameras, box, min_views=self.min_views)
        self._cameras = cameras
        self._settled = np.zeros(len(cameras))

    def __call__(self, positions: NDArray[Any]) -> NDArray[np.int64]:
        """``min(view count, min_views)`` for ``positions (N, 3)``; ``(N,)``."""
        points = np.asarray(positions, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 3:
            raise InvalidArgument(f"ViewCounter: positions must have shape (N, 3), got {points.shape}")
        counts = np.zeros(len(points), dtype=np.int64)
        open_ = np.arange(len(points))
        if self._grid is not None:
            counts = self._grid.count(points)
            open_ = np.flatnonzero(counts == OPEN if self._depth is None else counts != 0)
            counts[open_] = 0
        for index in np.argsort(-self._settled, kind="stable"):
            if open_.size == 0:
                break
            depth = None if self._depth is None else self._depth[index : index + 1]
            seen = self._cameras.select(index).view_count(points[open_], depth_maps=depth, tolerance=self.tolerance)
            self._settled[index] += seen.mean()
            counts[open_] += seen
            open_ = open_[counts[open_] < self.min_views]
        return counts


def _checked(
    depth_maps: NDArray[Any] | Sequence[NDArray[Any]], cameras: Cameras
) -> NDArray[Any] | Sequence[NDArray[Any]]:
    """One array on the cameras' canvas, or of cameras that differ in size a list of arrays of their sizes."""
    if cameras.same_size or isinstance(depth_maps, np.ndarray):
        shape = (len(cameras), *cameras.canvas)
        if np.shape(depth_maps) != shape:
            raise InvalidArgument(f"ViewCounter: depth_maps must have shape {shape}, got {np.shape(depth_maps)}")
        return np.asarray(depth_maps)
    shapes = [np.shape(depth) for depth in depth_maps]
    wanted = [(int(height), int(width)) for width, height in cameras.sizes]
    if shapes != wanted:
        wrong = next(
            (k for k, pair in enumerate(zip(shapes, wanted)) if pair[0] != pair[1]), min(len(shapes), len(wanted))
        )
        raise InvalidArgument(
            f"ViewCounter: depth_maps must be a map (height, width) for each of the {len(wanted)} cameras, "
            f"got {len(shapes)}; the first that differs is number {wrong}"
        )
    return [np.asarray(depth) for depth in depth_maps]
