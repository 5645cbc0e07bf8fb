"""HTML report of an evaluation: tables, curves, and views under a slider, the worst first.

The page holds all it needs: pictures, style and the few lines of script that move the slider. Without JavaScript all
of it can be read. Two conventions never share a table, a column or a chart.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ...core.errors import InvalidArgument, InvalidFile, MissingFile
from ...core.io import read_json, write_text
from ...core.metrics import METRICS
from ...core.pages import LineChart, Series, Table, line_chart, render
from ...core.pages.charts import colours_of
from ..scoring.conventions import CONVENTIONS, PLAIN_CONVENTIONS
from .pictures import PHOTO, WORST, ViewPictures, worst_first
from .tables import (
    EQUAL_KEYS,
    OWN_KEYS,
    by_convention,
    convention_table,
    difference_table,
    image_table,
    number,
    point_table,
    present,
    score_table,
)

SOURCES = {name: each.source for name, each in {**CONVENTIONS, **PLAIN_CONVENTIONS}.items()}
UNNAMED = "no convention stated"


def page_text(results: Mapping[str, Any], pictures: Sequence[ViewPictures] = ()) -> str:
    """HTML of the whole page.

    Args:
        results: of the shape of :func:`unghost.core.results.build_results`. Of its rows every metric that is known is
            shown, grouped by convention; a ``curve`` is drawn; what
            :func:`unghost.evaluation.scoring.comparison.compare_methods` adds is shown where it is there.
        pictures: of :func:`unghost.evaluation.report.pictures.view_pictures`, in order.

    Raises:
        ValueError: results without rows.
        ImportError: Jinja2 is missing.
    """
    rows = list(results.get("rows", ()))
    if not rows or not all(isinstance(row, Mapping) and "method" in row for row in rows):
        raise InvalidArgument("page_text: results must have rows, each with a method")
    methods = list(dict.fromkeys(str(row["method"]) for row in rows))
    few = len(methods) < 4
    colours = colours_of(methods)
    groups = by_convention(rows)
    evaluation = results.get("evaluation") or {}
    own = evaluation.get("convention")
    convention = next(iter(groups)) if len(groups) == 1 else None
    tables = results.get("conventions") or {}
    return render(
        "report.html.jinja",
        title=", ".join(methods) if few else f"{len(methods)} methods",
        heading=" · ".join(methods) if few else f"{len(methods)} methods",
        evaluation=evaluation,
        convention=convention,
        convention_source=SOURCES.get(str(convention)),
        groups=[_group(name, group, colours) for name, group in groups.items()],
        differences=[difference_table(each) for each in by_convention(results.get("differences") or ()).values()],
        against_points=point_table(results.get("against_points") or ()),
        views=_views(evaluation, pictures) if pictures else None,
        conventions=[(method, convention_table(each, own)) for method, each in tables.items() if each],
        every_view=_every_view(evaluation, rows),
        results=results,
    )


def write_page(path: str | Path, results: Mapping[str, Any], pictures: Sequence[ViewPictures] = ()) -> None:
    """Write :func:`page_text` atomically."""
    write_text(path, page_text(results, pictures))


def read_results(path: str | Path) -> dict[str, Any]:
    """A results file, as far as a page needs it.

    Raises:
        FileNotFoundError: there is none.
        ValueError: it is not JSON, or has no rows with a method each.
    """
    source = Path(path)
    if not source.is_file():
        raise MissingFile(f"read_results: no file {source}")
    found = read_json(source, caller="read_results")
    rows = found.get("rows") if isinstance(found, dict) else None
    if not isinstance(rows, list) or not rows or not all(isinstance(row, dict) and "method" in row for row in rows):
        raise InvalidFile(f"read_results: {source} has no rows with a method each (docs/formats.md)")
    return dict(found)


def _group(convention: Any, rows: Sequence[Mapping[str, Any]], colours: Mapping[str, int]) -> dict[str, Any]:
    """One convention's tables, notes and charts."""
    painted = colours if len(colours) > 1 else None
    means = [row for row in rows if row.get("seed") is None]
    equal_keys = present(rows, EQUAL_KEYS, at_least=2)  # a number that nobody else has compares nothing
    at_coverage = next((row["at_coverage"] for row in rows if row.get("at_coverage") is not None), None)
    return {
        "name": UNNAMED if convention is None else convention,
        "source": SOURCES.get(str(convention)),
        "scores": score_table(means or rows, OWN_KEYS, painted),
        "by_seed": score_table(rows, OWN_KEYS, painted) if means and len(means) < len(rows) else None,
        "level": next((row.get("level", 0.95) for row in rows if row.get("intervals")), None),
        "notes": _undefined(rows),
        "equal": score_table(rows, equal_keys, painted),
        "at_coverage": number(at_coverage, 3) if at_coverage is not None and "psnr_at_coverage" in equal_keys else "",
        "charts": [*_coverage_charts(rows, colours), *_view_charts(rows, colours)],
    }


def _undefined(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    notes = []
    for row in rows:
        scored, images = row.get("images_scored"), row.get("images")
        if isinstance(scored, int) and isinstance(images, int) and scored < images:
            counted = f"a pixel counts in {scored} of {images} views only; the means are over those"
            notes.append(f"{row['method']}: {counted if scored else 'no pixel counts in any view'}.")
    return notes


def _coverage_charts(rows: Sequence[Mapping[str, Any]], colours: Mapping[str, int]) -> list[tuple[str, LineChart]]:
    """Titles and charts of PSNR over coverage, one per scene: lines of methods with a curve, discs of others."""
    if not any(row.get("curve") for row in rows):
        return []
    charts = []
    for scene in dict.fromkeys(row.get("scene") for row in rows):
        series = []
        for row in (each for each in rows if each.get("scene") == scene):
            points = sorted(
                (point["coverage"], point["psnr"])
                for point in row.get("curve") or [row.get("point", row)]
                if _finite(point.get("coverage")) and _finite(point.get("psnr"))
            )
            seed = f", seed {row['seed']}" if row.get("seed") is not None else ""
            notes = tuple(f"{y:.2f} dB at coverage {x:.3f}{seed}" for x, y in points)
            x, y = (tuple(values) for values in zip(*points)) if points else ((), ())
            series.append(Series(str(row["method"]), x, y, colours[str(row["method"])], notes))
        chart = line_chart(series, x_label="coverage", y_label="PSNR, dB")
        if chart is not None:
            charts.append(("PSNR over coverage, dB" + (f": {scene}" if scene is not None else ""), chart))
    return charts


def _view_charts(rows: Sequence[Mapping[str, Any]], colours: Mapping[str, int]) -> list[tuple[str, LineChart]]:
    """Title and chart of PSNR along the sweep: where a method goes wrong."""
    series = []
    for row in rows:
        images = row.get("per_image") or []
        known = [(index + 1, each) for index, each in enumerate(images) if _finite(each.get("psnr"))]
        series.append(
            Series(
                str(row["method"]),
                tuple(float(index) for index, _ in known),
                tuple(each["psnr"] for _, each in known),
                colours[str(row["method"])],
                tuple(f"{each['psnr']:.2f} dB, {each['name']}" for _, each in known),
            )
        )
    if not any(len(each.x) > 1 for each in series):
        return []
    chart = line_chart(series, x_label="view, in order", y_label="PSNR, dB")
    return [] if chart is None else [("PSNR of each view, dB", chart)]


def _finite(value: Any) -> bool:
    return isinstance(value, (int, float)) and math.isfinite(value)


def _views(evaluation: Mapping[str, Any], pictures: Sequence[ViewPictures]) -> dict[str, Any]:
    """The views under sliders, and how they are sorted."""
    methods = list(pictures[0].errors)
    left, right = evaluation.get("wipe") or ([methods[0], PHOTO] if len(methods) == 1 else methods[:2])
    total, key = evaluation.get("views", len(pictures)), evaluation.get("sort", "psnr")
    return {
        "pictures": pictures,
        "left": left,
        "right": right,
        "photo": PHOTO,
        "shown": f"The {len(pictures)} worst of {total} views" if len(pictures) < total else f"All {total} views",
        "sort": METRICS[key].label.removesuffix(f", {METRICS[key].unit}") if key in METRICS else key,
        "sorted_by": evaluation.get("sorted_by", methods[-1]),
        "white": WORST,
    }


def _every_view(evaluation: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> list[tuple[Any, int, Table]]:
    """Convention, number of views and table of every view, for each convention whose rows share their views."""
    tables = []
    for convention, group in by_convention([row for row in rows if row.get("per_image")]).items():
        views = [{each["name"] for each in row["per_image"]} for row in group]
        if any(names != views[0] for names in views):
            continue  # of several scenes
        lead = next((row for row in group if row["method"] == evaluation.get("sorted_by")), group[-1])
        order = worst_first(lead["per_image"], evaluation.get("sort", "psnr"))
        name = UNNAMED if convention is None else convention
        tables.append((name, len(order), image_table(group, order, OWN_KEYS)))
    return tables
