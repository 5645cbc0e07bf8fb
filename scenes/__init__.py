"""Synthetic scenes of known geometry: solids, furniture, photographs of them, rooms with labelled ghosts."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..core.lazy import attach

if TYPE_CHECKING:
    from .generator import PhotographedScene as PhotographedScene
    from .generator import observers as observers
    from .generator import photograph as photograph
    from .generator import photograph_again as photograph_again
    from .generator import random_scene as random_scene
    from .volume_renderer import Floats as Floats
    from .volume_renderer import camera_at as camera_at
    from .volume_renderer import render as render
    from .volume_renderer import shade as shade

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        ".generator": ["PhotographedScene", "observers", "photograph", "photograph_again", "random_scene"],
        ".volume_renderer": ["Floats", "camera_at", "render", "shade"],
    },
)
