"""The figure of the two-trajectory benchmark: scores over coverage, in each method's own order and all in one."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from unghost.core.metrics import get_metric

from .compact import read_expanded
from .tables import COLORS, REFERENCE, Cell, finished, main_rows, score_at

DRAWN = (
    "field",
    "visibility",
    "visibility+tv",
    "visibility+distortion",
    "bayes-rays",
    "clean",
    "photo-doubt",
    "dsds-restoration",
    "dsds-restoration+tv",
    "dsds-restoration+distortion",
    "dsds-once+tv",
)
OTHERS = "#d0d0d0"
ROWS = {"own": "each cut in its own order of pixels", "photos": "all cut by photo doubt"}
COLUMNS = ("psnr", "disparity_mae")
UNITS = {"dB": ", dB"}  # worth a word on an axis


def write_figures(path: Path) -> None:
    """Curves of all methods, averaged over the scenes, beside the points of the main table; the reference, which has
    seen what it is scored on, is left out."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    results = read_expanded(path)
    rows = [row for row in main_rows(results, "main") if row.get("coverage") and row["method"] != REFERENCE]
    if not rows:
        return
    figure = Figure(figsize=(13, 9.4), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(len(ROWS), len(COLUMNS), squeeze=False, sharex=True, sharey="col")
    for line, (order, said) in zip(grid, ROWS.items()):
        for axes, key in zip(line, COLUMNS):
            _draw(axes, results["cells"], rows, key, order)
            axes.set_title(said, fontsize=11, loc="left")
            axes.set_ylabel(axis_label(key))
            if key == "disparity_mae":
                axes.set_yscale("log")
                for ticks in ("major", "minor"):
                    getattr(axes.yaxis, f"set_{ticks}_formatter")("{x:g}")
    for axes in grid[-1]:
        axes.set_xlabel("coverage: share of all pixels that are scored")
    if grid[0][0].get_legend_handles_labels()[0]:  # no curve begins where a barely trained field covers next to nothing
        grid[0][0].legend(fontsize=9, frameon=False)
    scenes, runs = {name for row in rows for name in row["scenes"]}, max(row["runs"] for row in rows)
    figure.suptitle(f"Two trajectories: {len(scenes)} scenes, {runs} runs a method at most; dots: uncut", fontsize=12)
    figure.savefig(path.with_suffix(".png"), dpi=100, metadata={"Software": None})


def axis_label(key: str) -> str:
    """A metric's name, unit and direction."""
    metric = get_metric(key)
    return f"{metric.name}{UNITS.get(metric.unit, '')} ({metric.better} is better)"


def _draw(axes: Any, cells: Sequence[Cell], rows: Sequence[dict[str, Any]], key: str, order: str) -> None:
    """The methods of the tables: those that matter in their colours, the others grey behind them."""
    known = [row for row in rows if row["method"] in DRAWN]
    known.sort(key=lambda row: DRAWN.index(row["method"]))
    others = [row for row in rows if row["method"] not in DRAWN]
    for place, row in enumerate([*others, *known]):
        drawn = place >= len(others)
        color = COLORS.get(row["method"], OTHERS) if drawn else OTHERS
        label = row["method"] if drawn else "others" if place == 0 else None
        points = mean_curve(cells, row["method"], key, order)
        if points:
            axes.plot(*zip(*points), linewidth=2.0 if drawn else 1.0, label=label, color=color)
        if row.get(key):
            axes.plot(row["coverage"], row[key], "o", color=color, markersize=6 if drawn else 4)
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)


def mean_curve(cells: Sequence[Cell], method: str, key: str, order: str = "own") -> list[tuple[float, float]]:
    """(coverage, mean of the scenes' means) at coverages that every run of a method reaches."""
    mine = [cell for cell in finished(cells) if (cell["table"], cell["method"]) == ("main", method)]
    found = []
    for coverage in np.round(np.arange(0.1, 1.0, 0.05), 2):
        scenes: dict[str, list[float | None]] = {}
        for cell in mine:
            scenes.setdefault(cell["scene"], []).append(score_at(cells, cell, key, float(coverage), order))
        values = [value for each in scenes.values() for value in each]
        if values and all(value is not None for value in values):
            found.append((float(coverage), float(np.mean([np.mean(each) for each in scenes.values()]))))  # type: ignore[arg-type]
    return found
