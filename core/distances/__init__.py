"""Signed distances: analytic solids, and solids known at the nodes of a grid."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..lazy import attach

if TYPE_CHECKING:
    from .sampled import SampledDistance as SampledDistance
    from .signed import sphere as sphere

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        ".sampled": ["SampledDistance"],
        ".signed": ["sphere"],
    },
)
