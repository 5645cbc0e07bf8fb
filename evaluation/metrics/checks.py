"""Argument checks that the metrics share: shapes, masks, ranges, named choices."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ...core.errors import InvalidArgument

FloatArray = NDArray[np.float64]
Mask = NDArray[np.bool_]
Choice = TypeVar("Choice")


def check_pair(caller: str, preds: NDArray[Any], target: NDArray[Any], mask: NDArray[Any], *, channels: bool) -> None:
    """Refuse anything but two ``(H, W, C)`` images, or ``(H, W)`` maps, and a bool mask ``(H, W)``."""
    wanted = "(H, W, C)" if channels else "(H, W)"
    if preds.ndim != (3 if channels else 2):
        raise InvalidArgument(f"{caller}: preds must have shape {wanted}, got {preds.shape}")
    if target.shape != preds.shape:
        raise InvalidArgument(f"{caller}: target must have the shape of preds {preds.shape}, got {target.shape}")
    if mask.dtype != np.bool_ or mask.shape != preds.shape[:2]:
        raise InvalidArgument(f"{caller}: mask must be bool of shape {preds.shape[:2]}, got {mask.dtype} {mask.shape}")


def check_range(caller: str, data_range: float) -> None:
    """Refuse a ``data_range`` that is not finite and > 0."""
    if not (np.isfinite(data_range) and data_range > 0):
        raise InvalidArgument(f"{caller}: data_range must be finite and > 0, got {data_range}")


def picked(caller: str, values: NDArray[Any], mask: Mask) -> FloatArray:
    """The unmasked values, refused if one of them is NaN or infinite."""
    chosen = values[mask].astype(np.float64)
    if not np.isfinite(chosen).all():
        raise InvalidArgument(f"{caller}: {int((~np.isfinite(chosen)).sum())} unmasked values are NaN or infinite")
    return chosen


def choose(caller: str, argument: str, name: str, table: Mapping[str, Choice]) -> Choice:
    """What ``table`` holds under ``name``; an unknown name lists the choices."""
    if name not in table:
        raise InvalidArgument(f"{caller}: {argument} must be one of {', '.join(table)}, got {name!r}")
    return table[name]
