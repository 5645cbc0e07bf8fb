"""Which rendered pixels not to trust, by the photos that a field was trained on. numpy only, no gradient.

A pixel of a new view shows a point. If the point is really there, the photos that see it have the pixel's colour, and
the field, looked at from where they were taken, has a surface there. If it is a ghost, they look through it at
something else. The mean over many photos can be trusted more than that over few, like any mean. This needs neither a
gradient nor the truth, only renders.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.cameras import Cameras
from ...core.errors import InvalidArgument

FloatArray = NDArray[np.float64]
CHUNK = 1 << 14  # points at a time: what fits a processor's cache
UNSEEN = 1.0  # the doubt of a point that no photo shows: black held against white


def photo_doubt(
    colors: NDArray[Any],
    depth: NDArray[Any],
    cameras: Cameras,
    *,
    photos: NDArray[Any],
    photo_depth: NDArray[Any],
    photo_cameras: Cameras,
    tolerance: float = 0.05,
    slack: float = 0.0,
) -> NDArray[np.float32]:
    """How far each rendered pixel is from what the training photos have there, and how many photos say so.

    Args:
        colors: ``(n, H, W, 3)`` rendered views in [0, 1].
        depth: ``(n, H, W)`` of the same views, along the unit ray, scene units, > 0; inf for none.
        cameras: of the views.
        photos: ``(m, h, w, 3)`` that the field was trained on, in [0, 1].
        photo_depth: ``(m, h, w)`` as the *field* renders it from the photos' cameras, like ``depth``: what lies behind
            it is not seen by that photo.
        photo_cameras: of the photos. Arrays of views that differ in size hold each in the upper left corner
            (:attr:`~unghost.core.cameras.Cameras.canvas`); beside it, depth is inf.
        tolerance: how far behind that depth a point may lie and still be seen, and how far from it on either side
            and still be the same surface, as a share of it; >= 0.
        slack: the same in scene units, on top; two cells of a grid, say.

    Example:
        >>> from unghost.core.cameras import look_at
        >>> lens, there = np.array([8.0, 8.0, 2.0, 2.0]), np.zeros((2, 3))
        >>> cameras = Cameras.create(look_at(np.array([[2.0, 0.0, 0.0], [1.9, 0.4, 0.0]]), there), lens, 4, 4)
        >>> first, second = cameras.select([0]), cameras.select([1])
        >>> depth = np.full((1, 4, 4), 2.0)
        >>> red, blue = (np.tile(np.array(colour), (1, 4, 4, 1)) for colour in ([1.0, 0.0, 0.0], [0.0, 0.0, 1.0]))
        >>> seen = dict(photos=red, photo_depth=depth, photo_cameras=second, tolerance=0.2)
        >>> doubt = [float(np.median(photo_doubt(shown, depth, first, **seen))) for shown in (red, blue)]
        >>> doubt[0] < 0.01 < 0.4 < doubt[1]  # what the photo shows, and what it contradicts
        True

    Returns:
        ``(n, H, W)`` float32 in [0, 1]: the mean absolute difference of colours over the channels and over the photos
        that see the point, divided by the root of one more than the photos in which the point lies on the surface; 1
        where no photo sees it.

    Raises:
        ValueError: shapes, colours outside [0, 1], depth that is not > 0, a negative tolerance or slack.
    """
    _check("cameras", cameras, colors=colors, depth=depth)
    _check("photo_cameras", photo_cameras, photos=photos, photo_depth=photo_depth)
    for name, value in (("tolerance", tolerance), ("slack", slack)):
        if not 0 <= value < np.inf:
            raise InvalidArgument(f"photo_doubt: {name} must be finite and >= 0, got {value}")
    result = np.full(depth.shape, UNSEEN, dtype=np.float32)
    for index in range(len(cameras)):
        window = cameras.window(index)
        here, shown = depth[index][window], colors[index][window]
        known = np.isfinite(here)
        origins, directions = cameras.rays(index)
        points = origins[known] + directions[known] * here[known][:, None].astype(np.float64)
        shown, doubt = shown[known].astype(np.float64), np.full(len(points), UNSEEN)
        for start in range(0, len(points), CHUNK):
            part = slice(start, start + CHUNK)
            total, seen, same = (np.zeros(len(points[part])) for _ in range(3))
            for other in range(len(photo_cameras)):
                chosen, pixels, on = _seen_by(photo_cameras, other, points[part], photo_depth[other], tolerance, slack)
                photo = photos[other][photo_cameras.window(other)]
                total[chosen] += np.abs(sample_bilinear(photo, pixels) - shown[part][chosen]).mean(axis=-1)
                seen[chosen] += 1
                same[chosen] += on
            doubt[part] = np.where(seen > 0, total / np.maximum(seen, 1) / np.sqrt(1 + same), UNSEEN)
        result[index][window][known] = doubt
    return result


def _seen_by(
    cameras: Cameras, index: int, points: FloatArray, depth: NDArray[Any], tolerance: float, slack: float
) -> tuple[NDArray[np.int64], FloatArray, NDArray[np.bool_]]:
    """Which points a photo sees by the field's depth, at which of its pixels, and whether on the surface there."""
    pixels, _, inside = cameras.project(index, points)
    chosen = np.flatnonzero(inside)
    pixels = pixels[chosen]
    column, row = (np.floor(pixels[:, axis]).astype(np.int64) for axis in (0, 1))
    width, height = cameras.size(index)
    limit = depth[np.minimum(row, height - 1), np.minimum(column, width - 1)]
    away = points[chosen] - cameras.origins[index]
    squared = np.einsum("ni,ni->n", away, away)
    near = squared <= (limit * (1.0 + tolerance) + slack) ** 2
    limit = np.where(np.isfinite(limit), limit, 0.0)[near]  # else nothing is there to lie on
    on = (limit > 0) & (squared[near] >= np.maximum(limit * (1.0 - tolerance) - slack, 0.0) ** 2)
    return chosen[near], pixels[near], on


def sample_bilinear(image: NDArray[Any], pixels: NDArray[Any]) -> FloatArray:
    """Colours ``(k, c)`` of an image ``(h, w, c)`` at ``(k, 2)`` columns and rows; the first pixel's centre is .5, .5.

    Beyond the outermost centres the border's colours go on.
    """
    height, width = image.shape[:2]
    x = np.clip(pixels[:, 0] - 0.5, 0, width - 1)
    y = np.clip(pixels[:, 1] - 0.5, 0, height - 1)
    left, top = x.astype(np.int64), y.astype(np.int64)
    a, b = (x - left)[:, None], (y - top)[:, None]
    corner, right, below = top * width + left, left < width - 1, np.where(top < height - 1, width, 0)
    flat = image.reshape(height * width, -1)
    upper = (1 - a) * flat.take(corner, axis=0) + a * flat.take(corner + right, axis=0)
    lower = (1 - a) * flat.take(corner + below, axis=0) + a * flat.take(corner + below + right, axis=0)
    return np.asarray((1 - b) * upper + b * lower, dtype=np.float64)


def _check(lens: str, cameras: Cameras, **maps: NDArray[Any]) -> None:
    size = (len(cameras), *cameras.canvas)
    for name, values in maps.items():
        is_depth = name.endswith("depth")
        wanted = size if is_depth else (*size, 3)
        if values.shape != wanted:
            raise InvalidArgument(f"photo_doubt: {name} must have shape {wanted} for {lens}, got {values.shape}")
        bad = int((~(values > 0)).sum() if is_depth else (~((values >= -1e-4) & (values <= 1 + 1e-4))).sum())
        if bad:
            rule = "be > 0 (inf for none)" if is_depth else "lie in [0, 1]"
            raise InvalidArgument(f"photo_doubt: {name} must {rule}, {bad} values do not")
