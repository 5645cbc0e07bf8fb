"""A furnished room of known geometry with ghosts whose place is known."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ...core.lazy import attach

if TYPE_CHECKING:
    from .ghosts import KINDS as KINDS
    from .observations import room_cameras as room_cameras
    from .observations import room_points as room_points
    from .room import AABB as AABB
    from .room import SHAPE as SHAPE
    from .room import Room as Room
    from .room import build_room as build_room

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        ".ghosts": ["KINDS"],
        ".observations": ["room_cameras", "room_points"],
        ".room": ["AABB", "Room", "SHAPE", "build_room"],
    },
)
