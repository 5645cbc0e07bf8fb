"""Procedural solids as signed distances and exact booleans; cubes composed of them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ...core.lazy import attach

if TYPE_CHECKING:
    from .compose import dilate as dilate
    from .compose import sample_cube as sample_cube

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        ".compose": ["dilate", "sample_cube"],
    },
)
