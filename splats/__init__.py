"""3D Gaussian splats: files and the density field that they form. numpy only."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..core.lazy import attach

if TYPE_CHECKING:
    from .density import SplatField as SplatField
    from .ply import Gaussians as Gaussians
    from .ply import read_splat_ply as read_splat_ply
    from .ply import write_splat_ply as write_splat_ply

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        ".density": ["SplatField"],
        ".ply": ["Gaussians", "read_splat_ply", "write_splat_ply"],
    },
)
