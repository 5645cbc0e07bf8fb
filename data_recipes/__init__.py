"""Cube recipes: procedural and mesh cubes, corruptions, harvested pairs."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..core.lazy import attach

if TYPE_CHECKING:
    from .curation import curate as curate
    from .online import OnlinePairs as OnlinePairs
    from .pairs import SOFT_SKIRT as SOFT_SKIRT
    from .pairs import make_chunk as make_chunk
    from .recipe import Recipe as Recipe
    from .recipe import load_recipe as load_recipe

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        ".curation": ["curate"],
        ".online": ["OnlinePairs"],
        ".pairs": ["SOFT_SKIRT", "make_chunk"],
        ".recipe": ["Recipe", "load_recipe"],
    },
)
