"""Mesh files, read strictly and in a guarded process; cubes cut from meshes."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ...core.lazy import attach

if TYPE_CHECKING:
    from .crops import choose_frame as choose_frame
    from .crops import cut_cubes as cut_cubes
    from .crops import sample_mesh_cubes as sample_mesh_cubes
    from .library import Mesh as Mesh
    from .library import read_manifest as read_manifest

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        ".crops": ["choose_frame", "cut_cubes", "sample_mesh_cubes"],
        ".library": ["Mesh", "read_manifest"],
    },
)
