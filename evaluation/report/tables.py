"""Tables of a report's page: scores by convention, differences, conventions side by side, every view."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from ...core.metrics import METRICS, Metric
from ...core.pages import Cell, Table
from ..scoring.conventions import one_convention

OWN_KEYS = (
    "psnr",
    "ssim",
    "lpips",
    "flip",
    "depth_mse",
    "disparity_mae",
    "normal_mean_deg",
    "normal_median_deg",
    "normal_pct_30",
    "coverage",
    "dice",
    "mask_precision",
    "mask_recall",
    "iou",
    "iou_before",
    "iou_clean",
    "floater_recall",
    "floater_precision",
    "surface_kept",
    "free_space_error",
    "seconds",
    "milliseconds",
    "megabytes",
)
EQUAL_KEYS = ("psnr_common", "coverage_common", "psnr_visible", "psnr_at_coverage", "psnr_area")
LABEL_KEYS = ("scene", "seed")
ARROWS = {1: "\N{NO-BREAK SPACE}↑", -1: "\N{NO-BREAK SPACE}↓", 0: ""}


def number(value: Any, digits: int, *, infinite: bool = False) -> str:
    """A number, ∞ where the stored null stands for it, a dash for none."""
    if value is None or isinstance(value, str):
        return "∞" if infinite else "–"
    if not math.isfinite(value):
        return "∞" if value > 0 else "–"
    shown = f"{value:.{digits}f}"
    return (shown if float(shown) else shown.removeprefix("-")).replace("-", "−")


def heading(key: str, more: str = "") -> str:
    """A metric's label, ``more`` about it, and an arrow towards better."""
    known = METRICS.get(key)
    return key + more if known is None else known.label + more + ARROWS[known.sign]


def by_convention(rows: Sequence[Mapping[str, Any]]) -> dict[Any, list[Mapping[str, Any]]]:
    """Rows apart by their convention, in the order of first appearance; None: they state none."""
    groups: dict[Any, list[Mapping[str, Any]]] = {}
    for row in rows:
        groups.setdefault(row.get("convention"), []).append(row)
    return groups


def present(rows: Sequence[Mapping[str, Any]], keys: Sequence[str], *, at_least: int = 1) -> list[str]:
    """Those keys that so many rows have a number for."""
    return [key for key in keys if sum(_has(row, key) for row in rows) >= at_least]


def score_table(
    rows: Sequence[Mapping[str, Any]], keys: Sequence[str], colours: Mapping[str, int] | None = None
) -> Table | None:
    """Table of methods by metrics, the interval below its mean.

    Rows of two conventions are refused; LPIPS on two backbones stands in two columns.

    Args:
        rows: of one convention.
        keys: the columns; those without any number are left out.
        colours: method -> colour number of the charts, shown before its name; None shows none.

    Returns:
        The table, None if no column has a number.
    """
    one_convention("score_table", rows)
    columns = _columns(rows, present(rows, keys))
    labels = [key for key in LABEL_KEYS if any(key in row for row in rows)]
    if not columns:
        return None
    cells: list[list[str | Cell]] = [
        [
            Cell(str(row["method"]), series=None if colours is None else colours[str(row["method"])]),
            *("–" if row.get(key) is None else str(row[key]) for key in labels),
            *(_score(row, key) if _same_backbone(row, key, backbone) else Cell("–") for key, backbone in columns),
        ]
        for row in rows
    ]
    heads = [heading(key, "" if backbone is None else f" ({backbone})") for key, backbone in columns]
    return Table(["method", *labels, *heads], cells)


def _columns(rows: Sequence[Mapping[str, Any]], keys: Sequence[str]) -> list[tuple[str, str | None]]:
    """Metric and, of LPIPS, backbone."""
    found: list[tuple[str, str | None]] = []
    for key in keys:
        known = dict.fromkeys(row.get("lpips_backbone") for row in rows if _has(row, key)) if key == "lpips" else [None]
        found += [(key, backbone) for backbone in known]
    return found


def _same_backbone(row: Mapping[str, Any], key: str, backbone: str | None) -> bool:
    return key != "lpips" or row.get("lpips_backbone") == backbone


def difference_table(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Table of paired differences, one line per metric; an interval without 0 is marked."""
    one_convention("difference_table", rows)
    cells: list[list[str | Cell]] = []
    for row in rows:
        known = METRICS.get(row["metric"], Metric(row["metric"], row["metric"], "none"))
        low, high, mean = row["low"], row["high"], row["difference"]
        verdict, style = "one image" if low is None else "no difference shown", "weak"
        if low is not None and (low > 0 or high < 0):
            verdict = ("better" if mean * known.sign > 0 else "worse") if known.sign else "differs"
            style = verdict if known.sign else ""
        interval = "–" if low is None else f"{_signed(low, known.decimals)} … {_signed(high, known.decimals)}"
        cells.append(
            [
                f"{row['method']} − {row['against']}",
                known.label,
                _signed(mean, known.decimals),
                interval,
                Cell(verdict, style=style),
                str(row["images"]),
            ]
        )
    return Table(["methods", "metric", "difference", "interval", "verdict", "views"], cells, text_columns=(1, 4))


def point_table(rows: Sequence[Mapping[str, Any]]) -> Table | None:
    """Table of how far PSNR-over-coverage curves are ahead of single points, None without rows."""
    if not rows:
        return None
    heads = ["curve", "point", "coverage of the point", "PSNR of the curve there", "of the point", "ahead by, dB"]
    cells = [
        [
            str(row["method"]),
            str(row["point"]),
            number(row["coverage"], 3),
            number(row["psnr"], 2),
            number(row["psnr_point"], 2),
            number(row["ahead"], 2),
        ]
        for row in rows
    ]
    return Table(heads, cells, text_columns=(1,))


def convention_table(rows: Sequence[Mapping[str, Any]], own: str | None) -> Table:
    """Table of one method's renders under each convention, one line per convention, never averaged."""
    names = [key for key in rows[0] if key not in ("metric", "spread")]
    kept = [row for row in rows if any(row[name] is not None for name in names)]
    cells: list[list[str | Cell]] = [
        [
            Cell(str(name), style="strong" if name == own else ""),
            *(number(row[name], _digits(row["metric"])) for row in kept),
        ]
        for name in names
    ]
    if len(names) > 1:
        spread = [number(row["spread"], _digits(row["metric"])) for row in kept]
        cells.append([Cell("largest less smallest", style="weak"), *spread])
    return Table(["convention", *(heading(row["metric"]) for row in kept)], cells)


def image_table(rows: Sequence[Mapping[str, Any]], order: Sequence[str], keys: Sequence[str]) -> Table:
    """Table of every view of every method, in the given order of views."""
    columns = [key for key in keys if any(_has(each, key) for row in rows for each in row["per_image"])]
    cells = []
    found = [{each["name"]: each for each in row["per_image"]} for row in rows]
    for name in order:
        for row, views in zip(rows, found):
            each = views[name]
            cells.append(
                [
                    str(name),
                    str(row["method"]),
                    str(each["pixels"]),
                    *(number(each.get(key), _digits(key), infinite=key in each.get("infinite", ())) for key in columns),
                ]
            )
    return Table(["view", "method", "pixels", *map(heading, columns)], cells, text_columns=(1,), tall=True)


def _has(row: Mapping[str, Any], key: str) -> bool:
    value = row.get(key)
    usable = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
    return usable or key in row.get("infinite", ())


def _score(row: Mapping[str, Any], key: str) -> Cell:
    digits = _digits(key)
    value = row.get(key) if isinstance(row.get(key), (int, float)) else None
    shown = number(value, digits, infinite=key in row.get("infinite", ()))
    low, high = (row.get("intervals") or {}).get(key) or (None, None)
    if value is None or low is None or high is None:
        return Cell(shown)
    return Cell(shown, below=f"{number(low, digits)} – {number(high, digits)}")


def _digits(key: str) -> int:
    return METRICS[key].decimals if key in METRICS else 3


def _signed(value: float, digits: int) -> str:
    return ("+" if round(value, digits) > 0 else "") + number(value, digits)
