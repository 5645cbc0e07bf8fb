"""How well one mask agrees with another, and how much a mask covers."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.errors import InvalidArgument
from .checks import Mask

MASK_KEYS = ("dice", "iou", "mask_precision", "mask_recall", "pixel_accuracy")


def coverage(mask: Mask) -> float:
    """Share of *all* pixels that a mask of any shape keeps; NaN for a mask without pixels.

    Example:
        >>> import numpy as np
        >>> coverage(np.array([True, True, True, False]))
        0.75
    """
    if mask.dtype != np.bool_:
        raise InvalidArgument(f"coverage: mask must be bool, got {mask.dtype}")
    return float(mask.mean()) if mask.size else float("nan")


def mask_scores(preds: Mask, target: Mask) -> dict[str, float]:
    """Agreement of a predicted mask with the true one, of any common shape.

    With ``both`` pixels in the two, ``p`` in ``preds``, ``t`` in ``target``:

    * ``dice``: ``2 both / (p + t)``, and ``iou``: ``both / (p + t - both)``; 1 where both masks are empty: they agree.
    * ``mask_precision``: ``both / p``; NaN where nothing is predicted. ``mask_recall``: ``both / t``; NaN where
      nothing is there to find.
    * ``pixel_accuracy``: share of pixels on which the masks agree. This, not Dice, is what
      ``torchmetrics.Dice()`` (1.2) gives for two binary images, because it counts the background as a class too.

    Raises:
        ValueError: masks that are not bool, of different shapes, or without pixels.

    Example:
        >>> import numpy as np
        >>> scores = mask_scores(np.array([True, True, False]), np.array([True, False, False]))
        >>> scores["iou"], scores["mask_precision"], scores["mask_recall"]
        (0.5, 0.5, 1.0)
    """
    for name, mask in (("preds", preds), ("target", target)):
        if mask.dtype != np.bool_:
            raise InvalidArgument(f"mask_scores: {name} must be bool, got {mask.dtype}")
    if preds.shape != target.shape or not preds.size:
        raise InvalidArgument(
            f"mask_scores: masks must have one shape with pixels, got {preds.shape} and {target.shape}"
        )
    both, p, t = int((preds & target).sum()), int(preds.sum()), int(target.sum())
    return {
        "dice": 2.0 * both / (p + t) if p + t else 1.0,
        "iou": both / (p + t - both) if p + t else 1.0,
        "mask_precision": both / p if p else float("nan"),
        "mask_recall": both / t if t else float("nan"),
        "pixel_accuracy": float((preds == target).mean()),
    }


def predicted_mask(accumulation: NDArray[Any], *, threshold: float) -> Mask:
    """Where a field claims a surface: ``accumulation >= threshold``, any shape.

    Raises:
        ValueError: a threshold outside (0, 1], or accumulations that are NaN or outside [0, 1] by more than 1e-3.

    Example:
        >>> import numpy as np
        >>> predicted_mask(np.array([0.2, 0.98]), threshold=0.98).tolist()
        [False, True]
    """
    if not 0 < threshold <= 1:
        raise InvalidArgument(f"predicted_mask: threshold must lie in (0, 1], got {threshold}")
    values = np.asarray(accumulation)
    if not ((values >= -1e-3) & (values <= 1 + 1e-3)).all():
        bad = int((~((values >= -1e-3) & (values <= 1 + 1e-3))).sum())
        raise InvalidArgument(f"predicted_mask: accumulation must lie in [0, 1], {bad} values do not")
    return np.asarray(values >= threshold, dtype=np.bool_)
