"""Tables, figures and HTML pages of scores."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ...core.lazy import attach

if TYPE_CHECKING:
    from .page import read_results as read_results
    from .page import write_page as write_page
    from .pictures import PHOTO as PHOTO
    from .pictures import view_pictures as view_pictures
    from .pictures import worst_first as worst_first
    from .rows import convention_rows as convention_rows
    from .rows import draw_comparison as draw_comparison
    from .rows import format_conventions as format_conventions
    from .rows import format_table as format_table
    from .rows import mean_over_seeds as mean_over_seeds
    from .tables import EQUAL_KEYS as EQUAL_KEYS
    from .tables import OWN_KEYS as OWN_KEYS
    from .tables import present as present

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        ".page": ["read_results", "write_page"],
        ".pictures": ["PHOTO", "view_pictures", "worst_first"],
        ".rows": ["convention_rows", "draw_comparison", "format_conventions", "format_table", "mean_over_seeds"],
        ".tables": ["EQUAL_KEYS", "OWN_KEYS", "present"],
    },
)
