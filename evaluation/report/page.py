"""A report as one HTML page: tables, curves, and views under a slider, the worst first.

The page holds all it needs: pictures, style and the few lines of script that move the slider. Without JavaScript all
of it can be read. Two conventions never share a table, a column or a chart.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ...core.metrics import METRICS
from ..scoring.conventions import CONVENTIONS, PLAIN_CONVENTIONS
from .charts import Series, colours_of, line_chart, swatch
from .pictures import PHOTO, WORST, ViewPictures, wipe, worst_first
from .style import SCRIPT, STYLE
from .tables import (
    EQUAL_KEYS,
    OWN_KEYS,
    by_convention,
    convention_table,
    difference_table,
    image_table,
    number,
    present,
    score_table,
    table,
    text,
)

SOURCES = {name: each.source for name, each in {**CONVENTIONS, **PLAIN_CONVENTIONS}.items()}


def page_text(results: Mapping[str, Any], pictures: Sequence[ViewPictures] = ()) -> str:
    """The whole page.

    Args:
        results: of the shape of :func:`unghost.core.results.build_results`. Of its rows every metric that is known is
            shown, grouped by convention; a ``curve`` is drawn; what
            :func:`unghost.evaluation.scoring.comparison.compare_methods` adds is shown where it is there.
        pictures: of :func:`unghost.evaluation.report.pictures.view_pictures`, in order.

    Raises:
        ValueError: results without rows.
    """
    rows = list(results.get("rows", ()))
    if not rows or not all(isinstance(row, Mapping) and "method" in row for row in rows):
        raise ValueError("page_text: results must have rows, each with a method")
    methods = list(dict.fromkeys(str(row["method"]) for row in rows))
    colours = colours_of(methods)
    groups = by_convention(rows)
    body = [_head(results, rows, methods, list(groups))]
    for convention, group in groups.items():
        body.append(_group(convention, group, colours, alone=len(groups) == 1))
    body.append(_differences(results))
    body.append(_views(results, rows, pictures))
    body.append(_conventions(results))
    body.append(_every_view(results, rows))
    body.append(_foot(results))
    title = text(", ".join(methods) if len(methods) < 4 else f"{len(methods)} methods")
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1"><link rel="icon" href="data:,">'
        f"<title>{title} · unghost</title><style>{STYLE}</style></head><body><main>\n"
        + "\n".join(part for part in body if part)
        + f"\n</main><script>{SCRIPT}</script></body></html>\n"
    )


def write_page(path: str | Path, results: Mapping[str, Any], pictures: Sequence[ViewPictures] = ()) -> None:
    """Write :func:`page_text` atomically."""
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = target.with_name(target.name + ".partial")
    partial.write_text(page_text(results, pictures), encoding="utf-8")
    os.replace(partial, target)


def read_results(path: str | Path) -> dict[str, Any]:
    """A results file, as far as a page needs it.

    Raises:
        FileNotFoundError: there is none.
        ValueError: it is not JSON, or has no rows with a method each.
    """
    source = Path(path)
    if not source.is_file():
        raise FileNotFoundError(f"read_results: no file {source}")
    try:
        found = json.loads(source.read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"read_results: {source} is not JSON ({error})") from None
    rows = found.get("rows") if isinstance(found, dict) else None
    if not isinstance(rows, list) or not rows or not all(isinstance(row, dict) and "method" in row for row in rows):
        raise ValueError(f"read_results: {source} has no rows with a method each (docs/formats.md)")
    return dict(found)


def _head(
    results: Mapping[str, Any], rows: Sequence[Mapping[str, Any]], methods: Sequence[str], conventions: Sequence[Any]
) -> str:
    facts = results.get("evaluation", {})
    heading = text(" · ".join(methods)) if len(methods) < 4 else f"{len(methods)} methods"
    said = [f"<code>{text(results['command'])}</code>"] if results.get("command") and not facts else []
    if facts:
        said.append(f"{facts['views']} views of {facts['width']} × {facts['height']} pixels")
        said.append(f"against <code>{text(facts['gt'])}</code>")
        if facts.get("masks"):
            said.append(f"masks <code>{text(facts['masks'])}</code>")
    said += [f"convention <b>{text(name)}</b>" for name in conventions if name and len(conventions) == 1]
    notes = "".join(f'<p class="note">{text(note)}</p>' for note in facts.get("notes", ()))
    source = SOURCES.get(str(conventions[0])) if len(conventions) == 1 else None
    explained = f'<p class="soft">{text(conventions[0])}: {text(source)}.</p>' if source else ""
    return f"<h1>{heading}</h1><p>{', '.join(said)}</p>{explained}{notes}"


def _group(convention: Any, rows: Sequence[Mapping[str, Any]], colours: Mapping[str, int], *, alone: bool) -> str:
    """One convention's tables and charts."""
    name = "no convention stated" if convention is None else str(convention)
    parts = ["<h2>Scores</h2>" if alone else f"<h2>Under <code>{text(name)}</code></h2>"]
    if not alone and name in SOURCES:
        parts.append(f'<p class="soft">{text(SOURCES[name])}.</p>')
    paint = (lambda method: swatch(colours[method])) if len(colours) > 1 else None
    means = [row for row in rows if row.get("seed") is None]
    parts.append(score_table(means or rows, OWN_KEYS, paint))
    if means and len(means) < len(rows):
        every = score_table(rows, OWN_KEYS, paint)
        parts.append(f"<details><summary>{len(rows)} rows, seed by seed</summary>{every}</details>")
    if any(row.get("intervals") for row in rows):
        level = next(row.get("level", 0.95) for row in rows if row.get("intervals"))
        said = f"Means over views; below each the {100 * level:.0f} % interval of a bootstrap over views."
        parts.append(f'<p class="soft">{said}</p>')
    parts += [f'<p class="note">{text(note)}</p>' for note in _undefined(rows)]
    parts.append(_equal(rows, paint))
    charts = [*_coverage_charts(rows, colours), *_view_charts(rows, colours)]
    if charts:
        drawn = "".join(f"<div><h3>{title}</h3>{chart}</div>" for title, chart in charts)
        parts.append(f'<div class="charts">{drawn}</div>')
    return "".join(parts)


def _undefined(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    said = []
    for row in rows:
        scored, images = row.get("images_scored"), row.get("images")
        if isinstance(scored, int) and isinstance(images, int) and scored < images:
            counted = f"a pixel counts in {scored} of {images} views only; the means are over those"
            said.append(f"{row['method']}: {counted if scored else 'no pixel counts in any view'}.")
    return said


def _equal(rows: Sequence[Mapping[str, Any]], paint: Any) -> str:
    keys = present(rows, EQUAL_KEYS, at_least=2)  # a number that nobody else has compares nothing
    if not keys:
        return ""
    where = next((row["at_coverage"] for row in rows if row.get("at_coverage") is not None), None)
    where = where if "psnr_at_coverage" in keys else None
    said = "Whoever removes more is scored on easier pixels, so these columns compare like with like: the pixels that "
    said += "count for every method here"
    said += (
        f", or a coverage of {number(where, 3)} each, the surest pixels of a method that says how sure it is."
        if (where is not None)
        else "."
    )
    return f"<h3>At equal coverage</h3>{score_table(rows, keys, paint)}" + f'<p class="soft">{said}</p>'


def _coverage_charts(rows: Sequence[Mapping[str, Any]], colours: Mapping[str, int]) -> list[tuple[str, str]]:
    """PSNR over coverage, a chart a scene; a method with a knob is a line, one without a disc."""
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
        if chart:
            charts.append(("PSNR over coverage, dB" + (f": {text(scene)}" if scene is not None else ""), chart))
    return charts


def _view_charts(rows: Sequence[Mapping[str, Any]], colours: Mapping[str, int]) -> list[tuple[str, str]]:
    """PSNR along the sweep: where a method goes wrong."""
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
    chart = (
        line_chart(series, x_label="view, in order", y_label="PSNR, dB")
        if any(len(each.x) > 1 for each in series)
        else ""
    )
    return [("PSNR of each view, dB", chart)] if chart else []


def _finite(value: Any) -> bool:
    return isinstance(value, (int, float)) and math.isfinite(value)


def _differences(results: Mapping[str, Any]) -> str:
    parts = [difference_table(rows) for rows in by_convention(results.get("differences") or ()).values()]
    if not parts:
        return ""
    ahead = results.get("against_points") or []
    if ahead:
        cells = [
            [
                text(row["method"]),
                text(row["point"]),
                number(row["coverage"], 3),
                number(row["psnr"], 2),
                number(row["psnr_point"], 2),
                number(row["ahead"], 2),
            ]
            for row in ahead
        ]
        heads = ["curve", "point", "coverage of the point", "PSNR of the curve there", "of the point", "ahead by, dB"]
        parts += ["<h3>Curves against points, at the points' own coverage</h3>", table(heads, cells, kind="names")]
    return (
        "<h2>Differences, view by view</h2>"
        + "".join(parts)
        + '<p class="soft">Paired over the same views; an interval '
        "that leaves out 0 is a difference. Each method on its own pixels, but for “PSNR on common pixels”.</p>"
    )


def _views(results: Mapping[str, Any], rows: Sequence[Mapping[str, Any]], pictures: Sequence[ViewPictures]) -> str:
    if not pictures:
        return ""
    facts = results.get("evaluation", {})
    methods = list(pictures[0].errors)
    left, right = facts.get("wipe") or ([methods[0], PHOTO] if len(methods) == 1 else methods[:2])
    total = facts.get("views", len(pictures))
    shown = f"The {len(pictures)} worst of {total} views" if len(pictures) < total else f"All {total} views"
    said = (
        f"{shown} by {_label(facts.get('sort', 'psnr'))} of {text(facts.get('sorted_by', methods[-1]))}. "
        f"Drag across a picture. Errors: black is none, white {WORST} or more in some channel, grey does not count."
    )
    parts = [wipe(view, left, right, index + 1) for index, view in enumerate(pictures)]
    return f'<h2>Views, worst first</h2><p class="soft">{said}</p>' + "".join(parts)


def _label(key: str) -> str:
    return text(METRICS[key].label.removesuffix(f", {METRICS[key].unit}") if key in METRICS else key)


def _conventions(results: Mapping[str, Any]) -> str:
    tables = results.get("conventions") or {}
    if not tables:
        return ""
    own = results.get("evaluation", {}).get("convention")
    parts = [f"<h3>{text(method)}</h3>{convention_table(rows, own)}" for method, rows in tables.items() if rows]
    return (
        '<h2>The same renders under every convention</h2><p class="soft">Scores of two lines are different quantities: '
        "they must not be compared, and nothing here averages them. Lines that are not there need maps that were not "
        "given.</p>" + "".join(parts)
    )


def _every_view(results: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> str:
    parts = []
    facts = results.get("evaluation", {})
    for convention, group in by_convention([row for row in rows if row.get("per_image")]).items():
        views = [{each["name"] for each in row["per_image"]} for row in group]
        if any(names != views[0] for names in views):
            continue  # of several scenes
        lead = next((row for row in group if row["method"] == facts.get("sorted_by")), group[-1])
        order = worst_first(lead["per_image"], facts.get("sort", "psnr"))
        shown = image_table(group, order, OWN_KEYS)
        parts.append(f"<details><summary>{len(order)} views under {text(convention)}</summary>{shown}</details>")
    return "<h2>Every view</h2>" + "".join(parts) if parts else ""


def _foot(results: Mapping[str, Any]) -> str:
    said = [f"<code>{text(results['command'])}</code>"] if results.get("command") else []
    said += [f"commit {text(results['commit'])}"] if results.get("commit") else []
    machine = results.get("machine") or {}
    said += [f"{text(machine.get('cores'))} cores of {text(machine.get('architecture'))}"] if machine else []
    used = [f"{text(name)} {text(number)}" for name, number in (results.get("versions") or {}).items()]
    return f'<h2>How it was made</h2><p class="soft">{", ".join([*said, *used])}.</p>'
