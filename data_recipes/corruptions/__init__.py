"""Structured corruptions of occupancy cubes, and soft inputs made from bits."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ...core.lazy import attach

if TYPE_CHECKING:
    from .softening import soften as soften
    from .structured import CORRUPTIONS as CORRUPTIONS
    from .structured import corrupt as corrupt

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        ".softening": ["soften"],
        ".structured": ["CORRUPTIONS", "corrupt"],
    },
)
