"""Table of a page as plain data: headings, rows and cells. The template ``macros.html.jinja`` draws it."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

from ..errors import InvalidArgument


@dataclass(frozen=True)
class Cell:
    """Table cell with more than plain text.

    Attributes:
        text: what it shows.
        below: second, smaller line, an interval for example.
        series: colour number of a chart series, shown before the text.
        style: CSS class: ``better``, ``worse``, ``weak`` or ``strong``.
    """

    text: str
    below: str = ""
    series: int | None = None
    style: str = ""


@dataclass(frozen=True)
class Table:
    """Table of a page. The first column names the rows.

    Attributes:
        heads: heading of each column.
        rows: cells of each row, as many as there are headings.
        text_columns: columns besides the first that are aligned left and wrap.
        tall: scroll within the page.
    """

    heads: Sequence[str]
    rows: Sequence[Sequence[str | Cell]]
    text_columns: Collection[int] = ()
    tall: bool = False

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.heads):
                raise InvalidArgument(f"Table: every row must have {len(self.heads)} cells, got {len(row)}")
