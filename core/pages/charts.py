"""Line charts of a report's page, as SVG: no script, no library, readable on a phone, light and dark."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from .tables import text

COLOURS = 8  # of the style sheet; further series are dashed
WIDTH, HEIGHT = 560, 320
LEFT, RIGHT, TOP, BOTTOM = 52, 14, 12, 46
TICKS = 6  # about that many, never more


@dataclass(frozen=True)
class Series:
    """One line.

    Attributes:
        label: for the key.
        x, y: of its points, finite, in rising ``x``; a single point is drawn as a disc.
        colour: number of its colour.
        notes: a text a point, shown on hovering.
    """

    label: str
    x: tuple[float, ...]
    y: tuple[float, ...]
    colour: int = 0
    notes: tuple[str, ...] = ()


def colours_of(methods: Sequence[str]) -> Mapping[str, int]:
    """The same colour for a method in every chart and table."""
    return {name: index for index, name in enumerate(dict.fromkeys(methods))}


def swatch(colour: int) -> str:
    """A small square of a series' colour."""
    return f'<i class="swatch s{colour % COLOURS}{" dashed" if colour >= COLOURS else ""}"></i>'


def line_chart(series: Sequence[Series], *, x_label: str, y_label: str, dots: bool = True) -> str:
    """An SVG with its key; empty text if there is no point."""
    drawn = [each for each in series if each.x]
    if not drawn:
        return ""
    x_low, x_high = _range([value for each in drawn for value in each.x])
    y_low, y_high = _range([value for each in drawn for value in each.y])

    def place(x: float, y: float) -> tuple[float, float]:
        return (
            LEFT + (x - x_low) / (x_high - x_low) * (WIDTH - LEFT - RIGHT),
            HEIGHT - BOTTOM - (y - y_low) / (y_high - y_low) * (HEIGHT - TOP - BOTTOM),
        )

    parts = [
        f'<svg class="chart" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{text(y_label)} over '
        f'{text(x_label)}">'
    ]
    for value in _ticks(y_low, y_high):
        y = place(x_low, value)[1]
        parts.append(f'<line class="grid" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>')
        parts.append(f'<text x="{LEFT - 7}" y="{y + 4:.1f}" text-anchor="end">{_short(value)}</text>')
    for value in _ticks(x_low, x_high):
        x = place(value, y_low)[0]
        parts.append(f'<text x="{x:.1f}" y="{HEIGHT - BOTTOM + 19}" text-anchor="middle">{_short(value)}</text>')
    parts.append(f'<text x="{(LEFT + WIDTH - RIGHT) / 2}" y="{HEIGHT - 5}" text-anchor="middle">{text(x_label)}</text>')
    for each in drawn:
        parts.append(_line(each, [place(x, y) for x, y in zip(each.x, each.y)], dots))
    labels = dict.fromkeys((each.colour, each.label) for each in drawn)  # several seeds of a method share one
    key = "".join(f"<span>{swatch(colour)}{text(label)}</span>" for colour, label in labels)
    return "".join(parts) + f'</svg><p class="key">{key}</p>'


def _line(series: Series, points: Sequence[tuple[float, float]], dots: bool) -> str:
    style = f"s{series.colour % COLOURS}{' dashed' if series.colour >= COLOURS else ''}"
    path = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    drawn = f'<polyline class="{style}" points="{path}"/>' if len(points) > 1 else ""
    radius = 5 if len(points) == 1 else 3
    for index, (x, y) in enumerate(points if dots or len(points) == 1 else []):
        note = series.notes[index] if index < len(series.notes) else f"{series.x[index]:.4g}, {series.y[index]:.4g}"
        title = f"<title>{text(series.label)}: {text(note)}</title>"
        drawn += f'<circle class="{style}" cx="{x:.1f}" cy="{y:.1f}" r="{radius}">{title}</circle>'
    return drawn


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
