"""The preview's page as text: HTML with its pictures and charts inside, no script, nothing from elsewhere."""

from __future__ import annotations

import base64
import html
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .drawing import GHOST, MISSING, SURFACE, UNJUDGED, Image, png_bytes
from .statistics import CubeStatistics

if TYPE_CHECKING:
    from .preview import DrawnCube

Values = NDArray[np.float64]
INK, SECOND = "#4a6079", "#8fb39f"  # neither of them a colour of the cubes
STYLE = """
:root { color-scheme: light; --ink: #23252b; --soft: #666a73; --line: #e0dcd4; }
* { box-sizing: border-box; }
body { margin: 0; background: #f8f7f4; color: var(--ink); font: 16px/1.5 system-ui, sans-serif; }
main { max-width: 1160px; margin: 0 auto; padding: 40px 20px 80px; }
h1 { font-size: 34px; line-height: 1.15; margin: 0 0 6px; letter-spacing: -.02em; overflow-wrap: anywhere; }
h2 { font-size: 21px; margin: 48px 0 10px; } p { max-width: 76ch; margin: 8px 0; }
.soft, figcaption { color: var(--soft); font-size: 14px; }
.facts { display: flex; flex-wrap: wrap; gap: 10px 40px; margin: 24px 0 0; }
.facts b { display: block; font-size: 28px; letter-spacing: -.02em; }
.facts span { color: var(--soft); font-size: 14px; }
.cubes { display: grid; grid-template-columns: repeat(auto-fill, minmax(340px, 1fr)); gap: 14px; }
.key { max-width: none; } figure { margin: 0; }
.cubes figure, .charts figure { background: #fff; border: 1px solid var(--line); border-radius: 8px; }
.cubes figure, .charts figure { padding: 10px 12px; } .cubes figcaption { font-size: 13px; }
.pair { display: grid; grid-template-columns: 1fr 1fr; gap: 6px; } .pair img { width: 100%; display: block; }
.pair span { font-size: 12px; color: var(--soft); text-align: center; }
.charts { display: grid; grid-template-columns: repeat(auto-fill, minmax(320px, 1fr)); gap: 14px; }
.charts svg { width: 100%; display: block; } .charts b { font-size: 15px; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: 15px; }
th, td { text-align: right; padding: 6px 14px 6px 0; border-bottom: 1px solid var(--line); }
th:first-child, td:first-child, td.left, th.left { text-align: left; } .wide { overflow-x: auto; }
.key i { display: inline-block; width: 13px; height: 13px; border-radius: 3px; margin: 0 6px -2px 16px; }
.key i:first-child { margin-left: 0; }
"""
MEANINGS = {
    "occupied_share": "voxels of opacity above .1, over all",
    "faint_share": "voxels of opacity .02 to .1: haze",
    "thickness": "voxels; of the part that an occupied voxel belongs to",
    "components": "pieces that do not touch",
    "largest_share": "occupied voxels that are in the largest piece",
    "contrast": "opacity step at a surface: .5 a thin sheet of bits, under .1 fog",
    "opacity": "of the occupied voxels",
    "iou": "overlap of input and truth, where it is judged",
    "ghost_share": "occupied voxels where nothing is",
    "missing_share": "true surface that the input lacks",
    "surface_share": "true surface, over all voxels",
    "ignored_share": "voxels that nobody judges",
}


HEADS = ("per cube", "mean", "10\u00a0%", "median", "90\u00a0%", "what it is")


def _name(key: str) -> str:
    return "IoU" if key == "iou" else key.replace("_", " ")


def _image(image: Image, alt: str) -> str:
    data = base64.b64encode(png_bytes(image)).decode("ascii")
    return f'<img alt="{html.escape(alt)}" src="data:image/png;base64,{data}">'


def _color(color: Sequence[float]) -> str:
    return "#" + "".join(f"{round(255 * part):02x}" for part in color)


def _percent(share: float) -> str:
    if 0 < share < 0.0005:
        return "&lt; 0.1\u00a0%"
    return f"{100 * share:.0f}\u00a0%" if share == 0 or share >= 0.0995 else f"{100 * share:.1f}\u00a0%"


def _edge(fraction: float) -> str:
    digits = ".0f" if fraction >= 0.1 else ".2g"
    return f"{100 * fraction:{digits}}\u00a0%"


def _number(value: float | None) -> str:
    if value is None:
        return "–"
    return f"{value:.1f}" if abs(value) >= 10 else f"{value:.3f}" if abs(value) < 1 else f"{value:.2f}"


def histogram(series: Mapping[str, Values], edges: Values, marks: Mapping[float, str]) -> str:
    """An SVG of one or two distributions over the same bins, as shares of each.

    Args:
        series: one or two names to counts or weights ``(bins,)``.
        edges: ``(bins + 1,)``, drawn equally spaced.
        marks: position, in bins, to the text under it.
    """
    width, height, left, base = 320.0, 150.0, 4.0, 124.0
    shares = {name: counts / max(float(counts.sum()), 1e-12) for name, counts in series.items()}
    top = max(max(float(values.max()) for values in shares.values()), 1e-12)
    step, parts = (width - 2 * left) / (len(edges) - 1), []
    for number, (values, color) in enumerate(zip(shares.values(), (INK, SECOND))):
        bar = step / len(shares)
        for index, share in enumerate(values):
            tall = 100 * float(share) / top
            if tall > 0:
                parts.append(
                    f'<rect x="{left + index * step + number * bar:.1f}" y="{base - tall:.1f}" '
                    f'width="{max(bar - 1, 1):.1f}" height="{tall:.1f}" fill="{color}"/>'
                )
    parts.append(f'<path d="M{left} {base + 0.5}H{width - left}" stroke="#999"/>')
    for place, text in marks.items():
        where = left + place * step
        anchor = "start" if place == 0 else "end" if place >= len(edges) - 1 else "middle"
        parts.append(f'<text x="{where:.1f}" y="{base + 16}" text-anchor="{anchor}">{html.escape(text)}</text>')
    parts.append(f'<text x="{width - left}" y="14" text-anchor="end">tallest bar: {_percent(top)}</text>')
    if len(shares) > 1:
        for number, (name, color) in enumerate(zip(shares, (INK, SECOND))):
            parts.append(f'<rect x="{left + 70 * number}" y="5" width="10" height="10" fill="{color}"/>')
            parts.append(f'<text x="{left + 70 * number + 15}" y="14">{html.escape(name)}</text>')
    return f'<svg viewBox="0 0 {width:.0f} {height:.0f}" font-size="12" fill="#555" role="img">{"".join(parts)}</svg>'


def _chart(title: str, note: str, svg: str) -> str:
    return f"<figure><b>{title}</b>{svg}<figcaption>{note}</figcaption></figure>"


def _charts(statistics: CubeStatistics, edges: Values, severities: Values) -> str:
    """The page's histograms."""
    found, shares = statistics.features, np.linspace(0, 1, 21)
    tenths: dict[float, str] = {0: "0", 10: "half", 20: "all"}
    occupied = {"input": np.histogram(found["occupied_share"], shares)[0].astype(float)}
    occupied["truth"] = np.histogram(found["surface_share"], shares)[0].astype(float)
    fractions = np.geomspace(max(edges.min() * 0.999, 1e-4), max(edges.max() * 1.001, 2e-4), 21)
    middle = float(np.sqrt(fractions[0] * fractions[-1]))
    ends = {0.0: _edge(float(fractions[0])), 10.0: _edge(middle), 20.0: _edge(float(fractions[-1]))}
    thick = np.array([0, 1, 1.5, 2, 3, 4, 6, 8, 12, 16, 24, 33.0])
    units: dict[float, str] = {place: f"{thick[place]:g}" for place in (1, 3, 5, 7, 9)}
    opacity = statistics.opacity_histogram(25)[1:]  # the first bin is empty space
    levels = np.histogram(severities, shares)[0].astype(float)
    return "".join(
        (
            _chart("Occupied share", "Cubes by how much of them is occupied.", histogram(occupied, shares, tenths)),
            _chart(
                "Edge fraction",
                "Edge of the cube over the extent of its scene or object; logarithmic.",
                histogram({"cubes": np.histogram(edges, fractions)[0].astype(float)}, fractions, ends),
            ),
            _chart(
                "Opacity",
                f"Voxels by opacity, without the {_percent(statistics.opacity_histogram(25)[0])} below .04.",
                histogram({"voxels": opacity}, np.arange(25) / 25, {0: ".04", 11.5: ".5", 24: "1"}),
            ),
            _chart(
                "Thickness",
                "Cubes by the mean thickness of what is occupied, in voxels.",
                histogram({"cubes": np.histogram(found["thickness"], thick)[0].astype(float)}, thick, units),
            ),
            _chart(
                "Agreement with the truth",
                "Cubes by the IoU of input and truth, where it is judged.",
                histogram({"cubes": np.histogram(found["iou"], shares)[0].astype(float)}, shares, {0: "0", 20: "1"}),
            ),
            _chart("Severity", "As stored with each cube.", histogram({"cubes": levels}, shares, {0: "0", 20: "1"})),
        )
    )


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]], *, text_columns: Sequence[int] = ()) -> str:
    def cell(kind: str, column: int, text: str) -> str:
        return f"<{kind}{' class=left' if column in text_columns else ''}>{html.escape(text)}</{kind}>"

    top = "".join(cell("th", column, head) for column, head in enumerate(heads))
    body = "".join("<tr>" + "".join(cell("td", i, text) for i, text in enumerate(row)) + "</tr>" for row in rows)
    return f'<div class="wide"><table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table></div>'


def _card(cube: DrawnCube) -> str:
    found = cube.features
    said = f"IoU {found['iou']:.2f} · {_percent(found['ghost_share'])} ghost"
    said += f" · {_percent(found['missing_share'])} missing"
    origin = f"{html.escape(cube.shard)}, row {cube.row} · edge {_edge(cube.edge_fraction)}"
    origin += f" · severity {cube.severity:.2f}"
    return (
        f'<figure><div class="pair">{_image(cube.seen, "input")}{_image(cube.truth, "truth")}'
        f"<span>input</span><span>truth</span></div><figcaption>{said}<br>{origin}</figcaption></figure>"
    )


def _against(facts: Mapping[str, Any]) -> str:
    """The section on the distance to another set, or nothing."""
    found = facts.get("against")
    if found is None:
        return ""
    rows = [[_name(key), _number(value), MEANINGS[key]] for key, value in found["features"].items()]
    floor = "" if found["floor"] is None else f" Two random halves of one of the sets are at {found['floor']:.3f}."
    return (
        f"<h2>Beside {html.escape(found['name'])}</h2><p>Distance of the two sets' inputs: <b>{found['distance']:.3f}"
        f"</b> (0 the same, 1 as unlike as can be), the mean of the rows below.{floor}</p>"
        + _table(["feature", "distance", "what it is"], rows, text_columns=(2,))
    )


def _passed_over(rejected: Mapping[str, str], most: int = 20) -> str:
    """The meshes of which nothing could be made, or nothing."""
    if not rejected:
        return ""
    rows = sorted(rejected.items())
    rest = f"<p class=soft>And {len(rows) - most} more.</p>" if len(rows) > most else ""
    said = _table(["mesh that was passed over", "reason"], rows[:most], text_columns=(1,))
    return f"<h2>Passed over</h2>{said}{rest}"


def page_text(
    *,
    name: str,
    facts: Mapping[str, Any],
    statistics: CubeStatistics,
    drawn: Sequence[DrawnCube],
    edges: Values,
    severities: Values,
    sources: Mapping[tuple[str, str], int],
    rejected: Mapping[str, str],
) -> str:
    """The whole page; see :func:`unghost.data_recipes.inspection.preview.write_preview` for what it shows."""
    keys = (
        (SURFACE, "true surface"),
        (GHOST, "ghost: the input is opaque where nothing is"),
        (MISSING, "missing: surface that the input lacks"),
        (UNJUDGED, "not judged"),
    )
    legend = "".join(f'<i style="background:{_color(color)}"></i>{text}' for color, text in keys)
    rows = [
        [_name(key), *(_number(facts[key][mark]) for mark in ("mean", "p10", "median", "p90")), text]
        for key, text in MEANINGS.items()
        if key in facts
    ]
    origins = [[source, licence, f"{count}"] for (source, licence), count in sorted(sources.items())]
    empty_truth = float((statistics.features["surface_share"] == 0).mean())
    shard_word = "shard" if facts["shards"] == 1 else "shards"
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>unghost · {html.escape(name)}</title><style>{STYLE}</style></head><body><main>
<h1>{html.escape(name)}</h1>
<p>{facts["total"]} pairs of cubes, 32 voxels along each edge, in {facts["shards"]} {shard_word}. A pair is what a
radiance field shows of a small cube of space (the input) and what is there (the truth). A prior learns to tell the
second from the first.</p>
<div class="facts">
<div><b>{facts["total"]}</b><span>cubes</span></div>
<div><b>{_percent(facts["empty_share"])}</b><span>empty inputs</span></div>
<div><b>{_percent(empty_truth)}</b><span>empty truths</span></div>
<div><b>{facts["iou"]["mean"]:.2f}</b><span>mean IoU of input and truth</span></div>
<div><b>{_percent(facts["ghost_share"]["mean"])}</b><span>of an input is ghost</span></div>
<div><b>{_percent(facts["missing_share"]["mean"])}</b><span>of a true surface is missing</span></div>
</div>
<p class="soft">Statistics are of {facts["cubes"]} cubes drawn at random.</p>
<h2>{len(drawn)} of the cubes, drawn at random</h2>
<p class="key soft">{legend}</p>
<p class="soft">Below each pair: the overlap of the two, how much of the input is ghost, how much of the truth is
missing; then where the pair is stored, the cube's edge as a share of its scene's or object's extent, and how severe
the damage is said to be, from 0 (none) to 1.</p>
<div class="cubes">{"".join(_card(cube) for cube in drawn)}</div>
<h2>Distributions</h2>
<div class="charts">{_charts(statistics, edges, severities)}</div>
<h2>In numbers</h2>
{_table(HEADS, rows, text_columns=(5,))}
{_against(facts)}
<h2>Sources and licences</h2>
{_table(["source", "licence", "cubes"], origins, text_columns=(1,))}
{_passed_over(rejected)}
</main></body></html>
"""
