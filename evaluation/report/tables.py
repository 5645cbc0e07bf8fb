"""Tables of a report's page: scores by convention, differences, conventions side by side, every view."""

from __future__ import annotations

import html
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from ...core.metrics import METRICS, Metric
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


def text(value: Any) -> str:
    """Anything as HTML text."""
    return html.escape(str(value), quote=True)


def number(value: Any, digits: int, *, infinite: bool = False) -> str:
    """A number, ∞ where the stored null stands for it, a dash for none."""
    if value is None or isinstance(value, str):
        return "∞" if infinite else "–"
    if not math.isfinite(value):
        return "∞" if value > 0 else "–"
    shown = f"{value:.{digits}f}"
    return (shown if float(shown) else shown.removeprefix("-")).replace("-", "−")


def heading(key: str, more: str = "") -> str:
    """A metric's label, what is to be said of it, and an arrow towards better."""
    known = METRICS.get(key)
    return text(key + more) if known is None else text(known.label + more + ARROWS[known.sign])


def table(heads: Sequence[str], rows: Sequence[Sequence[str]], *, kind: str = "") -> str:
    """A table of cells that are HTML already; it scrolls sideways where the screen is narrow."""
    top = "".join(f'<th scope="col">{head}</th>' for head in heads)
    body = "".join(
        "<tr>"
        + "".join(f"<td>{cell}</td>" if n else f'<th scope="row">{cell}</th>' for n, cell in enumerate(row))
        + "</tr>"
        for row in rows
    )
    inner = f"<table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table>"
    return f'<div class="scroll {kind}" tabindex="0">{inner}</div>'


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
    rows: Sequence[Mapping[str, Any]], keys: Sequence[str], swatch: Callable[[str], str] | None = None
) -> str:
    """Methods by metrics, the interval below its mean; rows of two conventions are refused, LPIPS on two backbones
    stands in two columns.

    Args:
        rows: of one convention.
        keys: the columns; those without any number are left out.
        swatch: HTML before a method's name, as the charts colour it.
    """
    one_convention("score_table", rows)
    columns, labels = (
        _columns(rows, present(rows, keys)),
        [key for key in LABEL_KEYS if any(key in row for row in rows)],
    )
    if not columns:
        return ""
    cells = []
    for row in rows:
        name = text(row["method"])
        cells.append(
            [
                name if swatch is None else swatch(str(row["method"])) + name,
                *(text("–" if row.get(key) is None else row[key]) for key in labels),
                *(_score(row, key) if _same_backbone(row, key, backbone) else "–" for key, backbone in columns),
            ]
        )
    heads = [heading(key, "" if backbone is None else f" ({backbone})") for key, backbone in columns]
    return table(["method", *labels, *heads], cells)


def _columns(rows: Sequence[Mapping[str, Any]], keys: Sequence[str]) -> list[tuple[str, str | None]]:
    """Metric and, of LPIPS, backbone."""
    found: list[tuple[str, str | None]] = []
    for key in keys:
        known = dict.fromkeys(row.get("lpips_backbone") for row in rows if _has(row, key)) if key == "lpips" else [None]
        found += [(key, backbone) for backbone in known]
    return found


def _same_backbone(row: Mapping[str, Any], key: str, backbone: str | None) -> bool:
    return key != "lpips" or row.get("lpips_backbone") == backbone


def difference_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Paired differences, a line a metric; an interval without 0 is marked."""
    one_convention("difference_table", rows)
    cells = []
    for row in rows:
        known = METRICS.get(row["metric"], Metric(row["metric"], row["metric"], "none"))
        low, high, mean = row["low"], row["high"], row["difference"]
        verdict = "one image" if low is None else "no difference shown"
        if low is not None and (low > 0 or high < 0):
            verdict = ("better" if mean * known.sign > 0 else "worse") if known.sign else "differs"
        interval = "–" if low is None else f"{_signed(low, known.decimals)} … {_signed(high, known.decimals)}"
        cells.append(
            [
                f"{text(row['method'])} − {text(row['against'])}",
                text(known.label),
                _signed(mean, known.decimals),
                interval,
                f'<span class="verdict {verdict.split()[0]}">{verdict}</span>',
                str(row["images"]),
            ]
        )
    return table(["", "metric", "difference", "interval", "", "views"], cells, kind="names verdicts")


def convention_table(rows: Sequence[Mapping[str, Any]], own: str | None) -> str:
    """One method's renders under each convention: a line a convention, a column a metric, never averaged."""
    names = [key for key in rows[0] if key not in ("metric", "spread")]
    kept = [row for row in rows if any(row[name] is not None for name in names)]
    heads = ["convention", *(heading(row["metric"]) for row in kept)]
    cells = []
    for name in names:
        label = f"<b>{text(name)}</b>" if name == own else text(name)
        cells.append([label, *(number(row[name], _digits(row["metric"])) for row in kept)])
    spread = ["<i>largest less smallest</i>", *(number(row["spread"], _digits(row["metric"])) for row in kept)]
    return table(heads, [*cells, spread])


def image_table(rows: Sequence[Mapping[str, Any]], order: Sequence[str], keys: Sequence[str]) -> str:
    """Every view of every method, in the given order of views."""
    columns = [key for key in keys if any(_has(each, key) for row in rows for each in row["per_image"])]
    cells = []
    found = [{each["name"]: each for each in row["per_image"]} for row in rows]
    for name in order:
        for row, views in zip(rows, found):
            each = views[name]
            cells.append(
                [
                    text(name),
                    text(row["method"]),
                    str(each["pixels"]),
                    *(number(each.get(key), _digits(key), infinite=key in each.get("infinite", ())) for key in columns),
                ]
            )
    return table(["view", "method", "pixels", *map(heading, columns)], cells, kind="tall")


def _has(row: Mapping[str, Any], key: str) -> bool:
    value = row.get(key)
    usable = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
    return usable or key in row.get("infinite", ())


def _score(row: Mapping[str, Any], key: str) -> str:
    digits = _digits(key)
    value = row.get(key) if isinstance(row.get(key), (int, float)) else None
    shown = number(value, digits, infinite=key in row.get("infinite", ()))
    low, high = (row.get("intervals") or {}).get(key) or (None, None)
    if value is None or low is None or high is None:
        return shown
    return f"{shown}<small>{number(low, digits)} – {number(high, digits)}</small>"


def _digits(key: str) -> int:
    return METRICS[key].decimals if key in METRICS else 3


def _signed(value: float, digits: int) -> str:
    return ("+" if round(value, digits) > 0 else "") + number(value, digits)
