"""Write the demo's page: one HTML file with its pictures inside."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..core.io import write_text
from ..core.metrics import get_metric
from ..core.pages import Table, render
from .run import SCORES

NAMES = {"clean": "unghost clean", "components": "largest component"}
COLUMNS = {key: get_metric(key).label for key in SCORES} | {"iou": "IoU after"}
VERDICTS = (("#fa8c1f", "ghost, removed"), ("#80339e", "ghost, left"), ("#d90d1a", "true surface, lost"))


def _number(value: float | None, *, digits: int = 3) -> str:
    return "–" if value is None else f"{value:.{digits}f}"


def _percent(value: float | None) -> str:
    return "–" if value is None else f"{100 * value:.1f} %"


def page_text(results: Mapping[str, Any], pictures: Mapping[str, bytes]) -> str:
    """HTML of one demo run.

    Args:
        results: of :func:`unghost.demo.run_demo`; the first row is the headline.
        pictures: of :func:`unghost.demo.pictures.draw_pictures`, PNG files by name.

    Raises:
        ImportError: Jinja2 is missing.
    """
    rows = list(results["rows"])
    first = rows[0]
    kinds = list(first["recall_by_kind"])
    methods = [{"name": row["method"], "label": NAMES.get(row["method"], row["method"])} for row in rows]
    labels = [method["label"] for method in methods]
    scores = [[label, *(_number(row[key]) for key in COLUMNS)] for label, row in zip(labels, rows)]
    by_kind = [[label, *(_percent(row["recall_by_kind"][kind]) for kind in kinds)] for label, row in zip(labels, rows)]
    before, after = _number(first["iou_before"], digits=2), _number(first["iou"], digits=2)
    return render(
        "demo.html.jinja",
        headline=[
            (_percent(first["floater_recall"]), "of the ghost cells removed"),
            (_percent(first["surface_kept"]), "of the true surface kept"),
            (f"{before} → {after}", "IoU with the truth"),
            (f"{_number(first['seconds'], digits=1)} s", f"on {results['machine']['cores']} CPU cores"),
        ],
        methods=methods,
        pictures=pictures,
        verdicts=VERDICTS,
        scores=Table(["method", *COLUMNS.values()], scores),
        by_kind=Table(["method", *kinds], by_kind),
        results=results,
    )


def write_page(path: str | Path, results: Mapping[str, Any], pictures: Mapping[str, bytes]) -> None:
    """Write the page atomically; see :func:`page_text`."""
    write_text(path, page_text(results, pictures))
