"""The speed-error figure of the reference measurement, its Pareto front marked."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

PANELS = (
    ("synthetic", "iou", "mean IoU, mixed corruption of unseen meshes"),
    ("harvest", "ghosts_removed_98", "ghosts removed at .98 kept, unseen scenes"),
    ("capture", "ghosts_removed_98", "ghosts removed at .98 kept, real capture"),
)


def pareto(points: Sequence[tuple[float, float]]) -> list[int]:
    """Which of ``(speed, score)`` no other one beats in both, slowest first."""
    front: list[int] = []
    for index in sorted(range(len(points)), key=lambda i: (-points[i][0], -points[i][1])):
        if not front or points[index][1] > points[front[-1]][1]:
            front.append(index)
    return front[::-1]


def _value(rows: Sequence[dict[str, Any]], method: str, name: str, key: str) -> float | None:
    for row in rows:
        mean = row.get("severity") == "mean" if name == "synthetic" else True
        if row["method"] == method and row["set"] == name and mean:
            value = row.get(key)
            return None if value is None else float(value)
    return None


def draw(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    """A panel a set: models against their speed, the best way to use each filled and named, the best of the filters
    (untimed) and the input as lines."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    speeds = {row["method"]: row["cubes_per_second"] for row in rows if "cubes_per_second" in row}
    models = dict.fromkeys((row["method"] for row in rows), None) | {
        row["method"]: row["model"] for row in rows if "model" in row
    }
    names = list(dict.fromkeys(row["method"] for row in rows))
    figure, axes = plt.subplots(1, len(PANELS), figsize=(17, 5.2), constrained_layout=True)
    for axis, (name, key, heading) in zip(axes, PANELS):
        found = {method: _value(rows, method, name, key) for method in names}
        timed = [
            (method, speeds[models[method]], value)
            for method, value in found.items()
            if value is not None and models[method] in speeds
        ]
        best: dict[Any, tuple[float, str]] = {}  # of the ways to use a model
        for method, _, value in timed:
            best[models[method]] = max(best.get(models[method], (value, method)), (value, method))
        for method, speed, value in timed:
            named = best[models[method]][1] == method
            axis.plot(speed, value, "o", color="#2a7f62", fillstyle="full" if named else "none")
            if not named:
                continue
            left = speed == max(s for _, s, _ in timed)  # the fastest one's name would leave the panel
            offset, side = ((-5, -12), "right") if left else ((5, 6), "left")
            axis.annotate(method, (speed, value), xytext=offset, textcoords="offset points", fontsize=8, ha=side)
        front = [timed[index] for index in pareto([(speed, value) for _, speed, value in timed])]
        axis.plot([speed for _, speed, _ in front], [value for _, _, value in front], color="#2a7f62", linewidth=1)
        filters = {m: v for m, v in found.items() if v is not None and models[m] is None}
        for method in [*sorted(filters, key=lambda m: -(filters[m] or 0.0))[:1], "input"]:
            if method in filters:
                axis.axhline(filters[method], color="#999999", linewidth=0.8, linestyle="--")
                axis.annotate(
                    f"{method} (no training)",
                    (0.01, filters[method]),
                    fontsize=7,
                    color="#666666",
                    xycoords=("axes fraction", "data"),
                    va="bottom",
                )
        axis.set_title(heading, fontsize=10)
        axis.set_xlabel("cubes a second, two threads")
        if timed:
            axis.set_xscale("log")
            axis.xaxis.set_major_formatter("{x:.0f}")
            axis.xaxis.set_minor_formatter("{x:.0f}")
            axis.margins(x=0.15)
    figure.savefig(path, dpi=90)
    plt.close(figure)
