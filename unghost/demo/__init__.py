"""``unghost demo``: clean a room whose ghosts are known, and score what happened."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..core.lazy import attach

if TYPE_CHECKING:
    from .run import Outcome as Outcome
    from .run import run_demo as run_demo
    from .run import score as score
    from .run import summary_table as summary_table

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        ".run": ["Outcome", "run_demo", "score", "summary_table"],
    },
)
