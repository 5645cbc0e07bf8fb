"""nerfacto with the regularizer, as a nerfstudio method."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ...core.lazy import attach

if TYPE_CHECKING:
    from .model import UnghostNerfactoModelConfig as UnghostNerfactoModelConfig
    from .model import cameras_of as cameras_of
    from .pitch import hash_pitch as hash_pitch
    from .pitch import surface_cells as surface_cells
    from .points import TrainingPoints as TrainingPoints
    from .points import load_training_points as load_training_points

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        ".model": ["UnghostNerfactoModelConfig", "cameras_of"],
        ".pitch": ["hash_pitch", "surface_cells"],
        ".points": ["TrainingPoints", "load_training_points"],
    },
)
