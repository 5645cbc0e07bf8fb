"""Sparse points of a structure-from-motion model, with the cameras that observed each: measured by matching."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .arrays import to_numpy
from .cameras import Cameras
from .errors import InvalidArgument

FloatArray = NDArray[np.float64]

PIXEL_NOISE = 0.5  # pixels: a keypoint is not localised better than this, whatever the reprojection error
LEAST_IN_VIEW = 0.5  # share of the observations that must project into their photo


@dataclass(frozen=True)
class SparsePoints:
    """``P`` points with ``M`` observations.

    Attributes:
        xyz: ``(P, 3)``, scene units.
        point: ``(M,)`` index of the observed point.
        camera: ``(M,)`` index of the observing camera.
        error: ``(P,)`` mean reprojection error, pixels; NaN where unknown.
        uncertainty: ``(P,)`` standard deviation in the worst direction, which lies along the rays, scene units;
            inf where the rays do not determine it (fewer than two, or parallel), NaN where no cameras were given.

    Example:
        >>> from unghost.core.cameras import look_at
        >>> poses = look_at(np.array([[2.0, 0.0, 0.0], [0.0, 2.0, 0.0]]), np.zeros((2, 3)))
        >>> cameras = Cameras.create(poses, np.array([100.0, 100.0, 50.0, 50.0]), width=100, height=100)
        >>> points = SparsePoints.create(np.zeros((1, 3)), point=[0, 0], camera=[0, 1], cameras=cameras)
        >>> len(points), points.uncertainty.round(3).tolist()  # half a pixel at distance 2 is 0.01
        (1, [0.01])
    """

    xyz: FloatArray
    point: NDArray[np.int64]
    camera: NDArray[np.int64]
    error: FloatArray
    uncertainty: FloatArray

    @classmethod
    def create(
        cls,
        xyz: ArrayLike,
        *,
        point: ArrayLike = (),
        camera: ArrayLike = (),
        cameras: Cameras | None = None,
        error: ArrayLike | None = None,
    ) -> SparsePoints:
        """Validate points and observations; repeated observations count once.

        Args:
            xyz: ``(P, 3)``, finite, scene units.
            point: ``(M,)`` indices into ``xyz``; empty for points without tracks, which support but cross nothing.
            camera: ``(M,)`` indices into ``cameras``.
            cameras: the cameras, in the frame of ``xyz``: their indices are checked and the uncertainty follows.
            error: ``(P,)`` reprojection error, pixels, >= 0; None if unknown.

        Raises:
            InvalidArgument: a wrong shape, a coordinate that is not finite, an index out of range, an error < 0.
        """
        places = np.array(to_numpy(xyz), dtype=np.float64)
        if places.ndim != 2 or places.shape[1] != 3:
            raise InvalidArgument(f"SparsePoints: xyz must have shape (P, 3), got {places.shape}")
        if not np.isfinite(places).all():
            bad = int((~np.isfinite(places)).any(axis=1).sum())
            raise InvalidArgument(f"SparsePoints: xyz must be finite, got {bad} of {len(places)} points that are not")
        of_point, of_camera = _indices("point", point, len(places)), _indices("camera", camera, None)
        if of_point.shape != of_camera.shape:
            raise InvalidArgument(
                f"SparsePoints: point and camera must have one length, got {len(of_point)} and {len(of_camera)}"
            )
        if cameras is not None and of_camera.size and of_camera.max() >= len(cameras):
            raise InvalidArgument(
                f"SparsePoints: camera must be < {len(cameras)}, the number of cameras, got {of_camera.max()}"
            )
        pairs = np.unique(np.stack([of_point, of_camera], axis=1), axis=0).reshape(-1, 2)
        off = np.full(len(places), np.nan) if error is None else np.array(to_numpy(error), dtype=np.float64)
        if off.shape != (len(places),) or (off < 0).any():
            raise InvalidArgument(f"SparsePoints: error must be ({len(places)},) values >= 0, got shape {off.shape}")
        result = cls(places, pairs[:, 0].copy(), pairs[:, 1].copy(), off, np.full(len(places), np.nan))
        if cameras is None:
            return result
        return cls(result.xyz, result.point, result.camera, result.error, _uncertainty(result, cameras))

    def __len__(self) -> int:
        return len(self.xyz)

    def views(self) -> NDArray[np.int64]:
        """Number of cameras that observed each point, ``(P,)``."""
        return np.bincount(self.point, minlength=len(self)).astype(np.int64)

    def select(self, points: NDArray[Any]) -> SparsePoints:
        """Keep some points: a mask ``(P,)`` or unique indices; observations of the others go."""
        chosen = np.arange(len(self))[np.asarray(points)]
        renumber = np.full(len(self), -1)
        renumber[chosen] = np.arange(len(chosen))
        stays = renumber[self.point] >= 0
        return SparsePoints(
            self.xyz[chosen],
            renumber[self.point[stays]],
            self.camera[stays],
            self.error[chosen],
            self.uncertainty[chosen],
        )

    def of(self, cameras: Cameras, indices: ArrayLike, *, least_views: int = 2) -> SparsePoints:
        """Keep the observations by some cameras, renumbered to their positions in ``indices``.

        A convenience, not a leak-proof split: the positions were adjusted with all photos. Triangulate again from the
        training photos alone for anything that is scored.

        Args:
            cameras: all cameras that ``camera`` refers to.
            indices: ``(n,)`` unique indices of cameras.
            least_views: points with fewer observations left are dropped.
        """
        chosen = np.asarray(indices, dtype=np.int64)
        renumber = np.full(len(cameras), -1)
        renumber[chosen] = np.arange(len(chosen))
        stays = renumber[self.camera] >= 0
        part = SparsePoints(
            self.xyz, self.point[stays], renumber[self.camera[stays]], self.error, np.full(len(self), np.nan)
        )
        part = part.select(part.views() >= least_views)
        sigma = _uncertainty(part, cameras.select(chosen))
        return SparsePoints(part.xyz, part.point, part.camera, part.error, sigma)

    def share_in_view(self, cameras: Cameras) -> float:
        """Share of the observations whose point projects into the photo that observed it; NaN without any."""
        if not len(self.point):
            return float("nan")
        return float(cameras.sees(self.camera, self.xyz[self.point]).mean())


def warn_if_not_in_view(points: SparsePoints, cameras: Cameras, *, caller: str) -> None:
    """Warn when fewer than half of the observations project into their photo: cameras and points differ in frame."""
    share = points.share_in_view(cameras)
    if share < LEAST_IN_VIEW:
        warnings.warn(
            f"{caller}: only {share:.0%} of the observations project into the photo that observed them; "
            "points and cameras must be in one frame (scaled, rotated and shifted alike)",
            stacklevel=3,
        )


def _indices(name: str, values: ArrayLike, count: int | None) -> NDArray[np.int64]:
    index = np.array(to_numpy(values))
    if index.size == 0:
        return np.zeros(0, dtype=np.int64)
    if index.ndim != 1 or index.dtype.kind not in "iu":
        raise InvalidArgument(f"SparsePoints: {name} must hold integers (M,), got {index.dtype} {index.shape}")
    if index.min() < 0 or (count is not None and index.max() >= count):
        limit = "" if count is None else f" and < {count}"
        raise InvalidArgument(
            f"SparsePoints: {name} must be >= 0{limit}, got values from {index.min()} to {index.max()}"
        )
    return index.astype(np.int64)


def _uncertainty(points: SparsePoints, cameras: Cameras) -> FloatArray:
    """Largest standard deviation of each triangulated point ``(P,)``.

    Each ray gives the information ``(I - d d^T) / (r e / f)^2``: nothing along itself, and across it a keypoint error
    of ``e`` pixels at the distance ``r``, focal length ``f`` pixels. The inverse of the sum is the covariance.
    """
    offset = points.xyz[points.point] - cameras.origins[points.camera]
    distance = np.linalg.norm(offset, axis=1)
    apart = distance > 0  # a point on a camera's centre has no ray
    who, distance = points.point[apart], distance[apart]
    ray = offset[apart] / distance[:, None]
    focal = np.sqrt(cameras.intrinsics[points.camera[apart], 0] * cameras.intrinsics[points.camera[apart], 1])
    noise = np.maximum(np.nan_to_num(points.error, nan=PIXEL_NOISE), PIXEL_NOISE)[who]
    weight = (focal / (noise * distance)) ** 2
    information = np.zeros((len(points), 3, 3))
    for row in range(3):
        for column in range(3):
            values = ((row == column) - ray[:, row] * ray[:, column]) * weight
            information[:, row, column] = np.bincount(who, weights=values, minlength=len(points))
    least, _, most = np.moveaxis(np.linalg.eigvalsh(information), -1, 0) if len(points) else np.zeros((3, 0))
    with np.errstate(divide="ignore"):
        return np.where(least > 1e-9 * np.maximum(most, 1e-300), 1.0 / np.sqrt(np.maximum(least, 1e-300)), np.inf)
