"""Flat sides inside and about the field of view of any lens: rectangles of normalised image coordinates.

A box wholly within the inner rectangle's four planes is in view, one wholly beyond a plane of the outer one is not;
what lies between is left to :meth:`~unghost.core.cameras.Cameras.project`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..cameras import Cameras
from ..lenses import distort, fisheye_angle, fisheye_radius, largest_radius, undistort, widest_angle

BORDER_POINTS = 33  # along each side of an image, where a bent border is sampled
MOST_TANGENTIAL = 0.05  # of p1, p2: beyond, a lens may fold where its radial terms do not tell
FLAT_ANGLE = np.deg2rad(80.0)  # beyond, a plane's coordinates (tangents) say little of a fisheye
FloatArray = NDArray[np.float64]


def image_rectangles(cameras: Cameras) -> tuple[FloatArray, FloatArray]:
    """Normalised image coordinates (x right, y down) that a camera surely has in view, and those it may have.

    Returns:
        two ``(N, 4)``: left, right, top, bottom. Where the lens cannot be undistorted to its border, the first is
        empty (NaN) and the second everything (infinite). A fisheye so wide that its border has no such coordinates
        has a square about its axis as the first.

    Example:
        >>> lens = np.array([10.0, 10.0, 8.0, 6.0])  # a pinhole: both are the image's own
        >>> sure, possible = image_rectangles(Cameras.create(np.eye(3, 4)[None], lens, 16, 12))
        >>> sure.tolist(), bool((sure == possible).all())
        ([[-0.8, 0.8, -0.6, 0.6]], True)
    """
    fx, fy, cx, cy = cameras.intrinsics.T
    width, height = cameras.sizes.T
    plain = np.stack([-cx / fx, (width - cx) / fx, -cy / fy, (height - cy) / fy], axis=1)
    sure, possible = plain.copy(), plain.copy()
    cache = dict[bytes, tuple[FloatArray, FloatArray]]()
    for index in np.flatnonzero(~cameras.flat_sided):
        kind, bend = bool(cameras.fisheye[index]), cameras.distortion[index]
        key = bytes([kind]) + plain[index].tobytes() + bend.tobytes()
        if key not in cache:
            cache[key] = (_fisheye_rectangles if kind else _bent_rectangles)(plain[index], bend)
        sure[index], possible[index] = cache[key]
    return sure, possible


def side_normals(cameras: Cameras, rectangles: FloatArray) -> FloatArray:
    """The four planes of each camera's rectangle ``(N, 4)``: normals ``(N, 4, 3)`` in world axes, any length.

    A point ``p`` is within a side if ``(p - origin) . normal >= 0``; a side that is not finite has the normal 0.

    Example:
        >>> cameras = Cameras.create(np.eye(3, 4)[None], np.array([10.0, 10.0, 8.0, 6.0]), 16, 12)
        >>> (side_normals(cameras, image_rectangles(cameras)[0])[0] @ [0.7, 0.0, -1.0] >= 0).tolist()
        [True, True, True, True]
    """
    bounded = np.isfinite(rectangles)
    left, right, top, bottom = np.where(bounded, rectangles, 0.0).T
    one, zero = np.ones_like(left), np.zeros_like(left)
    local = np.array([[one, zero, left], [-one, zero, -right], [zero, -one, top], [zero, one, -bottom]])
    local *= bounded.T[:, None]
    normals: FloatArray = np.einsum("nab,sbn->nsa", cameras.camera_to_world[:, :, :3], local)
    return normals


def _border(plain: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The image's border as x and y, each ``(4, BORDER_POINTS)``: left, right, top, bottom."""
    left, right, top, bottom = plain
    along = np.linspace(0.0, 1.0, BORDER_POINTS)
    rows, columns = top + along * (bottom - top), left + along * (right - left)
    x = np.stack([np.full_like(rows, left), np.full_like(rows, right), columns, columns])
    y = np.stack([rows, rows, np.full_like(columns, top), np.full_like(columns, bottom)])
    return x, y


def _inner_and_outer(u: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rectangles inside and about a border ``(4, BORDER_POINTS)``; the first is NaN if there is none."""
    sides = np.stack([u[0], u[1], v[2], v[3]])
    margin = np.abs(np.diff(sides, n=2, axis=1)).max(axis=1) + 1e-6  # between two samples the border bends no further
    low, high = sides.min(axis=1) - margin, sides.max(axis=1) + margin
    sure = np.array([high[0], low[1], high[2], low[3]])
    if not (sure[0] < sure[1] and sure[2] < sure[3]):
        sure = np.full(4, np.nan)
    return sure, np.array([low[0], high[1], low[2], high[3]])


def _bent_rectangles(plain: FloatArray, bend: FloatArray) -> tuple[FloatArray, FloatArray]:
    x, y = _border(plain)
    with np.errstate(over="ignore", invalid="ignore"):
        u, v = undistort(x, y, bend)
        missed = np.abs(np.stack(distort(u, v, bend)) - np.stack([x, y])).max()
        radius = np.sqrt((u * u + v * v).max())
    if not (missed < 1e-6 and np.abs(bend[4:]).max() <= MOST_TANGENTIAL and radius < 0.999 * largest_radius(bend)):
        return np.full(4, np.nan), np.array([-np.inf, np.inf, -np.inf, np.inf])
    sure, possible = _inner_and_outer(u, v)
    corner = np.hypot(np.abs(sure[:2]).max(), np.abs(sure[2:]).max())
    return (sure if corner < largest_radius(bend) else np.full(4, np.nan)), possible


def _fisheye_rectangles(plain: FloatArray, bend: FloatArray) -> tuple[FloatArray, FloatArray]:
    x, y = _border(plain)
    radius, widest = np.hypot(x, y), widest_angle(bend)
    angle = fisheye_angle(radius, bend)
    if np.abs(fisheye_radius(angle, bend) - radius).max() < 1e-9 and angle.max() < min(FLAT_ANGLE, 0.999 * widest):
        stretch = np.tan(angle) / np.maximum(radius, 1e-12)
        return _inner_and_outer(x * stretch, y * stretch)
    # The border is beyond the flat coordinates or the image circle: the cone within it, the cone about the corners.
    left, right, top, bottom = plain
    nearest, farthest = min(-left, right, -top, bottom), float(angle.max())
    sure, possible = np.full(4, np.nan), np.array([-np.inf, np.inf, -np.inf, np.inf])
    if nearest > 0:
        cone = min(float(fisheye_angle(np.array(nearest), bend)), widest, FLAT_ANGLE)
        sure = np.tan(cone) * (1 - 1e-6) / np.sqrt(2.0) * np.array([-1.0, 1.0, -1.0, 1.0])
    if farthest < FLAT_ANGLE:
        possible = np.tan(farthest) * (1 + 1e-6) * np.array([-1.0, 1.0, -1.0, 1.0])
    return sure, possible
