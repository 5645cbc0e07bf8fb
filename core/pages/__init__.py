"""HTML pages: Jinja2 templates, one style sheet, and the data that their tables and charts take."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..lazy import attach

if TYPE_CHECKING:
    from .charts import Histogram as Histogram
    from .charts import LineChart as LineChart
    from .charts import Series as Series
    from .charts import histogram as histogram
    from .charts import line_chart as line_chart
    from .rendering import environment as environment
    from .rendering import render as render
    from .tables import Cell as Cell
    from .tables import Table as Table

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        ".charts": ["Histogram", "LineChart", "Series", "histogram", "line_chart"],
        ".rendering": ["environment", "render"],
        ".tables": ["Cell", "Table"],
    },
)
