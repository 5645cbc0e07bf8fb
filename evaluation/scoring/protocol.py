"""Masks of the paper's two-trajectory protocol: one sweep to train on, another to be scored on.

A *pseudo ground truth* field, trained on both sweeps, gives the evaluation views a depth. A pixel counts
if (1) the point behind it was seen by a training camera and (2) the scored field puts it closer than a
limit. :func:`unghost.evaluation.scoring.engine.score_scene` applies both under a named convention::

    extent = SceneExtent.of(train_cameras, eval_cameras)
    visible = visibility_masks(eval_cameras, pseudo_depth, train_cameras)
    truth = Truth(photos, visible, pseudo_depth, cameras=eval_cameras)
    scores = score_scene(Renders(rgb, depth), truth, extent, convention="paper_text").means()
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.cameras import Cameras
from ...core.errors import InvalidArgument
from ..metrics.checks import Mask
from ..metrics.geometry import backproject
from .depths import optical_depth

FAR = 1e3  # "no surface" is back-projected to this many times the depth limit: a direction, in effect


def depth_limit(train_cameras: Cameras, eval_cameras: Cameras) -> float:
    """Twice the largest distance between any two camera origins of both sweeps, in scene units.

    Raises:
        ValueError: fewer than two distinct origins.
    """
    origins = np.concatenate([train_cameras.origins, eval_cameras.origins])
    largest = max((float(np.linalg.norm(origins - origin, axis=1).max()) for origin in origins), default=0.0)
    if not largest > 0:
        raise InvalidArgument(
            f"depth_limit: needs two distinct camera origins, got {len(origins)} cameras in one place"
        )
    return 2.0 * largest


def visibility_masks(
    eval_cameras: Cameras,
    pseudo_depth: NDArray[Any],
    train_cameras: Cameras,
    *,
    minimum_views: int = 1,
    train_depth: NDArray[Any] | None = None,
    tolerance: float = 0.05,
) -> Mask:
    """Which evaluation pixels show something that the training cameras saw.

    Args:
        eval_cameras, pseudo_depth, train_cameras, train_depth, tolerance: of :func:`view_counts`.
        minimum_views: how many must see the point.

    Returns:
        ``(n, H, W)`` bool.
    """
    if minimum_views < 1:
        raise InvalidArgument(f"visibility_masks: minimum_views must be >= 1, got {minimum_views}")
    counts = view_counts(eval_cameras, pseudo_depth, train_cameras, train_depth=train_depth, tolerance=tolerance)
    return np.asarray(counts >= minimum_views, dtype=np.bool_)


def view_counts(
    eval_cameras: Cameras,
    pseudo_depth: NDArray[Any],
    train_cameras: Cameras,
    *,
    train_depth: NDArray[Any] | None = None,
    tolerance: float = 0.05,
) -> NDArray[np.int64]:
    """How many training cameras see what each evaluation pixel shows.

    Every pixel is back-projected (origin + depth * unit direction, lens honoured) and the training
    cameras whose frustum holds the point are counted: the paper's test.

    Args:
        eval_cameras: ``n`` cameras.
        pseudo_depth: ``(n, H, W)`` distance along the unit ray, scene units, > 0; not clipped here, as the
            question is a geometric one; inf (no surface) is taken to be far away. Of views that differ in size,
            each in the upper left corner and inf beside it (:attr:`~unghost.core.cameras.Cameras.canvas`).
        train_cameras: ``m`` cameras.
        train_depth: ``(m, h, w)`` distance along the unit rays of the *training* cameras, inf for nothing:
            makes the test occlusion-aware (a departure from the paper).
        tolerance: relative tolerance of that test.

    Returns:
        ``(n, H, W)``, 0 to ``m``; 0 beside a view.
    """
    depth = _depths("view_counts", pseudo_depth, eval_cameras, "pseudo_depth")
    optical = None
    if train_depth is not None:
        optical = optical_depth(_depths("view_counts", train_depth, train_cameras, "train_depth"), train_cameras)
    far = FAR * depth_limit(train_cameras, eval_cameras)
    counts = np.zeros(depth.shape, dtype=np.int64)
    for index in range(len(eval_cameras)):
        window = eval_cameras.window(index)
        points = backproject(np.minimum(depth[index][window], far), eval_cameras, index)
        counts[index][window] = train_cameras.view_count(points, depth_maps=optical, tolerance=tolerance)
    return counts


def depth_masks(depth: NDArray[Any], limit: float) -> Mask:
    """``depth < limit`` for predicted depths ``(n, H, W)``; a field that removed all it had has none left."""
    if not limit > 0:
        raise InvalidArgument(f"depth_masks: limit must be > 0, got {limit}")
    return np.asarray(np.asarray(depth) < limit, dtype=np.bool_)


def common_mask(masks: Sequence[Mask]) -> Mask:
    """Pixels that count for *every* compared method: the only ones on which their PSNRs are comparable."""
    if not masks:
        raise InvalidArgument("common_mask: needs at least one mask")
    if len({mask.shape for mask in masks}) != 1:
        raise InvalidArgument(f"common_mask: masks must have one shape, got {[mask.shape for mask in masks]}")
    return np.asarray(np.logical_and.reduce(list(masks)), dtype=np.bool_)


def _depths(caller: str, depth: NDArray[Any], cameras: Cameras, name: str) -> NDArray[Any]:
    shape = (len(cameras), *cameras.canvas)
    array = np.asarray(depth, dtype=np.float64)
    if array.shape != shape:
        raise InvalidArgument(f"{caller}: {name} must have shape {shape}, got {array.shape}")
    if np.isnan(array).any() or not (array > 0).all():
        bad = int((~(array > 0)).sum())
        raise InvalidArgument(f"{caller}: {name} must be > 0 (inf for nothing), {bad} values are not")
    return array
