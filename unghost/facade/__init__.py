"""The calls that choose a model; the functions and classes below them require their denoiser."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..core.lazy import attach

if TYPE_CHECKING:
    from .cleaning import clean as clean
    from .cleaning import clean_ply as clean_ply
    from .cleaning import clean_splats as clean_splats
    from .regularization import DensityRegularizer as DensityRegularizer

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        ".cleaning": ["clean", "clean_ply", "clean_splats"],
        ".regularization": ["DensityRegularizer"],
    },
    extras={".regularization": "torch"},
)
