"""A figure of the distributions that :mod:`.point_measures` finds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .point_measures import VIEWS, Measured

COLORS = {
    "triangulated, capture": "#b03a2e",
    "triangulated, synthetic": "#1f5f99",
    "simulated": "#2a7f62",
    "simulated, harvest": "#d08c1d",
}
CURVES = {  # measure: title, the right end of its axis
    "error": ("reprojection error, matched pixels", 2.5),
    "angle": ("triangulation angle, degrees", 90.0),
    "off_pixels": ("distance to the surface, matched pixels", 12.0),
    "off_sigmas": ("distance to the surface, own uncertainties", 6.0),
}
EACH = 400  # values of each set, so that all sets of a row weigh the same


def pooled(sets: Sequence[Measured], name: str) -> NDArray[Any]:
    """Sorted values of several sets, as many of each."""
    at = (np.arange(EACH) + 0.5) / EACH
    return np.sort(np.concatenate([np.nanquantile(each.values[name], at) for each in sets if name in each.values]))


def draw(path: Path, rows: Mapping[str, tuple[str, Sequence[Measured]]]) -> None:
    """Draw shares of views, cumulative distributions, and wrong points.

    Args:
        path: of the PNG.
        rows: name -> origin (a key of ``COLORS``) and sets.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(2, 4, figsize=(16, 7.5), constrained_layout=True)
    shown = set[str]()
    for origin, sets in rows.values():
        style: dict[str, Any] = {"color": COLORS[origin], "linewidth": 1.4, "alpha": 0.75}
        label = None if origin in shown else origin
        shown.add(origin)
        shares = [np.mean([each.numbers[f"views_{count}"] for each in sets]) for count in VIEWS]
        axes[0, 0].plot(range(len(VIEWS)), shares, marker="o", markersize=3, label=label, **style)
        for axis, name in zip(axes.flat[1:], CURVES):
            if any(name in each.values for each in sets):
                values = pooled(sets, name)
                axis.plot(values, (np.arange(len(values)) + 0.5) / len(values), **style)
    axes[0, 0].set_xticks(range(len(VIEWS)), [*map(str, VIEWS[:-1]), f"{VIEWS[-1]}+"])
    axes[0, 0].set_title("share of points, by photos that observed them", fontsize=9)
    axes[0, 0].legend(fontsize=8)
    for axis, (title, right) in zip(axes.flat[1:], CURVES.values()):
        axis.set(xlim=(0, right), ylim=(0, 1))
        axis.set_title(f"{title} (share below)", fontsize=9)
    bars(axes.flat[5], rows, "outvoted", "share of observations that the vote drops")
    bars(axes.flat[6], rows, "wrong", "share of wrong points")
    bars(axes.flat[7], rows, "texture_rank", "chance of more contrast than a random pixel")
    figure.savefig(path, dpi=80)
    plt.close(figure)


def bars(axis: Any, rows: Mapping[str, tuple[str, Sequence[Measured]]], name: str, title: str) -> None:
    """A bar a row: the median of its sets, and dots for each of them."""
    here = {row: [each.numbers[name] for each in sets if name in each.numbers] for row, (_, sets) in rows.items()}
    for number, (row, values) in enumerate((row, values) for row, values in here.items() if values):
        color = COLORS[rows[row][0]]
        axis.barh(number, np.nanmedian(values), color=color, alpha=0.6)
        axis.plot(values, [number] * len(values), ".", color=color, markersize=4)
        axis.text(0, number, f" {row.rpartition(': ')[2]}", fontsize=6, va="center")
    axis.set_yticks([])
    axis.invert_yaxis()
    axis.set_title(title, fontsize=9)
