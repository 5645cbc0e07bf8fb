"""Masked image and geometry metrics, as pure numpy functions in the order ``preds, target, mask``.

One image at a time. A mask says which pixels count; where none does, every metric is NaN (JSON: null),
never 0 and never perfect. Values that are masked out are never looked at: they may be NaN or infinite.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.cameras import Cameras

FloatArray = NDArray[np.float64]
Mask = NDArray[np.bool_]

SSIM_CONVENTIONS = ("map_mean", "premasked")
SSIM_RADIUS, SSIM_WIDTH = 5, 1.5  # an 11 x 11 window
NORMAL_THRESHOLD = 30.0  # degrees


def _check(caller: str, preds: NDArray[Any], target: NDArray[Any], mask: NDArray[Any], *, channels: bool) -> None:
    wanted = "(H, W, C)" if channels else "(H, W)"
    if preds.ndim != (3 if channels else 2):
        raise ValueError(f"{caller}: preds must have shape {wanted}, got {preds.shape}")
    if target.shape != preds.shape:
        raise ValueError(f"{caller}: target must have the shape of preds {preds.shape}, got {target.shape}")
    if mask.dtype != np.bool_ or mask.shape != preds.shape[:2]:
        raise ValueError(f"{caller}: mask must be bool of shape {preds.shape[:2]}, got {mask.dtype} {mask.shape}")


def _check_range(caller: str, data_range: float) -> None:
    if not (np.isfinite(data_range) and data_range > 0):
        raise ValueError(f"{caller}: data_range must be finite and > 0, got {data_range}")


def _picked(caller: str, values: NDArray[Any], mask: Mask) -> FloatArray:
    """The unmasked values, refused if one of them is NaN or infinite."""
    chosen = values[mask].astype(np.float64)
    if not np.isfinite(chosen).all():
        raise ValueError(f"{caller}: {int((~np.isfinite(chosen)).sum())} unmasked values are NaN or infinite")
    return chosen


def psnr(preds: NDArray[Any], target: NDArray[Any], mask: Mask, *, data_range: float) -> float:
    """``10 log10(data_range^2 / MSE)`` in dB over the unmasked pixels alone.

    Args:
        preds, target: ``(H, W, C)``, in ``[0, data_range]``.
        mask: ``(H, W)`` bool, True where a pixel counts.
        data_range: largest possible value.

    Returns:
        dB; inf for equal images, NaN for an empty mask. Dividing by *all* pixels instead, as some
        tools do, would add ``10 log10(1 / coverage)`` dB.

    Raises:
        ValueError: shapes, a mask that is not bool, ``data_range <= 0``, a NaN or infinity that is not masked out.
    """
    _check("psnr", preds, target, mask, channels=True)
    _check_range("psnr", data_range)
    if not mask.any():
        return float("nan")
    error = np.mean((_picked("psnr", preds, mask) - _picked("psnr", target, mask)) ** 2)
    return float(10.0 * np.log10(data_range**2 / error)) if error > 0 else float("inf")


def _blur(image: FloatArray) -> FloatArray:
    """Separable Gaussian over the first two axes, edges mirrored including the edge pixel."""
    offsets = np.arange(-SSIM_RADIUS, SSIM_RADIUS + 1)
    taps = np.exp(-0.5 * (offsets / SSIM_WIDTH) ** 2)
    taps /= taps.sum()
    for axis in (0, 1):
        padding = [(SSIM_RADIUS, SSIM_RADIUS) if axis == each else (0, 0) for each in range(image.ndim)]
        padded = np.pad(image, padding, mode="symmetric")
        windows = np.lib.stride_tricks.sliding_window_view(padded, len(taps), axis=axis)
        image = windows @ taps
    return image


def ssim_map(preds: NDArray[Any], target: NDArray[Any], *, data_range: float) -> FloatArray:
    """SSIM around each pixel, averaged over channels: ``(H, W, C)`` twice to ``(H, W)`` in [-1, 1].

    Gaussian window 11 x 11 of standard deviation 1.5, ``k1 = .01``, ``k2 = .03``, biased covariances
    (Wang et al. 2004); images are mirrored at their edges, no border is cropped.
    """
    _check("ssim_map", preds, target, np.ones(preds.shape[:2], dtype=bool), channels=True)
    _check_range("ssim_map", data_range)
    x, y = preds.astype(np.float64), target.astype(np.float64)
    mean_x, mean_y = _blur(x), _blur(y)
    var_x, var_y = _blur(x * x) - mean_x**2, _blur(y * y) - mean_y**2
    covariance = _blur(x * y) - mean_x * mean_y
    c1, c2 = (0.01 * data_range) ** 2, (0.03 * data_range) ** 2
    numerator = (2 * mean_x * mean_y + c1) * (2 * covariance + c2)
    ratio: FloatArray = numerator / ((mean_x**2 + mean_y**2 + c1) * (var_x + var_y + c2))
    return np.asarray(ratio.mean(axis=-1), dtype=np.float64)


def ssim(
    preds: NDArray[Any], target: NDArray[Any], mask: Mask, *, data_range: float, convention: str = "map_mean"
) -> float:
    """Masked structural similarity, in one of two named conventions that must not be compared.

    ``map_mean``: the map of the *whole* images, averaged over the unmasked pixels. A window near the
    mask's edge also sees what lies behind it (in both images), but no hole is ever cut.
    ``premasked``: both images are set to 0 outside the mask first and the map is averaged over *all*
    pixels, as in the paper's published code: holes agree perfectly, so a smaller mask scores higher.

    Args:
        preds, target: ``(H, W, C)``, in ``[0, data_range]``, finite everywhere.
        mask: ``(H, W)`` bool.
        data_range: largest possible value.
        convention: ``"map_mean"`` or ``"premasked"``.
    """
    _check("ssim", preds, target, mask, channels=True)
    if convention not in SSIM_CONVENTIONS:
        raise ValueError(f"ssim: convention must be one of {', '.join(SSIM_CONVENTIONS)}, got {convention!r}")
    if not mask.any():
        return float("nan")
    if convention == "map_mean":
        return float(ssim_map(preds, target, data_range=data_range)[mask].mean())
    kept = mask[..., None]
    return float(ssim_map(np.where(kept, preds, 0.0), np.where(kept, target, 0.0), data_range=data_range).mean())


def depth_mse(preds: NDArray[Any], target: NDArray[Any], mask: Mask) -> float:
    """Mean squared difference of two depth maps ``(H, W)``, in squared scene units; NaN for an empty mask."""
    _check("depth_mse", preds, target, mask, channels=False)
    if not mask.any():
        return float("nan")
    return float(np.mean((_picked("depth_mse", preds, mask) - _picked("depth_mse", target, mask)) ** 2))


def disparity_mae(preds: NDArray[Any], target: NDArray[Any], mask: Mask) -> float:
    """Mean of ``|1 / preds - 1 / target|`` for depth maps ``(H, W)``, per scene unit; infinite depth has disparity 0.

    Raises:
        ValueError: also for an unmasked depth that is not > 0.
    """
    _check("disparity_mae", preds, target, mask, channels=False)
    if not mask.any():
        return float("nan")
    first, second = preds[mask].astype(np.float64), target[mask].astype(np.float64)
    if not ((first > 0).all() and (second > 0).all()):
        raise ValueError("disparity_mae: unmasked depths must be > 0")
    return float(np.mean(np.abs(1.0 / first - 1.0 / second)))


def backproject(depth: NDArray[Any], cameras: Cameras, index: int) -> FloatArray:
    """World positions ``(H, W, 3)`` of a depth map ``(H, W)``: origin + depth * unit direction, lens honoured.

    An infinite depth gives NaN: no position.
    """
    if depth.shape != (cameras.height, cameras.width):
        raise ValueError(f"backproject: depth must have shape {(cameras.height, cameras.width)}, got {depth.shape}")
    origins, directions = cameras.rays(index)
    reachable = np.where(np.isfinite(depth), depth, np.nan).astype(np.float64)
    return origins + reachable[..., None] * directions


def normals_from_depth(depth: NDArray[Any], cameras: Cameras, index: int) -> FloatArray:
    """Unit normals ``(H, W, 3)`` in world axes, towards the camera, of a depth map ``(H, W)`` along unit rays.

    The cross product of the differences between the right and left and the lower and upper neighbours'
    back-projections (one-sided at the image border). NaN where it or one of them has no finite depth, or where
    the product vanishes. Across a depth step the difference still counts, as in the paper's maps.
    """
    positions = backproject(depth, cameras, index)
    if min(depth.shape) < 2:
        raise ValueError(f"normals_from_depth: depth must be at least 2 x 2, got {depth.shape}")
    down, right = np.gradient(positions, axis=(0, 1))
    cross = np.cross(down, right)
    length = np.linalg.norm(cross, axis=-1, keepdims=True)
    normals = np.divide(cross, length, out=np.full_like(cross, np.nan), where=length > 0)
    away = ((positions - cameras.origins[index]) * normals).sum(axis=-1, keepdims=True) > 0
    known = np.isfinite(depth)[..., None]
    return np.asarray(np.where(known, np.where(away, -normals, normals), np.nan), dtype=np.float64)


def normal_errors(preds: NDArray[Any], target: NDArray[Any], mask: Mask) -> dict[str, float]:
    """Angles between two normal maps ``(H, W, 3)``, over unmasked pixels where both have a normal (not NaN).

    Returns:
        ``normal_mean_deg``, ``normal_median_deg`` and ``normal_pct_30``: the *share* in [0, 1] of
        pixels within 30 degrees, as the paper tabulates it. All NaN where no pixel is left.
    """
    _check("normal_errors", preds, target, mask, channels=True)
    valid = mask & np.isfinite(preds).all(axis=-1) & np.isfinite(target).all(axis=-1)
    if not valid.any():
        return dict.fromkeys(("normal_mean_deg", "normal_median_deg", "normal_pct_30"), float("nan"))
    cosine = np.einsum("ni,ni->n", preds[valid].astype(np.float64), target[valid].astype(np.float64))
    degrees = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    return {
        "normal_mean_deg": float(degrees.mean()),
        "normal_median_deg": float(np.median(degrees)),
        "normal_pct_30": float((degrees < NORMAL_THRESHOLD).mean()),
    }


def coverage(mask: Mask) -> float:
    """Share of *all* pixels that a mask of any shape keeps; NaN for a mask without pixels."""
    if mask.dtype != np.bool_:
        raise ValueError(f"coverage: mask must be bool, got {mask.dtype}")
    return float(mask.mean()) if mask.size else float("nan")
