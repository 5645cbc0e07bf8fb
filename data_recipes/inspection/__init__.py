"""Pictures and statistics of cube sets."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ...core.lazy import attach

if TYPE_CHECKING:
    from .drawing import GHOST as GHOST
    from .drawing import MISSING as MISSING
    from .drawing import SURFACE as SURFACE
    from .drawing import UNJUDGED as UNJUDGED
    from .drawing import best_turn as best_turn
    from .drawing import png_bytes as png_bytes
    from .drawing import render_cube as render_cube
    from .preview import draw_pair as draw_pair
    from .preview import write_preview as write_preview
    from .statistics import FEATURES as FEATURES
    from .statistics import CubeStatistics as CubeStatistics
    from .statistics import cube_statistics as cube_statistics
    from .statistics import feature_distances as feature_distances
    from .statistics import sampling_floor as sampling_floor
    from .statistics import shard_statistics as shard_statistics

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        ".drawing": ["GHOST", "MISSING", "SURFACE", "UNJUDGED", "best_turn", "png_bytes", "render_cube"],
        ".preview": ["draw_pair", "write_preview"],
        ".statistics": [
            "CubeStatistics",
            "FEATURES",
            "cube_statistics",
            "feature_distances",
            "sampling_floor",
            "shard_statistics",
        ],
    },
)
