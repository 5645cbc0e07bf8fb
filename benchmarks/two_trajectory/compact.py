"""Compact form of the two-trajectory results, a fifth of the full form: what ``docs/results`` stores.

``runs`` replaces ``cells``. Cells of one run stand together: a value that all of them share is stored once, the others
as rows under ``columns``. Scores have 5 significant digits, which keeps what the tables print. ``curves.ORDER`` lists
the scores of ``SCALES`` as integers, first at the cell's own coverage, then at ``curves.percent`` of all pixels, 10
points at most. Rows leave out what is undefined or printed nowhere.

:func:`expanded` restores the list of cells from either form.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from unghost.core.metrics import METRICS
from unghost.evaluation.report.tables import EQUAL_KEYS, OWN_KEYS

from ..compact import rounded, write_lines
from .tables import AT_EQUAL, FROM, Cell, lowest_coverage, run_of

POINTS = 10
ROW_DIGITS = 7  # no number that is printed is rounded twice
SCALES = dict(zip(AT_EQUAL, (1000, 10_000, 10_000, 100)))  # score of a curve -> parts of its unit
EXACT = ("factor", "knob")  # compared, not averaged
NESTED = ("curves", "ause")  # a value for each order of pixels; ``own`` is left out where it is ``spread``
UNPRINTED = "normal_mean_deg_area"

PRINTED = frozenset((*OWN_KEYS, *EQUAL_KEYS))  # metrics whose intervals reports print


def write_compact(path: Path, results: Mapping[str, Any]) -> None:
    """Write results in the compact form."""
    write_lines(path, compact(results))


def read_expanded(path: Path) -> dict[str, Any]:
    """Read results of either form, in the full one."""
    return expanded(json.loads(path.read_text(encoding="utf-8")))


def compact(results: Mapping[str, Any]) -> dict[str, Any]:
    """Results in the compact form; those that are compact already do not change."""
    whole = expanded(results)
    runs: dict[Any, list[Cell]] = {}
    for cell in whole.pop("cells"):
        runs.setdefault(run_of(cell), []).append(cell)
    rows = compact_rows(whole.pop("rows"))
    return {**rounded(whole), "runs": [_packed(cells) for cells in runs.values()], "rows": rows}


def expanded(results: Mapping[str, Any]) -> dict[str, Any]:
    """Results with ``cells`` as a list of objects, from either form."""
    whole = dict(results)
    if "runs" in whole:
        whole["cells"] = [
            _nested({**run["shared"], **dict(zip(run["columns"], values))})
            for run in whole.pop("runs")
            for values in run["cells"]
        ]
    return whole


def compact_rows(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Summary rows without what is undefined; intervals of the metrics that reports print, with as many digits."""
    result = []
    for row in rows:
        known = {key: value for key, value in row.items() if value is not None and not key.startswith(UNPRINTED)}
        intervals = {
            key: [round(end, METRICS[key].decimals) for end in ends]
            for key, ends in known.pop("intervals", {}).items()
            if key in PRINTED and None not in ends
        }
        result.append({**rounded(known, ROW_DIGITS), "intervals": intervals})
    return result


def _packed(cells: Sequence[Cell]) -> dict[str, Any]:
    """Cells of one run: shared values, column names, a list of values per cell."""
    lowest = lowest_coverage(cells)
    flat = [_flat(cell, lowest) for cell in cells]
    names = sorted(dict.fromkeys(name for each in flat for name in each), key=lambda name: "." in name)
    shared = {name: flat[0].get(name) for name in names if all(each.get(name) == flat[0].get(name) for each in flat)}
    columns = [name for name in names if name not in shared]
    return {"shared": shared, "columns": columns, "cells": [[each.get(name) for name in columns] for each in flat]}


def _flat(cell: Cell, lowest: float) -> dict[str, Any]:
    """A cell with rounded scores and a key for each order of pixels."""
    flat = {key: value if key in EXACT else rounded(value) for key, value in cell.items()}
    nested = {key: flat.pop(key, {}) for key in NESTED}
    orders = {f"ause.{order}": value for order, value in nested["ause"].items() if value is not None}
    points = 0 if "@" in cell["method"] else POINTS  # tables read other settings of a knob at the bar alone
    curves = thinned(nested["curves"], lowest, points=points)
    if curves:
        orders["curves.percent"] = [round(100 * coverage) for coverage in curves["spread"]["coverage"][1:]]
        orders |= {f"curves.{order}": _integers(each) for order, each in curves.items()}
    for key in NESTED:
        if orders.get(f"{key}.own") == orders.get(f"{key}.spread"):
            orders.pop(f"{key}.own", None)
    return flat | orders


def _nested(flat: Mapping[str, Any]) -> Cell:
    """The cell of :func:`_flat`."""
    cell = {key: value for key, value in flat.items() if "." not in key}
    for key in NESTED:
        orders = {order: flat.get(f"{key}.{order}") for order in ("spread", "photos", "own")}
        orders["own"] = orders["spread"] if orders["own"] is None else orders["own"]
        known = {order: value for order, value in orders.items() if value is not None}
        if known:
            cell[key] = known
    if "curves" in cell:
        coverage = [cell["coverage"], *(percent / 100 for percent in flat["curves.percent"])]
        cell["curves"] = {order: {"coverage": coverage, **_numbers(values)} for order, values in cell["curves"].items()}
    return cell


def _integers(curve: Mapping[str, Sequence[float | None]]) -> list[list[int | None]]:
    return [[None if value is None else round(value * scale) for value in curve[key]] for key, scale in SCALES.items()]


def _numbers(columns: Sequence[Sequence[int | None]]) -> dict[str, list[float | None]]:
    """The scores of :func:`_integers`."""
    return {
        key: [None if value is None else value / scale for value in column]
        for (key, scale), column in zip(SCALES.items(), columns)
    }


def thinned(curves: Mapping[str, Any], lowest: float, *, points: int = POINTS) -> Mapping[str, Any]:
    """Curves of one cell at fewer coverages, the same ones in every order of pixels.

    The own coverage stays, and so do the neighbours of the ends of what areas are taken over: ``FROM``, and ``lowest``,
    where the methods of the run are compared. Of the others those go that no table reads, then those that change areas
    least, until ``points`` are left.
    """
    if not curves:
        return curves
    coverage = np.array(curves["spread"]["coverage"])
    order = np.argsort(coverage, kind="stable")
    place = coverage[order]
    scores = np.array([curve[key] for curve in curves.values() for key in AT_EQUAL], dtype=np.float64)[:, order]
    scores = np.nan_to_num(scores / np.nanmax(scores, axis=1, initial=1e-9)[:, None])
    below = np.searchsorted(place, (FROM, lowest), side="right") - 1
    needed = {len(place) - 1, *below, *(below + 1)}
    kept = list(range(len(place)))
    while len(kept) > points and set(kept) - needed:
        costs = {kept[0]: (place[kept[0]] >= FROM, 0.0)}
        for left, middle, right in zip(kept, kept[1:], kept[2:]):
            share = (place[middle] - place[left]) / (place[right] - place[left])
            line = scores[:, left] + share * (scores[:, right] - scores[:, left])
            moved = np.abs(scores[:, middle] - line).sum() * (place[right] - place[left])
            costs[middle] = (FROM <= place[middle] <= lowest, moved)
        kept.remove(min(set(kept) - needed, key=lambda each: (costs[each], each)))
    chosen = sorted(order[kept])
    return {
        name: {key: [curve[key][index] for index in chosen] for key in ("coverage", *AT_EQUAL)}
        for name, curve in curves.items()
    }
