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
MOST_ERROR = 2.0  # pixels; COLMAP itself keeps points up to 4
LEAST_ANGLE = 2.0  # degrees; COLMAP itself keeps points from 1.5 on
LEAST_VIEWS = 2
JUDGED_IN_VIEW = 1000  # points without tracks that are looked for in the photos
PAIRS_AT_ONCE = 1 << 21


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
        pixel_scale: ArrayLike = 1.0,
    ) -> SparsePoints:
        """Validate points and observations; repeated observations count once.

        Args:
            xyz: ``(P, 3)``, finite, scene units.
            point: ``(M,)`` indices into ``xyz``; empty for points without tracks, which support but cross nothing.
            camera: ``(M,)`` indices into ``cameras``.
            cameras: the cameras, in the frame of ``xyz``: their indices are checked and the uncertainty follows.
            error: ``(P,)`` reprojection error, pixels of the photos that were matched, >= 0; None if unknown.
            pixel_scale: pixels of the matched photos for one pixel of ``cameras``, > 0, one number or ``(cameras,)``:
                8 for cameras of photos at 1/8 of the size.

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
        scale = np.array(to_numpy(pixel_scale), dtype=np.float64)
        if scale.shape not in ((), (len(cameras),)) or not ((scale > 0) & np.isfinite(scale)).all():
            raise InvalidArgument(
                f"SparsePoints: pixel_scale must be finite and > 0, one number or ({len(cameras)},), "
                f"got {scale.min(initial=np.inf)} of shape {scale.shape}"
            )
        sigma = _uncertainty(result, cameras, np.broadcast_to(scale, (len(cameras),)))
        return cls(result.xyz, result.point, result.camera, result.error, sigma)

    def __len__(self) -> int:
        return len(self.xyz)

    def views(self) -> NDArray[np.int64]:
        """Number of cameras that observed each point, ``(P,)``."""
        return np.bincount(self.point, minlength=len(self)).astype(np.int64)

    @property
    def about(self) -> str:
        """What there is, in one line; says of points without tracks what they are good for.

        Example:
            >>> SparsePoints.create(np.zeros((3, 3))).about
            '3 points without tracks: they support density near them and give no sight lines'
        """
        if not len(self.point):
            return (
                f"{_counted(len(self), 'point')} without tracks: they support density near them and give no sight lines"
            )
        seen_by = f"by {_counted(len(np.unique(self.camera)), 'camera')}"
        return f"{_counted(len(self), 'point')} with {_counted(len(self.point), 'observation')} {seen_by}"

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
        left = part.views() >= least_views
        part = part.select(left)
        ones = np.ones(len(cameras))
        sigma, before = (
            _uncertainty(each, whose, ones[: len(whose)])
            for each, whose in ((part, cameras.select(chosen)), (self.select(left), cameras))
        )
        with np.errstate(invalid="ignore", over="ignore"):  # the ratio: cameras may be of smaller photos
            told = self.uncertainty[left] * sigma / before
        return SparsePoints(part.xyz, part.point, part.camera, part.error, np.where(np.isfinite(told), told, sigma))

    def angles(self, cameras: Cameras) -> FloatArray:
        """Triangulation angle: the largest angle between two rays to each point, ``(P,)``, degrees in [0, 180].

        0 for a point with fewer than two rays. An observation whose point does not project into its photo has no ray.
        """
        return self._rays(cameras)[1]

    def _rays(self, cameras: Cameras) -> tuple[NDArray[np.int64], FloatArray]:
        """How many observations of each point project into their photo, and their largest angle in degrees."""
        visible = cameras.sees(self.camera, self.xyz[self.point]) if len(self.point) else np.zeros(0, dtype=bool)
        offset = self.xyz[self.point] - cameras.origins[self.camera]
        distance = np.linalg.norm(offset, axis=1)
        visible &= distance > 0  # a point on a camera's centre has no ray
        owner, ray = self.point[visible], offset[visible] / distance[visible, None]
        views = np.bincount(owner, minlength=len(self)).astype(np.int64)
        first = np.cumsum(views) - views  # observations are sorted by point
        angle = np.zeros(len(self))
        for count in np.unique(views[views >= 2]).tolist():
            group = np.flatnonzero(views == count)
            step = max(1, PAIRS_AT_ONCE // count**2)
            for part in (group[at : at + step] for at in range(0, len(group), step)):
                rays = ray[first[part][:, None] + np.arange(count)]
                cosine = np.einsum("pia,pja->pij", rays, rays).min(axis=(1, 2))
                angle[part] = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
        return views, angle

    def filtered(
        self, cameras: Cameras, *, most_error: float = MOST_ERROR, least_angle: float = LEAST_ANGLE
    ) -> FilteredPoints:
        """Drop points that their own observations contradict, or do not determine.

        A point goes, for the first reason that holds, if fewer than two of its observations project into their photo
        (behind the camera, outside the picture); if its mean reprojection error is too large (a wrong match in its
        track; an unknown error, NaN, is no reason); if no two of its rays meet at an angle that is large enough (its
        depth is a guess). A wrong match of two photos alone may lie along both rays by chance: such points are
        outvoted where sight lines are built (:meth:`~unghost.core.sight_lines.SightLines.build`).

        Args:
            cameras: that ``camera`` refers to, in the frame of ``xyz``.
            most_error: pixels, > 0; inf switches this off.
            least_angle: degrees in [0, 180); 0 switches this off.

        Raises:
            InvalidArgument: a threshold out of range, an observation by none of the cameras.

        Example:
            >>> from unghost.core.cameras import look_at
            >>> poses = look_at(np.array([[2.0, 0.0, 0.0], [0.0, 2.0, 0.0]]), np.zeros((2, 3)))
            >>> cameras = Cameras.create(poses, np.array([100.0, 100.0, 50.0, 50.0]), width=100, height=100)
            >>> points = SparsePoints.create(np.zeros((2, 3)), point=[0, 0, 1, 1], camera=[0, 1, 0, 1], error=[0.5, 7])
            >>> points.filtered(cameras).about.split(", ")[:2]
            ['1 of 2 points dropped: 0 in view of fewer than 2 photos', '1 off by more than 2 pixels']
        """
        check_thresholds(most_error, least_angle, caller="SparsePoints.filtered")
        if len(self.camera) and self.camera.max() >= len(cameras):
            raise InvalidArgument(
                f"SparsePoints.filtered: camera must be < {len(cameras)}, the number of cameras, "
                f"got {self.camera.max()}"
            )
        views, angle = self._rays(cameras)
        few = views < LEAST_VIEWS
        off = ~few & (self.error > most_error)
        narrow = ~few & ~off & (angle < least_angle)
        kept = ~(few | off | narrow)
        counts = int(few.sum()), int(off.sum()), int(narrow.sum())
        return FilteredPoints(
            self.select(kept), kept, counts[0], counts[1], counts[2], float(most_error), float(least_angle)
        )

    def share_in_view(self, cameras: Cameras) -> float:
        """Share of the observations whose point projects into the photo that observed it; NaN without any."""
        if not len(self.point):
            return float("nan")
        return float(cameras.sees(self.camera, self.xyz[self.point]).mean())


@dataclass(frozen=True)
class FilteredPoints:
    """What :meth:`SparsePoints.filtered` kept and dropped; each dropped point is counted once.

    Attributes:
        points: those that stay.
        kept: ``(P,)`` mask over the points that were given.
        few_views: how many went because fewer than two of their observations project into their photo.
        large_error: how many of the others, for their reprojection error.
        narrow_angle: how many of the others, for their angle.
        most_error: pixels, as asked for.
        least_angle: degrees, as asked for.
    """

    points: SparsePoints
    kept: NDArray[np.bool_]
    few_views: int
    large_error: int
    narrow_angle: int
    most_error: float
    least_angle: float

    @property
    def about(self) -> str:
        """The counts in one line."""
        return (
            f"{int((~self.kept).sum())} of {_counted(len(self.kept), 'point')} dropped: "
            f"{self.few_views} in view of fewer than {LEAST_VIEWS} photos, "
            f"{self.large_error} off by more than {self.most_error:g} pixels, "
            f"{self.narrow_angle} seen under less than {self.least_angle:g} degrees"
        )


def check_thresholds(most_error: float, least_angle: float, *, caller: str) -> None:
    """Check the thresholds of :meth:`SparsePoints.filtered`, before the work that leads to points.

    Raises:
        InvalidArgument: one is out of range.
    """
    if not most_error > 0:
        raise InvalidArgument(f"{caller}: most_error must be > 0 pixels, got {most_error}")
    if not 0 <= least_angle < 180:
        raise InvalidArgument(f"{caller}: least_angle must be in [0, 180) degrees, got {least_angle}")


def _counted(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"


def warn_if_not_in_view(points: SparsePoints, cameras: Cameras, *, caller: str) -> None:
    """Warn when fewer than half of the observations project into their photo: cameras and points differ in frame.

    Of points without tracks, fewer than half of which any camera has in view.
    """
    rule = "points and cameras must be in one frame (scaled, rotated and shifted alike)"
    if not len(points.point) and len(points) and len(cameras):
        some = points.xyz[:: -(-len(points) // JUDGED_IN_VIEW)]
        share = float((cameras.view_count(some) > 0).mean())
        if share < LEAST_IN_VIEW:
            warnings.warn(f"{caller}: only {share:.0%} of the points are in view of any camera; {rule}", stacklevel=3)
        return
    share = points.share_in_view(cameras)
    if share < LEAST_IN_VIEW:
        warnings.warn(
            f"{caller}: only {share:.0%} of the observations project into the photo that observed them; {rule}",
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


def _uncertainty(points: SparsePoints, cameras: Cameras, pixel_scale: FloatArray) -> FloatArray:
    """Largest standard deviation of each triangulated point ``(P,)``.

    Each ray gives the information ``(I - d d^T) / (r e / f)^2``: nothing along itself, and across it a keypoint error
    of ``e`` pixels at the distance ``r``, focal length ``f`` pixels, both of the matched photos. The inverse of the sum
    is the covariance.
    """
    offset = points.xyz[points.point] - cameras.origins[points.camera]
    distance = np.linalg.norm(offset, axis=1)
    apart = distance > 0  # a point on a camera's centre has no ray
    who, distance = points.point[apart], distance[apart]
    ray = offset[apart] / distance[:, None]
    focal = np.sqrt(cameras.intrinsics[:, 0] * cameras.intrinsics[:, 1]) * pixel_scale
    focal = focal[points.camera[apart]]
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
