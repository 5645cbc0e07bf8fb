"""``docs/results/README.md``: who wins the two-trajectory benchmark where, in tables and plain words.

python benchmarks/trajectory_page.py            reads two_trajectory.json, writes the page and the figures
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from trajectory_tables import KEYS, REFERENCE, format_rows, main_rows, summary_rows, write_figures

from unghost.evaluation.conventions import get_convention
from unghost.evaluation.report import convention_rows

ROOT = Path(__file__).resolve().parents[1]
OURS = ("dsds-restoration", "clean", "visibility+clean")
WATCHED = (*OURS, "bayes-rays", "visibility", "field")
PLAIN = {
    "psnr_at_coverage": ("masked PSNR at equal coverage", "dB", 1, 2),
    "ssim_at_coverage": ("masked SSIM at equal coverage", "", 1, 3),
    "disparity_mae_at_coverage": ("disparity error at equal coverage", "", -1, 3),
    "normal_mean_deg_at_coverage": ("angle of normals at equal coverage", "°", -1, 1),
    "free_space_error": ("opacity left in free space", "", -1, 4),
}
OTHER_TABLES = {
    "every 8th photo": "Scored on every 8th photo of the training sweep, as most papers do: what that hides",
    "equal seconds": "At equal seconds",
    "ablation": "The paper's ablation",
}
Row = dict[str, Any]


def who_wins(rows: list[Row]) -> list[str]:
    """A line a score: who is best, and which place ours, Bayes' Rays and the field alone have."""
    most = max(row["runs"] for row in rows)
    methods = [row for row in rows if row["method"] != REFERENCE and row["runs"] == most]
    lines = []
    for key, (name, unit, sign, digits) in PLAIN.items():
        known = sorted((row for row in methods if row.get(key) is not None), key=lambda row: -sign * row[key])
        if not known:
            continue
        values = {row["method"]: f"{row[key]:.{digits}f}{' dB' if unit == 'dB' else unit}" for row in known}
        places = {row["method"]: 1 + sum(sign * other[key] > sign * row[key] for other in known) for row in known}
        said = [f"`{method}` {values[method]} (place {places[method]} of {len(known)})"
                for method in WATCHED if method in values and places[method] > 1]  # fmt: skip
        best = [method for method, place in places.items() if place == 1]
        verdict = "we win" if any(method in OURS for method in best) else "we lose"
        lines.append(
            f"- **{name[0].upper()}{name[1:]}: {verdict}.** Best: {' and '.join(f'`{each}`' for each in best)} "
            f"{values[best[0]]}. {', '.join(said)}."
        )
    for row in rows:
        if row["method"] == "clean" and row["strength"] is not None:
            lines.append(
                f"- `clean` chose its strength on the training photos: {row['strength']:.2f} in the mean, where 0 "
                "leaves the field as it is and .5 is the prior's own threshold."
            )
    return lines


def page(results: dict[str, Any]) -> str:
    """The whole text."""
    cells, rows = results["cells"], main_rows(results, "main")
    scenes = list(dict.fromkeys(cell["scene"] for cell in cells if cell["table"] == "main"))
    seeds = sorted({cell["seed"] for cell in cells if cell["table"] == "main"})
    text = [
        "# Who takes ghosts out?", "",
        "Written by `python benchmarks/trajectory_page.py` from two_trajectory.json, which "
        f"`{results['command']}` made (commit {results['commit'][:7]}).", "",
        f"A field is fitted to one sweep of photos and scored on another: {len(scenes)} scenes ({', '.join(scenes)}), "
        f"seeds {', '.join(map(str, seeds))}; all that trains does so for equally many steps. Synthetic scenes have "
        "exact depth, normals and visibility, and every place in them is known to be surface or air. The scores' "
        "convention is `proper` ([what that is](../evaluation.md)); means are over scenes (the JSON has 95 % "
        "intervals of a bootstrap over scenes).", "",
        "**Equal coverage.** Whoever removes more is scored on easier pixels. So every method is cut to the lowest "
        "coverage among all of them on that scene. It gives up the pixels whose depth along the ray is least sharp, "
        "or, if it has an uncertainty of its own (`bayes-rays`; `clean`, whose prior doubts what is there), those of "
        "which it is least sure, whichever is better for it; a knob is turned to its best there (in the method's "
        "favour, and with an eye on the truth).", "",
        "## In plain words", "", *who_wins(rows), "", *scene_lines(results), "",
        "## At equal coverage", "",
        format_rows(rows, ("at_coverage", "psnr_at_coverage", "ssim_at_coverage", "disparity_mae_at_coverage",
                           "normal_mean_deg_at_coverage", "psnr_at_0.3", "psnr_at_0.4", "psnr_at_0.5")), "",
        "![score over coverage](two_trajectory.png)", "",
        "## As the paper's table has it, each method at its own coverage", "",
        format_rows(rows, ("psnr", "ssim", "flip", "depth_mse", "disparity_mae", "normal_mean_deg", "normal_median_deg",
                           "normal_pct_30", "coverage", "psnr_visible", "seconds")), "",
        "`psnr_visible` is over all pixels that a training photo saw, whatever is rendered there: nothing is won by "
        "removing. LPIPS needs weights that were not to be had; FLIP is the perceptual measure without any.", "",
        "## What is known of every place (synthetic scenes)", "",
        format_rows(rows, ("floater_recall", "surface_kept", "holes_filled", "free_space_error", "ause")), "",
        "`floater_recall`: of what was opaque in the air, no longer opaque. `ause`: how badly the method's uncertainty "
        "(`bayes-rays` its own, `clean` its prior's doubt, the others the spread of a ray's depth) ranks depth errors "
        "among the pixels that it is scored on; 0 is perfect.", "",
    ]  # fmt: skip
    knobs = [row for row in results["rows"] if row["table"] == "main" and "@" in row["method"]]
    if knobs:
        text += ["## Knobs", "", format_rows(knobs, ("psnr", "disparity_mae", "coverage", "floater_recall",
                                                     "surface_kept")), ""]  # fmt: skip
    text += convention_lines(cells)
    for table, heading in OTHER_TABLES.items():
        if other := main_rows(results, table):
            text += [f"## {heading}", "", format_rows(other, ("psnr", "ssim", "disparity_mae", "normal_mean_deg",
                     "coverage", "psnr_at_coverage", "floater_recall", "surface_kept", "seconds")), ""]  # fmt: skip
    return "\n".join(text + notes(rows))


def scene_lines(results: dict[str, Any]) -> list[str]:
    """How hard each scene is."""
    known = results.get("scenes", {}).get("main", {})
    if not known:
        return []
    head = ["scene", "photos to train on", "scored", "to the nearest photo", "turned by", "pixels that it saw"]
    lines = [f"| {' | '.join(head)} |", "| --- |" + " --- |" * 5]
    for name, each in known.items():
        lines.append(
            f"| {name} | {each['train_photos']} | {each['photos']} | {each['translation_to_nearest']:.2f} | "
            f"{each['rotation_to_nearest_deg']:.0f}° | {each['visible']:.2f} |"
        )
    return ["## The scenes", "", *lines, "", "Means over the scored photos; all cameras in [-1, 1] (the paper's 0.62, "
            "28.5°; MipNeRF-360 0.07, 10.5°)."]  # fmt: skip


def convention_lines(cells: list[Row]) -> list[str]:
    """How far the published conventions differ on the very same renders: those of the field alone."""
    known = [cell["conventions"] for cell in cells if cell["table"] == "main" and cell.get("conventions")]
    names = [name for name in (known[0] if known else {}) if all(name in each for each in known)]
    if not names:
        return []

    def mean(name: str, key: str) -> float | None:
        values = [each[name].get(key) for each in known]
        return float(np.mean(values)) if all(value is not None for value in values) else None  # type: ignore[arg-type]

    scores: dict[str, Row] = {
        name: {"convention": name, **{key: mean(name, key) for key in get_convention(name).keys}} for name in names
    }
    rows = [{**row, "method": row["metric"]} for row in convention_rows(scores)
            if any(row[name] is not None for name in names)]  # fmt: skip
    return ["## The same renders under every published convention", "",
            f"`field`, mean of {len(known)} scenes; these columns must never be mixed:", "",
            format_rows(rows, (*names, "spread")).replace("| method |", "| metric |"), ""]  # fmt: skip


def notes(rows: list[Row]) -> list[str]:
    """What a row has to say for itself."""
    said = [f"- `{row['method']}`: {row['note']}." for row in rows if row.get("note")]
    few = [row for row in rows if row["runs"] < max(each["runs"] for each in rows)]
    said += [f"- `{row['method']}`: {row['runs']} runs only." for row in few]
    return ["## Notes", "", *said, ""] if said else []


def main() -> None:
    path = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "docs" / "results" / "two_trajectory.json"
    results = json.loads(path.read_text(encoding="utf-8"))
    results["rows"] = summary_rows(results["cells"])
    assert set(KEYS) <= set(results["rows"][0])
    path.with_name("README.md").write_text(page(results), encoding="utf-8")
    write_figures(path)


if __name__ == "__main__":
    main()
