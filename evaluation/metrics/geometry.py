"""Masked geometry metrics: depth, disparity and normals, as pure numpy functions ``preds, target, mask``.

Depth is distance along the unit ray, in scene units, as a renderer gives it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.cameras import Cameras
from ...core.errors import InvalidArgument
from .checks import FloatArray, Mask, check_pair, picked

NORMAL_THRESHOLD = 30.0  # degrees


def depth_mse(preds: NDArray[Any], target: NDArray[Any], mask: Mask) -> float:
    """Mean squared difference of two depth maps ``(H, W)``, in squared scene units; NaN for an empty mask.

    Example:
        >>> import numpy as np
        >>> preds, target = np.array([[2.0, 4.0]]), np.array([[2.0, 5.0]])
        >>> everywhere = np.ones((1, 2), dtype=bool)
        >>> depth_mse(preds, target, everywhere)
        0.5
    """
    check_pair("depth_mse", preds, target, mask, channels=False)
    if not mask.any():
        return float("nan")
    return float(np.mean((picked("depth_mse", preds, mask) - picked("depth_mse", target, mask)) ** 2))


def disparity_mae(preds: NDArray[Any], target: NDArray[Any], mask: Mask) -> float:
    """Mean of ``|1 / preds - 1 / target|`` for depth maps ``(H, W)``, per scene unit; infinite depth has disparity 0.

    Raises:
        ValueError: also for an unmasked depth that is not > 0.

    Example:
        >>> import numpy as np
        >>> preds, target = np.array([[2.0, 4.0]]), np.array([[2.0, 5.0]])
        >>> everywhere = np.ones((1, 2), dtype=bool)
        >>> round(disparity_mae(preds, target, everywhere), 6)
        0.025
    """
    check_pair("disparity_mae", preds, target, mask, channels=False)
    if not mask.any():
        return float("nan")
    first, second = preds[mask].astype(np.float64), target[mask].astype(np.float64)
    if not ((first > 0).all() and (second > 0).all()):
        raise InvalidArgument("disparity_mae: unmasked depths must be > 0")
    return float(np.mean(np.abs(1.0 / first - 1.0 / second)))


def backproject(depth: NDArray[Any], cameras: Cameras, index: int) -> FloatArray:
    """World positions ``(H, W, 3)`` of a depth map ``(H, W)``: origin + depth * unit direction, lens honoured.

    An infinite depth gives NaN: no position.

    Example:
        >>> import numpy as np
        >>> from unghost.core import Cameras
        >>> pose = np.eye(4)[None]  # looks along -Z
        >>> cameras = Cameras.create(pose, np.array([4.0, 4.0, 1.5, 1.5]), width=3, height=3)
        >>> (backproject(np.full((3, 3), 2.0), cameras, 0)[1, 1] + 0.0).tolist()
        [0.0, 0.0, -2.0]
    """
    wanted = cameras.size(index)[::-1]
    if depth.shape != wanted:
        raise InvalidArgument(f"backproject: depth must have shape {wanted}, got {depth.shape}")
    origins, directions = cameras.rays(index)
    reachable = np.where(np.isfinite(depth), depth, np.nan).astype(np.float64)
    return origins + reachable[..., None] * directions


def normals_from_depth(depth: NDArray[Any], cameras: Cameras, index: int) -> FloatArray:
    """Unit normals ``(H, W, 3)`` in world axes, towards the camera, of a depth map ``(H, W)`` along unit rays.

    The cross product of the differences between the right and left and the lower and upper neighbours'
    back-projections (one-sided at the image border). NaN where it or one of them has no finite depth, or where
    the product vanishes. Across a depth step the difference still counts, as in the paper's maps.

    Example:
        >>> import numpy as np
        >>> from unghost.core import Cameras
        >>> pose = np.eye(4)[None]  # looks along -Z
        >>> cameras = Cameras.create(pose, np.array([4.0, 4.0, 1.5, 1.5]), width=3, height=3)
        >>> wall = 2.0 / -cameras.rays(0)[1][..., 2]
        >>> np.abs(normals_from_depth(wall, cameras, 0)[1, 1]).round(6).tolist()
        [0.0, 0.0, 1.0]
    """
    positions = backproject(depth, cameras, index)
    if min(depth.shape) < 2:
        raise InvalidArgument(f"normals_from_depth: depth must be at least 2 x 2, got {depth.shape}")
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

    Example:
        >>> import numpy as np
        >>> up, side = np.array([[[0.0, 0.0, 1.0]]]), np.array([[[1.0, 0.0, 0.0]]])
        >>> normal_errors(up, side, np.ones((1, 1), dtype=bool))
        {'normal_mean_deg': 90.0, 'normal_median_deg': 90.0, 'normal_pct_30': 0.0}
    """
    check_pair("normal_errors", preds, target, mask, channels=True)
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
