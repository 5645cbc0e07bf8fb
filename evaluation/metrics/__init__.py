"""Masked image and geometry metrics, as numpy functions in the order preds, target, mask."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ...core.lazy import attach

if TYPE_CHECKING:
    from .perceptual import Lpips as Lpips
    from .perceptual import LpipsUnavailable as LpipsUnavailable
    from .perceptual import load_lpips as load_lpips
    from .pixelwise import psnr as psnr

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        ".perceptual": ["Lpips", "LpipsUnavailable", "load_lpips"],
        ".pixelwise": ["psnr"],
    },
)
