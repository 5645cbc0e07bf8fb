"""Line charts and histograms of a page as plain data: where lines, bars and labels go, in SVG units.

The template ``macros.html.jinja`` draws them: no script, no library, readable on a phone, light and dark.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

COLOURS = 8  # in the style sheet; further series are dashed
TICKS = 6  # about that many, never more


@dataclass(frozen=True)
class Series:
    """Line of a chart.

    Attributes:
        label: for the key.
        x, y: of its points, finite, in rising ``x``; a single point is drawn as a disc.
        colour: number of its colour.
        notes: text of each point, shown on hovering.
    """

    label: str
    x: tuple[float, ...]
    y: tuple[float, ...]
    colour: int = 0
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Mark:
    """Text at a place along an axis or at a point."""

    x: float
    y: float
    text: str


@dataclass(frozen=True)
class Line:
    """Series in SVG units, with a note for each point."""

    label: str
    colour: int
    points: tuple[Mark, ...]


@dataclass(frozen=True)
class LineChart:
    """Line chart in SVG units. ``key`` pairs colours with labels; ``dots`` draws every point."""

    kind: ClassVar[str] = "lines"
    width: ClassVar[int] = 560
    height: ClassVar[int] = 320
    left: ClassVar[int] = 52
    right: ClassVar[int] = 546
    top: ClassVar[int] = 12
    bottom: ClassVar[int] = 274

    x_label: str
    y_label: str
    x_ticks: tuple[Mark, ...]
    y_ticks: tuple[Mark, ...]
    lines: tuple[Line, ...]
    key: tuple[tuple[int, str], ...]
    dots: bool


@dataclass(frozen=True)
class Bar:
    """Bar of a histogram in SVG units, with the share that it stands for."""

    x: float
    y: float
    width: float
    height: float
    colour: int
    share: float


@dataclass(frozen=True)
class Histogram:
    """Histogram in SVG units. ``highest`` is the share of the tallest bar."""

    kind: ClassVar[str] = "bars"
    width: ClassVar[int] = 320
    height: ClassVar[int] = 146
    left: ClassVar[int] = 4
    right: ClassVar[int] = 316
    top: ClassVar[int] = 20
    bottom: ClassVar[int] = 120

    bars: tuple[Bar, ...]
    marks: tuple[tuple[Mark, str], ...]
    key: tuple[tuple[int, str], ...]
    highest: float


def colours_of(methods: Sequence[str]) -> dict[str, int]:
    """Assign one colour number to each method, for all charts and tables of a page."""
    return {name: index for index, name in enumerate(dict.fromkeys(methods))}


def series_class(colour: int) -> str:
    """CSS classes of a colour number."""
    return f"s{colour % COLOURS}{' dashed' if colour >= COLOURS else ''}"


def percent(share: float) -> str:
    """Share as a percentage: one decimal below 10 %, none above."""
    if 0 < share < 0.0005:
        return "< 0.1\u00a0%"
    return f"{100 * share:.0f}\u00a0%" if share == 0 or share >= 0.0995 else f"{100 * share:.1f}\u00a0%"


def line_chart(series: Sequence[Series], *, x_label: str, y_label: str, dots: bool = True) -> LineChart | None:
    """Lay out a line chart.

    Args:
        series: those without points are left out; several of one colour and label (seeds) share a key entry.
        x_label, y_label: names of the axes.
        dots: mark every point.

    Returns:
        The chart, None if there is no point.
    """
    drawn = [each for each in series if each.x]
    if not drawn:
        return None
    x_low, x_high = _range([value for each in drawn for value in each.x])
    y_low, y_high = _range([value for each in drawn for value in each.y])
    frame = LineChart

    def place(x: float, y: float, text: str) -> Mark:
        across = frame.left + (x - x_low) / (x_high - x_low) * (frame.right - frame.left)
        down = frame.bottom - (y - y_low) / (y_high - y_low) * (frame.bottom - frame.top)
        return Mark(round(across, 1), round(down, 1), text)

    def line(each: Series) -> Line:
        values = [f"{x:.4g}, {y:.4g}" for x, y in zip(each.x, each.y)]
        notes = [*each.notes, *values[len(each.notes) :]]
        return Line(each.label, each.colour, tuple(map(place, each.x, each.y, notes)))

    return LineChart(
        x_label=x_label,
        y_label=y_label,
        x_ticks=tuple(place(value, y_low, _short(value)) for value in _ticks(x_low, x_high)),
        y_ticks=tuple(place(x_low, value, _short(value)) for value in _ticks(y_low, y_high)),
        lines=tuple(map(line, drawn)),
        key=tuple(dict.fromkeys((each.colour, each.label) for each in drawn)),
        dots=dots,
    )


def histogram(
    series: Mapping[str, NDArray[Any]], bins: int, marks: Mapping[float, str], *, colours: Sequence[int] = (7, 2)
) -> Histogram:
    """Lay out one or two distributions over the same bins, as shares of each.

    Args:
        series: one or two names to counts or weights ``(bins,)``.
        bins: number of bins, drawn equally wide.
        marks: position, in bins, to the text under it.
        colours: colour numbers of the series.
    """
    frame = Histogram
    shares = {name: counts / max(float(counts.sum()), 1e-12) for name, counts in series.items()}
    highest = max(max(float(np.max(values)) for values in shares.values()), 1e-12)
    step = (frame.right - frame.left) / bins
    wide = step / len(shares)
    bars = []
    for number, values in enumerate(shares.values()):
        for index, share in enumerate(map(float, values)):
            tall = round((frame.bottom - frame.top) * share / highest, 1)
            if tall > 0:
                left = round(frame.left + index * step + number * wide, 1)
                bars.append(Bar(left, frame.bottom - tall, round(max(wide - 1, 1), 1), tall, colours[number], share))
    placed = tuple(
        (
            Mark(round(frame.left + place * step, 1), frame.bottom + 17, text),
            "start" if place == 0 else "end" if place >= bins else "middle",
        )
        for place, text in marks.items()
    )
    key = tuple(zip(colours, shares)) if len(shares) > 1 else ()
    return Histogram(tuple(bars), placed, key, highest)


def _range(values: Sequence[float]) -> tuple[float, float]:
    low, high = min(values), max(values)
    margin = 0.06 * (high - low) or max(abs(high) * 0.05, 0.05)
    return low - margin, high + margin


def _ticks(low: float, high: float) -> list[float]:
    """Round numbers within a range."""
    rough = (high - low) / TICKS
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(each * power for each in (1, 2, 2.5, 5, 10) if each * power >= rough)
    first = math.ceil(low / step)
    return [step * index for index in range(first, math.floor(high / step) + 1)]


def _short(value: float) -> str:
    return f"{value:.4g}".replace("-", "−")
