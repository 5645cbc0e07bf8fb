"""The paper's two-trajectory protocol: one sweep to train on, another to be scored on.

A *pseudo ground truth* field, trained on both sweeps, gives the evaluation views a depth. A pixel counts
if (1) the point behind it was seen by a training camera and (2) the scored field puts it closer than a
limit. The three things a caller does::

    limit = depth_limit(train_cameras, eval_cameras)
    visible = visibility_masks(eval_cameras, pseudo_depth, train_cameras)
    scores = score(rendered, photos, pseudo_depth, eval_cameras, visible=visible, limit=limit)
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.cameras import Cameras
from ..metrics import pixelwise as metrics

Mask = NDArray[np.bool_]

FAR = 1e3  # "no surface" is back-projected to this many times the depth limit: a direction, in effect
DATA_RANGE = 1.0


def depth_limit(train_cameras: Cameras, eval_cameras: Cameras) -> float:
    """Twice the largest distance between any two camera origins of both sweeps, in scene units.

    Raises:
        ValueError: fewer than two distinct origins.
    """
    origins = np.concatenate([train_cameras.origins, eval_cameras.origins])
    largest = max((float(np.linalg.norm(origins - origin, axis=1).max()) for origin in origins), default=0.0)
    if not largest > 0:
        raise ValueError(f"depth_limit: needs two distinct camera origins, got {len(origins)} cameras in one place")
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
        raise ValueError(f"visibility_masks: minimum_views must be >= 1, got {minimum_views}")
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
            question is a geometric one; inf (no surface) is taken to be far away.
        train_cameras: ``m`` cameras.
        train_depth: ``(m, h, w)`` distance along the unit rays of the *training* cameras, inf for nothing:
            makes the test occlusion-aware (a departure from the paper).
        tolerance: relative tolerance of that test.

    Returns:
        ``(n, H, W)``, 0 to ``m``.
    """
    depth = _depths("view_counts", pseudo_depth, eval_cameras, "pseudo_depth")
    optical = None
    if train_depth is not None:
        optical = optical_depth(_depths("view_counts", train_depth, train_cameras, "train_depth"), train_cameras)
    far = FAR * depth_limit(train_cameras, eval_cameras)
    counts = np.zeros(depth.shape, dtype=np.int64)
    for index in range(len(eval_cameras)):
        points = metrics.backproject(np.minimum(depth[index], far), eval_cameras, index)
        counts[index] = train_cameras.view_count(points, depth_maps=optical, tolerance=tolerance)
    return counts


def depth_masks(depth: NDArray[Any], limit: float) -> Mask:
    """``depth < limit`` for predicted depths ``(n, H, W)``; a field that removed all it had has none left."""
    if not limit > 0:
        raise ValueError(f"depth_masks: limit must be > 0, got {limit}")
    return np.asarray(np.asarray(depth) < limit, dtype=np.bool_)


def common_mask(masks: Sequence[Mask]) -> Mask:
    """Pixels that count for *every* compared method: the only ones on which their PSNRs are comparable."""
    if not masks:
        raise ValueError("common_mask: needs at least one mask")
    if len({mask.shape for mask in masks}) != 1:
        raise ValueError(f"common_mask: masks must have one shape, got {[mask.shape for mask in masks]}")
    return np.asarray(np.logical_and.reduce(list(masks)), dtype=np.bool_)


def stack(rendered: Sequence[Mapping[str, NDArray[Any]]], key: str) -> NDArray[Any]:
    """One output of all rendered views: ``(n, H, W)`` or ``(n, H, W, C)``."""
    return np.stack([view[key] for view in rendered])


def score(
    rendered: Sequence[Mapping[str, NDArray[Any]]],
    photos: NDArray[Any],
    pseudo_depth: NDArray[Any],
    cameras: Cameras,
    *,
    visible: Mask,
    limit: float,
    common: Mask | None = None,
    ssim_convention: str = "map_mean",
) -> dict[str, Any]:
    """Every metric of the protocol for one field: means over the views that have a pixel left.

    Pseudo-ground-truth depth is clipped to ``limit`` before it is compared: a predicted depth that counts
    is below the limit, so no error can exceed it, and a pixel without a surface in the pseudo ground truth
    costs at most ``limit ** 2`` (the published code leaves it at the far plane: errors around 100). Where
    the pseudo ground truth was clipped it has no normal, and the pixel is left out of the normals alone.

    Args:
        rendered: a view each: ``rgb (H, W, 3)`` in [0, 1] and ``depth (H, W)`` along the unit ray, inf for nothing.
        photos: ``(n, H, W, 3)`` in [0, 1].
        pseudo_depth: ``(n, H, W)``.
        cameras: the ``n`` evaluation cameras.
        visible: ``(n, H, W)`` bool of :func:`visibility_masks`.
        limit: of :func:`depth_limit`.
        common: ``(n, H, W)`` of :func:`common_mask`; adds ``psnr_common`` and ``coverage_common``.
        ssim_convention: see :func:`unghost.evaluation.metrics.pixelwise.ssim`.

    Returns:
        ``psnr ssim depth_mse disparity_mae normal_mean_deg normal_median_deg normal_pct_30 coverage`` (of
        all pixels), ``psnr_visible`` (over visible pixels whatever the predicted depth: removing a
        surface cannot improve it by losing the pixel), ``views_scored`` and ``convention``. NaN where nothing is left.
    """
    depth = _depths("score", stack(rendered, "depth"), cameras, "rendered depth")
    pseudo = np.minimum(_depths("score", pseudo_depth, cameras, "pseudo_depth"), limit)
    colours = stack(rendered, "rgb")
    for name, array, shape in (("photos", photos, colours.shape), ("visible", visible, depth.shape)):
        if array.shape != shape:
            raise ValueError(f"score: {name} must have shape {shape}, got {array.shape}")
    masks = visible & depth_masks(depth, limit)
    views = [
        _score_view(colours[i], photos[i], depth[i], pseudo[i], masks[i], cameras, i, limit, ssim_convention)
        for i in range(len(cameras))
    ]
    result: dict[str, Any] = {key: _mean([view[key] for view in views]) for key in views[0]}
    result["coverage"] = metrics.coverage(masks)
    result["psnr_visible"] = _mean_psnr(colours, photos, visible)
    if common is not None:
        result["psnr_common"] = _mean_psnr(colours, photos, common)
        result["coverage_common"] = metrics.coverage(common)
    result["views_scored"] = int(masks.any(axis=(1, 2)).sum())
    result["convention"] = f"paper masks (visible, depth < {limit:.4g}), means over views, ssim {ssim_convention}"
    return result


def json_ready(value: Any) -> Any:
    """A copy in which NaN and infinities are None (JSON null) and numpy numbers are Python's."""
    if isinstance(value, Mapping):
        return {key: json_ready(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [json_ready(each) for each in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _score_view(
    colour: NDArray[Any],
    photo: NDArray[Any],
    depth: NDArray[Any],
    pseudo: NDArray[Any],
    mask: Mask,
    cameras: Cameras,
    index: int,
    limit: float,
    convention: str,
) -> dict[str, float]:
    surface = np.where(pseudo < limit, pseudo, np.inf)
    normals = [metrics.normals_from_depth(each, cameras, index) for each in (depth, surface)]
    return {
        "psnr": metrics.psnr(colour, photo, mask, data_range=DATA_RANGE),
        "ssim": metrics.ssim(colour, photo, mask, data_range=DATA_RANGE, convention=convention),
        "depth_mse": metrics.depth_mse(depth, pseudo, mask),
        "disparity_mae": metrics.disparity_mae(depth, pseudo, mask),
        **metrics.normal_errors(normals[0], normals[1], mask),
    }


def _mean_psnr(colours: NDArray[Any], photos: NDArray[Any], masks: Mask) -> float:
    pairs = zip(colours, photos, masks, strict=True)
    return _mean([metrics.psnr(colour, photo, mask, data_range=DATA_RANGE) for colour, photo, mask in pairs])


def _mean(values: Sequence[float]) -> float:
    """Mean of what is not NaN; NaN if nothing is left."""
    known = [value for value in values if not np.isnan(value)]
    return float(np.mean(known)) if known else float("nan")


def _depths(caller: str, depth: NDArray[Any], cameras: Cameras, name: str) -> NDArray[Any]:
    shape = (len(cameras), cameras.height, cameras.width)
    array = np.asarray(depth, dtype=np.float64)
    if array.shape != shape:
        raise ValueError(f"{caller}: {name} must have shape {shape}, got {array.shape}")
    if np.isnan(array).any() or not (array > 0).all():
        bad = int((~(array > 0)).sum())
        raise ValueError(f"{caller}: {name} must be > 0 (inf for nothing), {bad} values are not")
    return array


def optical_depth(depth: NDArray[Any], cameras: Cameras) -> NDArray[np.float64]:
    """Distance along unit rays ``(n, H, W)`` to depth along the optical axis: times the cosine."""
    return np.asarray(depth, dtype=np.float64) * _cosines("optical_depth", depth, cameras)


def ray_depth(depth: NDArray[Any], cameras: Cameras) -> NDArray[np.float64]:
    """Inverse of :func:`optical_depth`."""
    return np.asarray(depth, dtype=np.float64) / _cosines("ray_depth", depth, cameras)


def _cosines(caller: str, depth: NDArray[Any], cameras: Cameras) -> NDArray[np.float64]:
    """Of each pixel's ray with the optical axis ``(n, H, W)``."""
    shape = (len(cameras), cameras.height, cameras.width)
    if np.shape(depth) != shape:
        raise ValueError(f"{caller}: depth must have shape {shape}, got {np.shape(depth)}")
    return np.stack([cameras.rays(index)[1] @ -cameras.camera_to_world[index, :, 2] for index in range(len(cameras))])
