"""Density fields and synthetic scenes. Importing this package needs numpy only; radiance fields need torch."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..core.lazy import attach

if TYPE_CHECKING:
    from .filtered import FilteredField as FilteredField
    from .kinds import TrainableField as TrainableField
    from .kinds import make_field as make_field
    from .radiance import CONTRACTED as CONTRACTED
    from .radiance import RadianceConfig as RadianceConfig
    from .radiance import RadianceField as RadianceField
    from .radiance import contract as contract
    from .rendering import Rendering as Rendering
    from .rendering import Sampling as Sampling
    from .rendering import render_rays as render_rays
    from .rendering import render_view as render_view
    from .training import TrainingConfig as TrainingConfig
    from .training import gather_rays as gather_rays
    from .training import train_field as train_field

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        ".filtered": ["FilteredField"],
        ".kinds": ["TrainableField", "make_field"],
        ".radiance": ["CONTRACTED", "RadianceConfig", "RadianceField", "contract"],
        ".rendering": ["Rendering", "Sampling", "render_rays", "render_view"],
        ".training": ["TrainingConfig", "gather_rays", "train_field"],
    },
)
