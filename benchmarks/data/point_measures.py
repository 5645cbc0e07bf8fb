"""Measures of one set of sparse points: tracks, errors, angles, distance to the surface, texture, and the vote."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unghost.core.cameras import Cameras
from unghost.core.sight_lines import SightLines
from unghost.core.sparse_points import SparsePoints
from unghost.scenes.sparse_points import CORNER_STEP, least_contrast

Array = NDArray[Any]

BOX = np.array([[-1.0] * 3, [1.0] * 3])  # of normalised cameras
PITCH = 2.0 / 96  # of the cells in which points and lines are counted, scene units
WRONG_SIGMAS, WRONG_PIXELS = 3.0, 5.0  # a point farther from the surface than both together is wrong
PIXELS = 3000  # random ones of each photo
VIEWS = (2, 3, 4, 5)  # whose shares are told, the last one with all above
QUANTILES = {"p10": 0.1, "p50": 0.5, "p90": 0.9}


@dataclass(frozen=True)
class PointSet:
    """Sparse points and what they were matched in.

    Attributes:
        points: in the frame of ``cameras``, whose indices their observations use; ``error`` is in matched pixels.
        cameras: that the points were triangulated with, at the size of the matched photos.
        photos: matched photos ``(H, W)`` in grey levels of [0, 1], by the index of their camera; some are enough.
        surface: signed distance of positions ``(N, 3)`` to the true surface; None if it is unknown.
    """

    points: SparsePoints
    cameras: Cameras
    photos: dict[int, Array]
    surface: Callable[[Array], Array] | None = None


@dataclass(frozen=True)
class Measured:
    """What :func:`measure` returns.

    Attributes:
        numbers: a number a measure.
        values: one value a point: ``views``, ``error``, ``angle``, and where the surface is known ``off_pixels`` and
            ``off_sigmas``.
    """

    numbers: dict[str, float]
    values: dict[str, Array]


def measure(found: PointSet, rng: np.random.Generator) -> Measured:
    """Measure a set of points.

    Args:
        found: the set; at least one point.
        rng: chooses the pixels that stand for all others.

    Returns:
        ``points``; ``views`` (mean), ``views_2`` to ``views_5`` (shares; the last one is of 5 or more); quantiles
        ``error_*`` (matched pixels) and ``angle_*`` (degrees); ``outvoted``, share of the observations in the box that
        :meth:`SightLines.build` drops; ``texture_ratio`` and ``texture_rank`` (:func:`texture`); where the surface is
        known, quantiles ``off_pixels_*`` and ``off_sigmas_*`` of the distance to it, and ``wrong``, the share of wrong
        points.
    """
    points, cameras = found.points, found.cameras
    values = {"views": points.views(), "error": points.error, "angle": points.angles(cameras)}
    numbers = {"points": float(len(points)), "views": float(values["views"].mean())}
    for count in VIEWS:
        same = values["views"] >= count if count == VIEWS[-1] else values["views"] == count
        numbers[f"views_{count}"] = float(same.mean())
    if found.surface is not None:
        off, pixel = np.abs(found.surface(points.xyz)), pixel_size(points, cameras)
        values["off_pixels"], values["off_sigmas"] = off / pixel, off / points.uncertainty
        numbers["wrong"] = float((off > WRONG_SIGMAS * points.uncertainty + WRONG_PIXELS * pixel).mean())
    for name in ("error", "angle", "off_pixels", "off_sigmas"):
        if name in values:
            numbers |= {f"{name}_{key}": float(np.nanquantile(values[name], at)) for key, at in QUANTILES.items()}
    report = SightLines.build(points, cameras, aabb=BOX, pitch=PITCH).report
    traced = report["observations"] - report["too_near"] - report["outside"]
    numbers["outvoted"] = report["outvoted"] / max(traced, 1)
    numbers["texture_ratio"], numbers["texture_rank"] = texture(found, rng)
    return Measured(numbers, values)


def pixel_size(points: SparsePoints, cameras: Cameras) -> Array:
    """Mean side ``(P,)`` of a pixel of the observing photos at each point, scene units."""
    distance = np.linalg.norm(points.xyz[points.point] - cameras.origins[points.camera], axis=1)
    side = distance / cameras.intrinsics[points.camera, 0]
    total: Array = np.bincount(points.point, weights=side, minlength=len(points))
    return total / np.maximum(points.views(), 1)


def texture(found: PointSet, rng: np.random.Generator) -> tuple[float, float]:
    """Local contrast where points were observed, against that of random pixels of the same photos.

    Returns:
        The ratio of the medians, and the probability that a point's pixel has more contrast than a random one.
    """
    mine, others = [np.zeros(0)], [np.zeros(0)]
    for index, photo in found.photos.items():
        here = found.points.point[found.points.camera == index]
        pixels, _, _ = found.cameras.project(index, found.points.xyz[here])
        height, width = photo.shape
        mine.append(photo_contrast(photo, pixels))
        others.append(photo_contrast(photo, rng.random((PIXELS, 2)) * [width, height]))
    at_points, anywhere = np.concatenate(mine), np.sort(np.concatenate(others))
    if not len(at_points) or not len(anywhere):
        return float("nan"), float("nan")
    rank = np.searchsorted(anywhere, at_points, "left") + np.searchsorted(anywhere, at_points, "right")
    return float(np.median(at_points) / max(np.median(anywhere), 1e-4)), float(rank.mean() / (2 * len(anywhere)))


def photo_contrast(photo: Array, pixels: Array) -> Array:
    """Contrast of a photo ``(H, W)`` about pixels ``(N, 2)`` that lie in it, as simulated corners have it.

    Pixels within three of the border are left out.
    """
    height, width = photo.shape
    inside = ((pixels >= 3) & (pixels <= np.array([width, height]) - 3)).all(axis=1)
    offsets = CORNER_STEP * np.array([(x, y) for x in (-1, 0, 1) for y in (-1, 0, 1)], dtype=float)
    places = pixels[inside] + offsets[:, None] - 0.5  # (9, N, 2): the centre of the first pixel is 0
    corner = np.floor(places).astype(int)
    (right, down), (column, row) = np.moveaxis(places - corner, -1, 0), np.moveaxis(corner, -1, 0)
    upper = photo[row, column] * (1 - right) + photo[row, column + 1] * right
    lower = photo[row + 1, column] * (1 - right) + photo[row + 1, column + 1] * right
    return least_contrast(upper * (1 - down) + lower * down)
