"""Captures: posed photos, COLMAP models, named sweeps, and making new ones."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ...core.lazy import attach

if TYPE_CHECKING:
    from .birds_eye import draw_birds_eye as draw_birds_eye
    from .colmap import find_model as find_model
    from .creation import make_capture as make_capture
    from .difficulty import difficulty_rows as difficulty_rows
    from .difficulty import difficulty_text as difficulty_text
    from .difficulty import every_nth as every_nth
    from .loading import Capture as Capture
    from .loading import load_cameras as load_cameras
    from .loading import load_capture as load_capture
    from .loading import load_points as load_points
    from .nerfstudio import write_nerfstudio as write_nerfstudio
    from .points import read_points as read_points
    from .posing import PosingSettings as PosingSettings
    from .splits import choose_split as choose_split
    from .triangulation import triangulate as triangulate

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        ".birds_eye": ["draw_birds_eye"],
        ".colmap": ["find_model"],
        ".creation": ["make_capture"],
        ".difficulty": ["difficulty_rows", "difficulty_text", "every_nth"],
        ".loading": ["Capture", "load_cameras", "load_capture", "load_points"],
        ".nerfstudio": ["write_nerfstudio"],
        ".points": ["read_points"],
        ".posing": ["PosingSettings"],
        ".splits": ["choose_split"],
        ".triangulation": ["triangulate"],
    },
)
