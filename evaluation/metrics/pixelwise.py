"""Masked image and geometry metrics, as pure numpy functions in the order ``preds, target, mask``.

One image at a time. A mask says which pixels count; where none does, every metric is NaN (JSON: null),
never 0 and never perfect. Values that are masked out are never looked at: they may be NaN or infinite
(the one exception, ``map_mean`` SSIM, says so).

This module is the door to all of them: PSNR stands here, the others in a module each.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .checks import FloatArray, Mask, check_pair, check_range, choose, picked
from .geometry import NORMAL_THRESHOLD, backproject, depth_mse, disparity_mae, normal_errors, normals_from_depth
from .ldr_flip import PIXELS_PER_DEGREE, flip, flip_map
from .masks import coverage, mask_scores, predicted_mask
from .similarity import SSIM_CONVENTIONS, ssim, ssim_map

__all__ = [
    "NORMAL_THRESHOLD",
    "PIXELS_PER_DEGREE",
    "PSNR_CONVENTIONS",
    "SSIM_CONVENTIONS",
    "backproject",
    "coverage",
    "depth_mse",
    "disparity_mae",
    "flip",
    "flip_map",
    "mask_scores",
    "normal_errors",
    "normals_from_depth",
    "predicted_mask",
    "psnr",
    "ssim",
    "ssim_map",
]

PSNR_CONVENTIONS: Mapping[str, str] = MappingProxyType(
    {
        "pooled": "one MSE over the unmasked pixels and all channels",
        "per_channel": "an MSE a channel over the unmasked pixels, the channels' decibels averaged",
        "all_pixels": "squared errors of the unmasked pixels divided by the number of all pixels",
    }
)


def psnr(
    preds: NDArray[Any], target: NDArray[Any], mask: Mask, *, data_range: float, convention: str = "pooled"
) -> float:
    """``10 log10(data_range^2 / MSE)`` in dB, in one of three named conventions.

    ``pooled``: the mean over the unmasked pixels and all channels, and no other.
    ``per_channel``: a PSNR for each channel over the unmasked pixels, averaged in decibels (the paper's published
    code, Bayes' Rays, the free-space prior); never below ``pooled``, as the mean of logarithms is not the
    logarithm of the mean.
    ``all_pixels``: the images blanked outside the mask, divided by *all* pixels (nerfbaselines):
    ``10 log10(1 / coverage)`` dB above ``pooled``, so that removing things pays.

    Args:
        preds, target: ``(H, W, C)``, in ``[0, data_range]``.
        mask: ``(H, W)`` bool, True where a pixel counts.
        data_range: largest possible value.
        convention: a key of ``PSNR_CONVENTIONS``.

    Returns:
        dB; inf for equal images, NaN for an empty mask. With ``per_channel`` inf if one channel is equal throughout.

    Raises:
        ValueError: shapes, a mask that is not bool, ``data_range <= 0``, a NaN or infinity that is not masked out,
            an unknown convention.

    Example:
        >>> import numpy as np
        >>> target = np.full((12, 12, 3), 0.5)
        >>> half = np.arange(144).reshape(12, 12) < 72
        >>> preds = np.where(half[..., None], target + 0.1, np.nan)
        >>> round(psnr(preds, target, half, data_range=1.0), 6)
        20.0
        >>> round(psnr(preds, target, half, data_range=1.0, convention="all_pixels"), 2)
        23.01
    """
    check_pair("psnr", preds, target, mask, channels=True)
    check_range("psnr", data_range)
    choose("psnr", "convention", convention, PSNR_CONVENTIONS)
    if not mask.any():
        return float("nan")
    squared = (picked("psnr", preds, mask) - picked("psnr", target, mask)) ** 2
    if convention == "per_channel":
        return float(np.mean([_decibels(error, data_range) for error in squared.mean(axis=0)]))
    count = mask.sum() if convention == "pooled" else mask.size
    return _decibels(squared.sum() / (count * preds.shape[-1]), data_range)


def _decibels(error: float | FloatArray, data_range: float) -> float:
    return float(10.0 * np.log10(data_range**2 / error)) if error > 0 else float("inf")
