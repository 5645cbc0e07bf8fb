"""HTML of a preview: drawn cubes, histograms and tables, pictures inline."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ...core.pages import Histogram, Table, histogram, render
from ...core.pages.charts import percent
from .drawing import GHOST, MISSING, SURFACE, UNJUDGED, png_bytes
from .statistics import CubeStatistics

if TYPE_CHECKING:
    from .preview import DrawnCube

Values = NDArray[np.float64]
LEGEND = (
    (SURFACE, "true surface"),
    (GHOST, "ghost: the input is opaque where nothing is"),
    (MISSING, "missing: surface that the input lacks"),
    (UNJUDGED, "not judged"),
)
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
HEADS = ("per cube", "mean", "10\u00a0%", "median", "90\u00a0%", "meaning")
MOST_REJECTED = 20  # meshes that were passed over, named on the page


def _name(key: str) -> str:
    return "IoU" if key == "iou" else key.replace("_", " ")


def _hex(rgb: Sequence[float]) -> str:
    return "#" + "".join(f"{round(255 * part):02x}" for part in rgb)


def _edge(fraction: float) -> str:
    digits = ".0f" if fraction >= 0.1 else ".2g"
    return f"{100 * fraction:{digits}}\u00a0%"


def _number(value: float | None) -> str:
    if value is None:
        return "–"
    return f"{value:.1f}" if abs(value) >= 10 else f"{value:.3f}" if abs(value) < 1 else f"{value:.2f}"


def _charts(statistics: CubeStatistics, edges: Values, severities: Values) -> list[tuple[str, str, Histogram]]:
    """Title, caption and histogram of each distribution."""
    found, shares = statistics.features, np.linspace(0, 1, 21)
    fractions = np.geomspace(max(edges.min() * 0.999, 1e-4), max(edges.max() * 1.001, 2e-4), 21)
    middle = float(np.sqrt(fractions[0] * fractions[-1]))
    ends = {0: _edge(float(fractions[0])), 10: _edge(middle), 20: _edge(float(fractions[-1]))}
    thick = np.array([0, 1, 1.5, 2, 3, 4, 6, 8, 12, 16, 24, 33.0])
    units = {place: f"{thick[place]:g}" for place in (1, 3, 5, 7, 9)}
    opacity = statistics.opacity_histogram(25)  # the first bin is empty space
    unit = {0: "0", 20: "1"}

    def drawn(series: Mapping[str, Values], bins: Values, marks: Mapping[Any, str]) -> Histogram:
        counts = {name: np.histogram(values, bins)[0] for name, values in series.items()}
        return histogram(counts, len(bins) - 1, marks)

    occupied = {"input": found["occupied_share"], "truth": found["surface_share"]}
    return [
        (
            "Occupied share",
            "Cubes by the share of their voxels that is occupied.",
            drawn(occupied, shares, {0: "0", 10: "half", 20: "all"}),
        ),
        (
            "Edge fraction",
            "Cubes by their edge over the extent of the scene or object; logarithmic.",
            drawn({"cubes": edges}, fractions, ends),
        ),
        (
            "Opacity",
            f"Voxels by opacity, without the {percent(opacity[0])} below .04.",
            histogram({"voxels": opacity[1:]}, 24, {0: ".04", 11.5: ".5", 24: "1"}),
        ),
        (
            "Thickness",
            "Cubes by the mean thickness of what is occupied, in voxels.",
            drawn({"cubes": found["thickness"]}, thick, units),
        ),
        (
            "Agreement with the truth",
            "Cubes by the IoU of input and truth, over the voxels that are judged.",
            drawn({"cubes": found["iou"]}, shares, unit),
        ),
        ("Severity", "Cubes by severity, as stored with each cube.", drawn({"cubes": severities}, shares, unit)),
    ]


def _cube(cube: DrawnCube) -> dict[str, Any]:
    """One drawn cube: its pictures and two lines of caption."""
    ghost, missing = percent(cube.features["ghost_share"]), percent(cube.features["missing_share"])
    return {
        "seen": png_bytes(cube.seen),
        "truth": png_bytes(cube.truth),
        "scores": f"IoU {cube.features['iou']:.2f} · {ghost} ghost · {missing} missing",
        "origin": f"{cube.shard}, row {cube.row} · edge {_edge(cube.edge_fraction)} · severity {cube.severity:.2f}",
    }


def _against(found: Mapping[str, Any] | None) -> dict[str, Any] | None:
    """Distance to another set, as the page shows it."""
    if found is None:
        return None
    rows = [[_name(key), _number(value), MEANINGS[key]] for key, value in found["features"].items()]
    return {**found, "table": Table(["feature", "distance", "meaning"], rows, text_columns=(2,))}


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
    """HTML of the whole page; see :func:`unghost.data_recipes.inspection.preview.write_preview` for what it shows.

    Raises:
        ImportError: Jinja2 is missing.
    """
    rows = [
        [_name(key), *(_number(facts[key][mark]) for mark in ("mean", "p10", "median", "p90")), text]
        for key, text in MEANINGS.items()
        if key in facts
    ]
    origins = [[source, licence, f"{count}"] for (source, licence), count in sorted(sources.items())]
    meshes = sorted(rejected.items())
    return render(
        "preview.html.jinja",
        name=name,
        total=facts["total"],
        shards=facts["shards"],
        measured=facts["cubes"],
        headline=[
            (facts["total"], "cubes"),
            (percent(facts["empty_share"]), "empty inputs"),
            (percent(float((statistics.features["surface_share"] == 0).mean())), "empty truths"),
            (f"{facts['iou']['mean']:.2f}", "mean IoU of input and truth"),
            (percent(facts["ghost_share"]["mean"]), "of an input is ghost"),
            (percent(facts["missing_share"]["mean"]), "of a true surface is missing"),
        ],
        legend=[(_hex(rgb), label) for rgb, label in LEGEND],
        cubes=[_cube(cube) for cube in drawn],
        charts=_charts(statistics, edges, severities),
        statistics=Table(HEADS, rows, text_columns=(5,)),
        against=_against(facts.get("against")),
        sources=Table(["source", "licence", "cubes"], origins, text_columns=(1,)),
        rejected=Table(["mesh", "reason"], meshes[:MOST_REJECTED], text_columns=(1,)),
        rejected_more=max(0, len(meshes) - MOST_REJECTED),
    )
