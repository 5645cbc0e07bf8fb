"""Which cameras see a place: view counts by frustum, transmittance through the field."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..lazy import attach

if TYPE_CHECKING:
    from .rectangles import BORDER_POINTS as BORDER_POINTS
    from .rectangles import image_rectangles as image_rectangles
    from .rectangles import side_normals as side_normals
    from .transmittance import DensityFn as DensityFn
    from .transmittance import TransmittanceMaps as TransmittanceMaps
    from .view_counts import count_views as count_views
    from .view_counts import pinholes as pinholes

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        ".rectangles": ["BORDER_POINTS", "image_rectangles", "side_normals"],
        ".transmittance": ["DensityFn", "TransmittanceMaps"],
        ".view_counts": ["count_views", "pinholes"],
    },
)
