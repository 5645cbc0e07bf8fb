"""``docs/results/README.md``: who wins the two-trajectory benchmark where, in tables and plain words.

python -m benchmarks.two_trajectory.page            reads two_trajectory.json (means as stored), writes page and figures
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import sem, t

from unghost.core.metrics import get_metric
from unghost.evaluation.report.rows import convention_rows
from unghost.evaluation.scoring.conventions import get_convention
from unghost.evaluation.scoring.intervals import Interval

from .compact import read_expanded
from .figure import write_figures
from .idle import idle_lines
from .tables import ORDERS, REFERENCE, finished, format_rows, main_rows, per_sample, per_scene, summary_rows

ROOT = Path(__file__).resolve().parents[2]
OURS = (
    "photo-doubt",
    "dsds-restoration",
    "dsds-restoration+distortion",
    "dsds-restoration+tv",
    "dsds-once",
    "dsds-once+tv",
    "clean",
    "clean+points",
    "visibility+clean",
    "dsds-restoration+clean",
    *(f"{name}+sight-lines{more}" for name in ("visibility", "dsds") for more in ("", "+distortion", "+tv")),
    "scratch+sight-lines",
    "scratch+all",
)
NOTHING_OF_OURS = "photo-doubt"  # but the order of pixels: where all have the same, it is the field as it was fitted
WATCHED = ("dsds-restoration", "clean")
ENOUGH = 6  # scenes
ROWS = {
    "pseudo-gt": "a field fitted to both sweeps, which has seen what it is scored on; not scored on the capture, whose "
    "depth, normals and visibility it gives",
    "fitted": "the field as it was fitted; all others go on from it",
    "field": "as many steps more, by the photos alone",
    "visibility": "with the paper's visibility loss, as all that follow but `free-space`, `bayes-rays`, `components`, "
    "`photo-doubt` and `clean`",
    "free-space": "the free-space prior of Optimize the Unseen, without the visibility loss, whose rival it is",
    "bayes-rays": "our own implementation of Bayes' Rays: what it is unsure of is filtered out of `fitted`",
    "components": "all but the largest connected piece goes from `fitted`",
    "dsds-paper": "the paper's method, with the paper's thresholds and a diffusion trained here",
    "photo-doubt": "ours: `fitted`, nothing but the order of pixels changed",
    "dsds-restoration": "ours: score distillation with the shipped restoration prior",
    "dsds-once": "ours: the prior judges the field once, as for `clean`, and what it would take out is held down while "
    "the field trains on (`RemovalLoss`): the photos may object",
    "clean": "ours: `unghost.clean` on `fitted`, or after another method (`…+clean`)",
    "clean+points": "ours: `unghost.clean` with the prior `evidence`, the training cameras and their sparse points",
    "visibility+ds-nerf": "DS-NeRF's depth supervision by the sparse points of the training photos, deviations from "
    "their triangulation",
    "visibility+urban": "the expected-depth and line-of-sight losses of Urban Radiance Fields, on the same points",
    "visibility+nearest-point": "density costs in proportion to the distance to the nearest of the same points, up to "
    "a tenth of the median distance from a camera to a point",
    "visibility+floater-score": "density costs by a hand-made score: sight lines through / (through + 3 ending) × "
    "distance to the five nearest points, up to the same length × (1 − opacity beside it)",
    "visibility+sight-lines": "ours, without the prior: density costs on sight lines between cameras and the points",
    "dsds+sight-lines": "ours: score distillation, the visibility loss and sight lines, all at their defaults",
    "scratch": "not fine-tuned: the fit itself, by the photos alone, with its seconds",
    "scratch+distortion": "a fit with the distortion loss from the first step on, for as many steps",
    "scratch+sight-lines": "ours: a fit with sight lines from the first step on",
    "scratch+all": "ours: a fit with distortion, visibility and sight lines from the first step on",
}
PER_SCENE = ("psnr_at_coverage", "psnr", "disparity_mae_at_coverage", "coverage", "floater_recall", "surface_kept")
SCENES_PAGE = "two_trajectory_scenes.md"
PLAIN = (
    "psnr_at_coverage",
    "psnr_area",
    "psnr_area_by_photos",
    "psnr_area_by_spread",
    "ssim_at_coverage",
    "ssim_area",
    "disparity_mae_at_coverage",
    "disparity_mae_area",
    "disparity_mae_area_by_photos",
    "free_space_error",
)
UNITS = {"dB": " dB"}  # worth a word behind a number
OTHER_TABLES = {
    "every 8th photo": "Scored on every 8th photo of the training sweep (faults and all), as most papers do: what that "
    "hides",
    "equal seconds": "At equal seconds (what `clean` and `photo_doubt` take comes on top)",
    "ablation": "The paper's ablation",
}
CUTS = tuple(order for order, known in ORDERS.items() if known)
Row = dict[str, Any]


def who_wins(results: dict[str, Any]) -> list[str]:
    """In a sentence a verdict, then a line a score: the best of ours and of the rivals, and whether that is chance."""
    said: dict[str, list[str]] = {}
    methods = [row for row in main_rows(results, "main") if row["method"] != REFERENCE]
    head = ("score", "", "our best", "best rival", "ours is better by (95 %)", *(f"`{name}`" for name in WATCHED))
    lines = [f"| {' | '.join(head)} |", "| --- |" + " --- |" * (len(head) - 1)]
    for key in PLAIN:
        metric = get_metric(key)
        name, unit, sign, digits = metric.name, UNITS.get(metric.unit, ""), metric.sign, metric.decimals
        known = sorted((row for row in methods if row.get(key) is not None), key=lambda row: -sign * row[key])
        one_order = "_by_" in key or key == "free_space_error"
        ours = [row for row in known if row["method"] in OURS and not (one_order and row["method"] == NOTHING_OF_OURS)]
        rivals = [row for row in known if row["method"] not in OURS]
        if not ours or not rivals:
            continue
        apart = difference(results["cells"], ours[0]["method"], rivals[0]["method"], key, sign)
        said.setdefault(verdict(apart), []).append(name)
        best = [f"`{row['method']}` {row[key]:.{digits}f}{unit}" for row in (ours[0], rivals[0])]
        by = f"{apart.mean:.{digits}f}" if apart.mean is not None else "–"
        if apart.low is not None:
            by += f" ({apart.low:.{digits}f} to {apart.high:.{digits}f})"
        places = {row["method"]: f"{row[key]:.{digits}f}, place {place}" for place, row in enumerate(known, 1)}
        watched = [places.get(method, "–") for method in WATCHED]
        lines.append(f"| {' | '.join([name, f'**{verdict(apart)}**', *best, by, *watched])} |")
    short = [
        f"- **{which[0].upper()}{which[1:]}**: {'; '.join(names)}."
        for which, names in sorted(said.items(), key=_best_first)
    ]
    return [*short, "", *lines]


def _best_first(said: tuple[str, list[str]]) -> tuple[bool, bool]:
    """Won, perhaps won, perhaps lost, lost."""
    lost = said[0].startswith("we lose")
    return lost, ("," in said[0]) != lost


def verdict(apart: Interval) -> str:
    """By how much ours is better, scene by scene."""
    if apart.mean is None or apart.mean == 0:
        return "a tie"
    who = "we win" if apart.mean > 0 else "we lose"
    if apart.count < ENOUGH or apart.low is None or apart.high is None:
        return f"{who}, on {apart.count} scene{'s' * (apart.count > 1)}: too few to tell"
    return who if apart.low > 0 or apart.high < 0 else f"{who}, within chance"


def difference(cells: list[Row], ours: str, rival: str, key: str, sign: int) -> Interval:
    """How much better ours is, over the scenes' means; Student's t, as a bootstrap of so few scenes is too sure."""
    found = per_scene(cells, (ours, rival), key)
    common = [name for name in found[ours] if name in found[rival]]
    values = np.array(
        [*per_sample({name: sign * (found[ours][name] - found[rival][name]) for name in common}).values()]
    )
    if len(values) < 2:
        return Interval(float(values.mean()) if len(values) else None, None, None, 0.95, len(values), 0)
    mean, half = float(values.mean()), float(sem(values) * t.ppf(0.975, len(values) - 1))
    return Interval(mean, mean - half, mean + half, 0.95, len(values), 0)


PICTURES = {
    "two_trajectory_views.png": "What the methods look like from the other sweep",
    "two_trajectory_doubt.png": "What the photos and the prior doubt of the field as it was fitted, and what is wrong",
}


def picture_lines(folder: Path) -> list[str]:
    """Those of ``pictures.py`` that are there."""
    there = {name: said for name, said in PICTURES.items() if (folder / name).exists()}
    return [line for name, said in there.items() for line in (f"{said}:", "", f"![{said.lower()}]({name})", "")]


def page(results: dict[str, Any], folder: Path) -> str:
    """The whole text; ``folder``: where it will stand, beside its pictures."""
    cells, rows = finished(results["cells"]), main_rows(results, "main")
    main = [cell for cell in cells if cell["table"] == "main"]
    scenes = list(dict.fromkeys(cell["scene"] for cell in main))
    text = [
        "# Who takes ghosts out?",
        "",
        f"A field is fitted to one sweep of photos and scored on another: {len(scenes)} scenes "
        f"({', '.join(scenes)}); all that trains does so for equally many steps. Synthetic scenes have exact depth, "
        "normals and visibility, and of most places in them it is known whether they are surface or air; of a capture "
        "nothing is known but the photos, and a field fitted to both sweeps stands for the rest, as in the paper; "
        f"pairs of sweeps of one capture count as one scene. [Scene by scene]({SCENES_PAGE}). The "
        "scores' convention is `proper` ([what that is](../evaluation.md)); means are over scenes, of each scene over "
        "its seeds.",
        "",
        "**Equal coverage.** Whoever removes more is scored on easier pixels. So every method is cut to the lowest "
        "coverage among all of them on that scene, giving up first the pixels of which it is least sure: `bayes-rays` "
        "by its own uncertainty; ours by how far the training photos contradict the pixel (`photo_doubt`) and by how "
        "far the disparity along the ray spreads; whoever has no such thing by how far the depth spreads. All kept "
        "pixels of a scene count alike. **Mean over equal coverages**: the same at every coverage from .1 up to that "
        "lowest one (`…_area`), for a viewer who would rather see less and trust it.",
        "",
        "`photo_doubt` asks for nothing but renders and the photos, so anybody may cut by it. What a method is worth "
        "beside its order is said by the scores where *all* are cut by photo doubt.",
        "",
        "## In plain words",
        "",
        *who_wins(results),
        "",
        '"Within chance": the 95 % interval of the difference over the scenes (Student\'s t) holds 0. Each side '
        "sends its best of several for each score, which flatters both. Angles of normals get no verdict: between "
        "neighbouring pixels of renders this small the depth is noise, as the row of "
        f"`{REFERENCE}` shows.",
        "",
        "What the rows are:",
        "",
        *(f"- `{name}`: {said}." for name, said in ROWS.items()),
        "",
        *picture_lines(folder),
        *scene_lines(results, main),
        "",
        "## At equal coverage",
        "",
        format_rows(
            rows,
            (
                "at_coverage",
                "psnr_at_coverage",
                "ssim_at_coverage",
                "disparity_mae_at_coverage",
                "normal_mean_deg_at_coverage",
                "psnr_area",
                "ssim_area",
                "disparity_mae_area",
            ),
        ),
        "",
        "![score over coverage](two_trajectory.png)",
        "",
        "## How much of that is the order in which pixels are given up?",
        "",
        "The same renders, cut in each method's own order, all by the spread of the depth, all by what the photos say.",
        "",
        format_rows(
            rows,
            tuple(f"psnr_at_coverage{order}" for order in CUTS)
            + tuple(f"{key}_area{order}" for key in ("psnr", "disparity_mae") for order in CUTS),
        ),
        "",
        "## As the paper's table has it, each method at its own coverage",
        "",
        format_rows(
            rows,
            (
                "psnr",
                "ssim",
                "flip",
                "depth_mse",
                "disparity_mae",
                "normal_mean_deg",
                "normal_median_deg",
                "normal_pct_30",
                "coverage",
                "psnr_visible",
                "seconds",
                "cpu_seconds",
            ),
        ),
        "",
        f"`seconds` by the clock with {results['threads']} thread{'s' * (results['threads'] > 1)} of two cores, "
        "`cpu_seconds` of all threads together; ours with the photo doubt of the scored views. "
        "`psnr_visible` is over all pixels that a training photo saw, whatever is rendered there: nothing is won by "
        "removing. LPIPS needs weights that were not to be had; FLIP is the perceptual measure without any.",
        "",
        "## What is known of every place (synthetic scenes)",
        "",
        format_rows(
            rows,
            (
                "floater_recall",
                "surface_kept",
                "holes_filled",
                "free_space_error",
                "ause",
                "ause_by_spread",
                "ause_by_photos",
            ),
        ),
        "",
        "`floater_recall`: of what was opaque in the air, no longer opaque. `ause`: how badly an order of pixels (the "
        "method's own, by spread, by photos) ranks depth errors among those that it is scored on; 0 is perfect.",
        "",
        *knob_lines(main),
        *convention_lines(main),
    ]
    for table, heading in OTHER_TABLES.items():
        if other := main_rows(results, table):
            named = ", ".join(other[0]["scenes"])
            text += [
                f"## {heading}",
                "",
                f"{named}; seed 0.",
                "",
                format_rows(
                    other,
                    (
                        "psnr",
                        "ssim",
                        "disparity_mae",
                        "coverage",
                        "psnr_at_coverage_by_spread",
                        "psnr_at_coverage_by_photos",
                        "psnr_area_by_photos",
                        "disparity_mae_area_by_photos",
                        "floater_recall",
                        "surface_kept",
                        "seconds",
                    ),
                ),
                "",
            ]
    return "\n".join(text + notes(rows, idle_lines(main)) + provenance(results))


def knob_lines(main: list[Row]) -> list[str]:
    """Methods with a knob at all its settings, on the seed on which they were tried."""
    turned_on = {cell["scene"] for cell in main if "@" in cell["method"]}
    first = [cell for cell in main if cell["seed"] == 0 and cell["scene"] in turned_on]
    rows = [row for row in summary_rows(first) if row["coverage"] is not None]
    turned = {row["method"].split(" @ ")[0] for row in rows if "@" in row["method"]}
    shown = [row for row in rows if row["method"].split(" @ ")[0] in turned]
    keys = (
        "psnr",
        "disparity_mae",
        "coverage",
        "floater_recall",
        "surface_kept",
        "psnr_at_coverage",
        "psnr_at_coverage_at_best",
    )
    said = (
        "Seed 0 of the synthetic scenes. The row without a number stands in the tables. `…_at_best`: with the knob "
        "and the order that turn out best on each scene, which takes an eye on the truth: nobody can have "
        "that."
    )
    return ["## Knobs", "", said, "", format_rows(shown, keys), ""] if shown else []


def provenance(results: dict[str, Any]) -> list[str]:
    """Which commands made the numbers, at which commits."""
    commits = sorted({cell.get("commit", "?")[:7] for cell in results["cells"]})
    return [
        "## Where this is from",
        "",
        "Written by `python -m benchmarks.two_trajectory.page` from two_trajectory.json, "
        f"rows made at the commits {', '.join(commits)} by",
        "",
        "```",
        *results["command"].split(" ; "),
        "```",
        "",
    ]


def scene_lines(results: dict[str, Any], main: list[Row]) -> list[str]:
    """How hard each scene is, and the seeds that are finished."""
    known = results.get("scenes", {}).get("main", {})
    seeds = {name: sorted({cell["seed"] for cell in main if cell["scene"] == name}) for name in known}
    head = ["scene", "seeds", "photos to train on", "scored", "to the nearest photo", "turned by", "pixels that it saw"]
    head.append("sparse points")
    lines = [f"| {' | '.join(head)} |", "| --- |" + " --- |" * (len(head) - 1)]
    for name in (name for name in sorted(known) if seeds[name]):
        each = known[name]
        lines.append(
            f"| {name} | {', '.join(map(str, seeds[name]))} | {each['train_photos']} | {each['photos']} | "
            f"{each['translation_to_nearest']:.2f} | {each['rotation_to_nearest_deg']:.0f}° | {each['visible']:.2f} | "
            f"{each.get('points', '–')} |"
        )
    if len(lines) == 2:
        return []
    return [
        "## The scenes",
        "",
        *lines,
        "",
        "Means over the scored photos; all cameras in [-1, 1] (the paper's 0.62, 28.5°; MipNeRF-360 0.07, 10.5°).",
    ]


def scenes_page(results: dict[str, Any]) -> str:
    """Every method's scores on every scene, as the paper's supplement has them."""
    cells = [cell for cell in finished(results["cells"]) if cell["table"] == "main"]
    scenes = sorted({cell["scene"] for cell in cells})
    names = [row["method"] for row in main_rows(results, "main")]
    text = [
        "# Who takes ghosts out, scene by scene",
        "",
        "Written by `python -m benchmarks.two_trajectory.page`; means over the seeds of each scene. What the rows and "
        "columns are is said [with the means over all scenes](README.md).",
        "",
    ]
    for key in PER_SCENE:
        metric, found = get_metric(key), per_scene(results["cells"], names, key)
        shown = [scene for scene in scenes if any(scene in each for each in found.values())]
        if not shown:
            continue
        text += [f"## {metric.name[0].upper()}{metric.name[1:]}", "", f"| method | {' | '.join(shown)} |"]
        text += ["| --- |" + " --- |" * len(shown)]
        for name in names:
            values = [found[name].get(scene) for scene in shown]
            line = ["–" if value is None else f"{value:.{metric.decimals}f}" for value in values]
            text.append(f"| {name} | {' | '.join(line)} |")
        text.append("")
    return "\n".join(text)


def convention_lines(main: list[Row]) -> list[str]:
    """How far the published conventions differ on the very same renders: those of the field alone."""
    known = [(cell["scene"], cell["conventions"]) for cell in main if cell.get("conventions")]
    names = [name for name in (known[0][1] if known else {}) if all(name in each for _, each in known)]
    if not names:
        return []

    def mean(name: str, key: str) -> float | None:
        scenes: dict[str, list[float | None]] = {}
        for scene, each in known:
            scenes.setdefault(scene, []).append(each[name].get(key))
        if any(value is None for values in scenes.values() for value in values):
            return None
        return float(np.mean([np.mean(values) for values in scenes.values()]))  # type: ignore[arg-type]

    scores: dict[str, Row] = {
        name: {"convention": name, **{key: mean(name, key) for key in get_convention(name).keys}} for name in names
    }
    rows = [
        {**row, "method": row["metric"]}
        for row in convention_rows(scores)
        if any(row[name] is not None for name in names)
    ]
    return [
        "## The same renders under every published convention",
        "",
        f"`field`, mean of {len({scene for scene, _ in known})} scenes; these columns must never be mixed:",
        "",
        format_rows(rows, (*names, "spread")).replace("| method |", "| metric |"),
        "",
    ]


def notes(rows: list[Row], idle: list[str]) -> list[str]:
    """What a row has to say for itself; ``idle``: which rows test nothing."""
    said = [f"- `{row['method']}`: {row['note']}." for row in rows if row.get("note")]
    few = [row for row in rows if row["runs"] < max(each["runs"] for each in rows)]
    said += [f"- `{row['method']}`: {row['runs']} runs only." for row in few]
    said += [f"- {line}." for line in idle]
    return ["## Notes", "", *said, ""] if said else []


def main() -> None:
    path = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "docs" / "results" / "two_trajectory.json"
    results = read_expanded(path)
    path.with_name("README.md").write_text(page(results, path.parent), encoding="utf-8")
    path.with_name(SCENES_PAGE).write_text(scenes_page(results), encoding="utf-8")
    write_figures(path)


if __name__ == "__main__":
    main()
