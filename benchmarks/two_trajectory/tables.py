"""Means and tables of the two-trajectory benchmark, from its finished rows.

``psnr_at_coverage`` and its like compare methods on a scene and seed where every one of them is cut to the lowest
coverage among them, each at its own setting and in its own order of pixels; ``_by_spread`` and ``_by_photos``: all in
that order; ``_at_best``: the setting of its knob and the order that are best for it there, which takes an eye on the
truth. ``psnr_area`` and its like are means over all coverages from .1 up to that bar: one coverage is a moment of the
race. Between two measured coverages a score is interpolated linearly (``evaluation/scoring/curves.py``).

Means are over scenes, and intervals resample scenes; all pairs of sweeps of one capture are one scene, the mean of its
pairs (``independent``).
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from unghost.core.metrics import get_metric
from unghost.evaluation.scoring.curves import Curve
from unghost.evaluation.scoring.intervals import bootstrap_scenes, defined

KEYS = (
    "psnr",
    "ssim",
    "flip",
    "depth_mse",
    "disparity_mae",
    "normal_mean_deg",
    "normal_median_deg",
    "normal_pct_30",
    "coverage",
    "images_scored",
    "psnr_visible",
    "ause",
    "ause_by_spread",
    "ause_by_photos",
    "floater_recall",
    "surface_kept",
    "holes_filled",
    "free_space_error",
    "seconds",
    "cpu_seconds",
)
SECONDS = ("seconds", "cpu_seconds")  # of rows with the most threads
AT_EQUAL = ("psnr", "ssim", "disparity_mae", "normal_mean_deg")
FIXED = (0.3, 0.4, 0.5)
FROM = 0.1  # coverage at which areas begin
ORDERS = {"": "own", "_by_spread": "spread", "_by_photos": "photos", "_at_best": None}
REFERENCE = "pseudo-gt"
FEWER_SEEDS = (REFERENCE,)
COLORS = {  # in the order of the tables
    "pseudo-gt": "#bbbbbb",
    "fitted": "#888888",
    "field": "#444444",
    "visibility": "#1f77b4",
    "visibility+sparsity": "#9ecae1",
    "visibility+tv": "#17becf",
    "visibility+regnerf": "#74c476",
    "visibility+distortion": "#9467bd",
    "free-space": "#e7ba52",
    "bayes-rays": "#2ca02c",
    "visibility+bayes-rays": "#98df8a",
    "components": "#8c564b",
    "dsds-paper": "#f7b6d2",
    "photo-doubt": "#bc80bd",
    "dsds-restoration": "#d62728",
    "dsds-restoration+distortion": "#8b0000",
    "dsds-restoration+tv": "#e377c2",
    "dsds-once": "#b15928",
    "dsds-once+tv": "#6a3d9a",
    "clean": "#ff7f0e",
    "clean+points": "#c7681c",
    "visibility+clean": "#ffbb78",
    "dsds-restoration+clean": "#ff9896",
    "visibility+ds-nerf": "#b2df8a",
    "visibility+urban": "#33a02c",
    "visibility+nearest-point": "#a6761d",
    "visibility+floater-score": "#e6ab02",
    "visibility+sight-lines": "#cab2d6",
    "visibility+sight-lines+distortion": "#7570b3",
    "visibility+sight-lines+tv": "#e7298a",
    "dsds+sight-lines": "#d95f02",
    "dsds+sight-lines+distortion": "#a50026",
    "dsds+sight-lines+tv": "#f46d43",
    "scratch": "#666666",
    "scratch+distortion": "#80b1d3",
    "scratch+sight-lines": "#fb8072",
    "scratch+all": "#bf5b17",
}
Cell = dict[str, Any]


def summary_rows(cells: Sequence[Cell]) -> list[dict[str, Any]]:
    """A row a table and method: means over scenes and seeds, intervals over scenes, scores at equal coverage.

    Runs in which a method is still missing are left out: means over different scenes do not compare.
    """
    cells = finished(cells)
    equal = _at_equal_coverage(cells)
    rows = []
    for table, method in sorted(dict.fromkeys((cell["table"], cell["method"]) for cell in cells), key=_place):
        mine = [cell for cell in cells if (cell["table"], cell["method"]) == (table, method)]
        row: dict[str, Any] = {
            "method": method,
            "table": table,
            "convention": mine[0]["convention"],
            "scenes": sorted({cell["scene"] for cell in mine}),
            "runs": len(mine),
            "note": mine[-1].get("note", ""),
        }
        intervals = {}
        most = max(cell.get("threads", 0) for cell in mine)
        for key in KEYS:
            counted = [cell for cell in mine if key not in SECONDS or cell.get("threads", 0) == most]
            row[key], intervals[key] = _mean(counted, [_plain(cell, key) for cell in counted])
        for key in (f"{key}_{how}{order}" for key in AT_EQUAL for how in ("at_coverage", "area") for order in ORDERS):
            row[key], intervals[key] = _mean(mine, [equal.get((run_of(cell), method), {}).get(key) for cell in mine])
        row["at_coverage"], _ = _mean(mine, [equal.get((run_of(cell), method), {}).get("coverage") for cell in mine])
        for coverage in FIXED:
            reached = [score_at(cells, cell, "psnr", coverage) for cell in mine]
            every = all(value is not None for value in reached)  # or hard scenes would drop out of the mean
            row[f"psnr_at_{coverage:g}"] = _mean(mine, reached)[0] if every else None
        rows.append({**row, "intervals": intervals, "level": 0.95})
    return rows


def _place(row: tuple[str, str]) -> tuple[bool, str, int]:
    """Where a table's method stands: the main table first; methods that have no place of their own as they come."""
    table, method = row
    names = list(COLORS)
    name = method.split(" @ ")[0]
    return table != "main", table, names.index(name) if name in names else len(names)


def _plain(cell: Cell, key: str) -> float | None:
    """A number of a cell; ``ause`` and its like are kept by order."""
    if key.startswith("ause"):
        value: float | None = cell.get("ause", {}).get(ORDERS[key.removeprefix("ause")])
        return value
    return cell.get(key)


def finished(cells: Sequence[Cell]) -> list[Cell]:
    """Cells of runs that have every method of their table, those aside that may have fewer seeds."""
    wanted: dict[str, set[str]] = {}
    found: dict[tuple[Any, ...], set[str]] = {}
    for cell in cells:
        if cell["method"] not in FEWER_SEEDS and "@" not in cell["method"]:
            wanted.setdefault(cell["table"], set()).add(cell["method"])
            found.setdefault(run_of(cell), set()).add(cell["method"])
    return [cell for cell in cells if wanted.get(cell["table"], set()) <= found.get(run_of(cell), set())]


def run_of(cell: Cell) -> tuple[Any, ...]:
    """What cells have in common that compare with one another."""
    return tuple(cell.get(key) for key in ("table", "scene", "seed", "steps", "fit_steps", "scene_seed"))


def _mean(cells: Sequence[Cell], values: Sequence[float | None]) -> tuple[float | None, list[float | None]]:
    """Mean of the scenes' means and its interval; undefined values are left out."""
    scenes: dict[str, list[float | None]] = {}
    for cell, value in zip(cells, values):
        scenes.setdefault(cell["scene"], []).append(value)
    found = bootstrap_scenes(by_sample(scenes), np.random.default_rng(0))
    return found.mean, [found.low, found.high]


def independent(name: str) -> str:
    """What a scene is a sample of: pairs of sweeps of one capture are one capture, a synthetic scene is itself.

    Example:
        >>> independent("plush one to two at 1:8"), independent("room-0")
        ('plush', 'room-0')
    """
    pair = re.fullmatch(r"(.+) \S+ to \S+ at 1:\S+", name)
    return pair[1] if pair else name


def by_sample(scenes: Mapping[str, Sequence[float | None]]) -> dict[str, list[float | None]]:
    """Scene -> values over seeds, with a capture in the place of its pairs of sweeps: its values are the pairs' means.

    Example:
        >>> by_sample({"room-0": [1.0, 2.0], "plush a to b at 1:8": [3.0, 5.0], "plush b to a at 1:8": [8.0]})
        {'room-0': [1.0, 2.0], 'plush': [4.0, 8.0]}
    """
    samples: dict[str, list[list[float | None]]] = {}
    for scene, values in scenes.items():
        samples.setdefault(independent(scene), []).append(list(values))
    return {
        name: parts[0] if len(parts) == 1 else [_defined_mean(part) for part in parts]
        for name, parts in samples.items()
    }


def _defined_mean(values: Sequence[float | None]) -> float | None:
    known, _ = defined(values)
    return float(known.mean()) if len(known) else None


def _curve(cell: Cell, order: str, key: str) -> Curve | None:
    """Cut in one order of pixels; None where there is no score."""
    columns = cell.get("curves", {}).get(order, {})
    points = zip(columns.get("coverage", ()), columns.get(key, ()))
    rows = [
        {"coverage": coverage, key: value, "convention": cell["convention"]}
        for coverage, value in points
        if value is not None
    ]
    if not rows:
        return None
    return Curve.create(cell["method"], rows, metric=key)


def score_at(cells: Sequence[Cell], cell: Cell, key: str, coverage: float, order: str | None = "own") -> float | None:
    """A method's score at a coverage on one run; ``order`` None: at its best setting, in the order best for it."""
    same, orders = [cell], [order]
    if order is None:
        same += [
            other
            for other in cells
            if run_of(other) == run_of(cell) and other["method"].startswith(f"{cell['method']} @ ")
        ]
        orders = ["own", "spread", "photos"]
    curves = [_curve(each, name, key) for each in same for name in orders if name is not None]
    found = [value for value in (curve.at(coverage) for curve in curves if curve is not None) if value is not None]
    return (min if get_metric(key).better == "lower" else max)(found, default=None)


def compared(cells: Sequence[Cell]) -> list[Cell]:
    """Cells of one run that lower the bar: neither other settings of a knob (``method @ knob``) nor the reference."""
    return [cell for cell in cells if "@" not in cell["method"] and cell["method"] != REFERENCE]


def lowest_coverage(cells: Sequence[Cell]) -> float:
    """The coverage to which every method of one run is cut."""
    return min((cell["coverage"] or 0.0 for cell in compared(cells)), default=0.0)


def _at_equal_coverage(cells: Sequence[Cell]) -> dict[tuple[Any, str], dict[str, float | None]]:
    """(run, method) -> scores where all methods of the run are cut to the lowest coverage among them.

    A run in which somebody covers less than any curve reaches is left out for all: scores at two coverages do not
    compare.
    """
    result: dict[tuple[Any, str], dict[str, float | None]] = {}
    for run in dict.fromkeys(map(run_of, cells)):
        mine = [cell for cell in cells if run_of(cell) == run]
        lowest = lowest_coverage(mine)
        reached = [score_at(mine, cell, "psnr", lowest, "spread") for cell in compared(mine)]
        if not lowest or any(value is None for value in reached):
            continue
        turned = any("@" in cell["method"] for cell in mine)  # knobs are, on the first seed
        for cell in mine:
            found: dict[str, float | None] = {
                f"{key}_at_coverage{name}": score_at(mine, cell, key, lowest, order)
                for key in AT_EQUAL
                for name, order in ORDERS.items()
                if order is not None or turned
            }
            for key in AT_EQUAL:
                for name, order in ORDERS.items():
                    curve = None if order is None or lowest <= FROM else _curve(cell, order, key)
                    found[f"{key}_area{name}"] = None if curve is None else curve.area(FROM, lowest)
            result[run, cell["method"]] = {"coverage": lowest, **found}
    return result


def format_rows(rows: Sequence[dict[str, Any]], keys: Sequence[str]) -> str:
    """A markdown table."""
    lines = ["| method | " + " | ".join(keys) + " |", "| --- |" + " --- |" * len(keys)]
    for row in rows:
        cells = ["–" if row.get(key) is None else f"{row[key]:.3f}" for key in keys]
        lines.append(f"| {row['method']} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main_rows(results: dict[str, Any], table: str) -> list[dict[str, Any]]:
    """One row a method of a table, other settings of its knob left out."""
    return [row for row in results["rows"] if row["table"] == table and "@" not in row["method"]]


def per_scene(cells: Sequence[Cell], methods: Sequence[str], key: str) -> dict[str, dict[str, float]]:
    """Method -> scene -> mean over the seeds of the main table, of anything that a row has; undefined ones are left
    out."""
    cells = [cell for cell in finished(cells) if cell["table"] == "main"]
    equal = _at_equal_coverage(cells)
    result: dict[str, dict[str, float]] = {}
    for method in methods:
        values: dict[str, list[float]] = {}
        for cell in cells:
            found = equal.get((run_of(cell), method), {}).get(key, _plain(cell, key))
            if cell["method"] == method and found is not None:
                values.setdefault(cell["scene"], []).append(found)
        result[method] = {scene: float(np.mean(each)) for scene, each in values.items()}
    return result


def per_sample(found: Mapping[str, float]) -> dict[str, float]:
    """Scene -> value, with a capture in the place of its pairs of sweeps, by the mean of theirs."""
    values = by_sample({scene: [value] for scene, value in found.items()})
    return {name: float(np.mean(each)) for name, each in values.items()}  # type: ignore[arg-type]
