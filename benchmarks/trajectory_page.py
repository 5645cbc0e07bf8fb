"""``docs/results/README.md``: who wins the two-trajectory benchmark where, in tables and plain words.

python benchmarks/trajectory_page.py            reads two_trajectory.json, writes the page and the figures
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from trajectory_figure import write_figures
from trajectory_tables import KEYS, ORDERS, REFERENCE, format_rows, main_rows, per_scene, summary_rows

from unghost.evaluation.conventions import get_convention
from unghost.evaluation.intervals import Interval, bootstrap_difference
from unghost.evaluation.report import convention_rows

ROOT = Path(__file__).resolve().parents[1]
OURS = (
    "photo-doubt", "dsds-restoration", "dsds-restoration+distortion", "dsds-restoration+tv", "clean",
    "visibility+clean", "dsds-restoration+clean",
)  # fmt: skip
WATCHED = (*OURS, "bayes-rays", "visibility", "field")
RESAMPLES = 2000
ENOUGH = 6  # scenes: a bootstrap over fewer never leaves the range of what it saw
PLAIN = {
    "psnr_at_coverage": ("masked PSNR at equal coverage", "dB", 1, 2),
    "psnr_area": ("masked PSNR, mean over equal coverages", "dB", 1, 2),
    "psnr_area_by_photos": ("masked PSNR, that mean, if all are cut by photo doubt", "dB", 1, 2),
    "psnr_area_by_spread": ("masked PSNR, that mean, if all are cut by the spread of the depth", "dB", 1, 2),
    "ssim_at_coverage": ("masked SSIM at equal coverage", "", 1, 3),
    "ssim_area": ("masked SSIM, mean over equal coverages", "", 1, 3),
    "disparity_mae_at_coverage": ("disparity error at equal coverage", "", -1, 3),
    "disparity_mae_area": ("disparity error, mean over equal coverages", "", -1, 3),
    "disparity_mae_area_by_photos": ("disparity error, that mean, if all are cut by photo doubt", "", -1, 3),
    "free_space_error": ("opacity left in free space", "", -1, 4),
}
OTHER_TABLES = {
    "every 8th photo": "Scored on every 8th photo of the training sweep (faults and all), as most papers do: what that "
    "hides",
    "equal seconds": "At equal seconds (what `clean` and `photo_doubt` take comes on top)",
    "ablation": "The paper's ablation",
}
Row = dict[str, Any]


def who_wins(results: dict[str, Any]) -> list[str]:
    """A line a score: who is best, whether that is more than chance, and which place the others have."""
    rows = main_rows(results, "main")
    most = max(row["runs"] for row in rows)
    methods = [row for row in rows if row["method"] != REFERENCE and row["runs"] == most]
    lines = []
    for key, (name, unit, sign, digits) in PLAIN.items():
        known = sorted((row for row in methods if row.get(key) is not None), key=lambda row: -sign * row[key])
        ours = [row for row in known if row["method"] in OURS]
        rivals = [row for row in known if row["method"] not in OURS]
        if not ours or not rivals:
            continue
        values = {row["method"]: f"{row[key]:.{digits}f}{' dB' if unit == 'dB' else unit}" for row in known}
        places = {row["method"]: 1 + sum(sign * other[key] > sign * row[key] for other in known) for row in known}
        first, second = ours[0], rivals[0]
        apart = difference(results["cells"], first["method"], second["method"], key, sign)
        named = (first["method"], second["method"])
        said = [f"`{method}` {values[method]} (place {places[method]} of {len(known)})"
                for method in WATCHED if method in values and method not in named]  # fmt: skip
        lines.append(
            f"- **{name[0].upper()}{name[1:]}: {verdict(apart)}.** Our best, `{first['method']}`, has "
            f"{values[first['method']]}, the best rival, `{second['method']}`, {values[second['method']]}. "
            f"{', '.join(said)}."
        )
    return lines


def verdict(apart: Interval) -> str:
    """By how much ours is better, scene by scene."""
    if apart.mean is None or apart.mean == 0:
        return "a tie"
    who = "we win" if apart.mean > 0 else "we lose"
    if apart.count < ENOUGH or apart.low is None or apart.high is None:
        return f"{who}, on {apart.count} scene{'s' * (apart.count > 1)}: too few to tell"
    return who if apart.low > 0 or apart.high < 0 else f"{who}, within chance"


def difference(cells: list[Row], ours: str, rival: str, key: str, sign: int) -> Interval:
    """How much better ours is, over the scenes' means, with a bootstrap interval over scenes."""
    found = per_scene(cells, (ours, rival), key)
    common = [name for name in found[ours] if name in found[rival]]
    pairs = [[sign * found[method][name] for name in common] for method in (ours, rival)]
    return bootstrap_difference(*pairs, np.random.default_rng(0), resamples=RESAMPLES)


PICTURES = {
    "two_trajectory_views.png": "What the methods look like from the other sweep",
    "two_trajectory_doubt.png": "What the photos and the prior doubt of the field as it was fitted, and what is wrong",
}


def picture_lines(folder: Path) -> list[str]:
    """Those of ``trajectory_pictures.py`` that are there."""
    there = {name: said for name, said in PICTURES.items() if (folder / name).exists()}
    return [line for name, said in there.items() for line in (f"{said}:", "", f"![{said.lower()}]({name})", "")]


def page(results: dict[str, Any], folder: Path) -> str:
    """The whole text; ``folder``: where it will stand, beside its pictures."""
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
        "coverage among all of them on that scene, giving up first the pixels of which it is least sure: `bayes-rays` "
        "by its own uncertainty (of the field before anything is taken out of it); ours by how far the training "
        "photos contradict the pixel (`photo_doubt`) and by how far the depth along the ray spreads; whoever has no "
        "such thing by that spread alone. All kept pixels of a scene count alike. **Mean over equal coverages**: the "
        "same at every coverage from .1 up to that lowest one (`…_area`), for a viewer who would rather see less and "
        "trust it.", "",
        "`photo_doubt` asks for nothing but renders and the photos, so anybody may cut by it, and the row "
        "`photo-doubt` is the field as it was fitted with that order and nothing else. What a method is worth beside "
        "its order is said by the scores where *all* are cut by photo doubt.", "",
        "## In plain words", "", *who_wins(results), "",
        "A verdict is \"within chance\" if the 95 % interval of the difference over the scenes holds 0; each side "
        "sends its best of several for each score, which flatters both. Angles of normals get none: between "
        "neighbouring pixels of renders this small the depth is noise, as the row of "
        f"`{REFERENCE}` shows.", "", *picture_lines(folder), *scene_lines(results), "",
        "## At equal coverage", "",
        format_rows(rows, ("at_coverage", "psnr_at_coverage", "ssim_at_coverage", "disparity_mae_at_coverage",
                           "normal_mean_deg_at_coverage", "psnr_area", "ssim_area", "disparity_mae_area")), "",
        "![score over coverage](two_trajectory.png)", "",
        "## How much of that is the order in which pixels are given up?", "",
        "The same renders, cut in each method's own order, all by the spread of the depth, all by what the photos "
        "say, and with the order and the knob that turn out best for the method on that scene (with an eye on the "
        "truth: nobody can have that).", "",
        format_rows(rows, tuple(f"psnr_at_coverage{order}" for order in ORDERS)
                    + tuple(f"{key}_area{order}" for key in ("psnr", "disparity_mae")
                            for order in ("", "_by_spread", "_by_photos"))), "",
        "## As the paper's table has it, each method at its own coverage", "",
        format_rows(rows, ("psnr", "ssim", "flip", "depth_mse", "disparity_mae", "normal_mean_deg", "normal_median_deg",
                           "normal_pct_30", "coverage", "psnr_visible", "seconds", "cpu_seconds")), "",
        f"`seconds` by the clock with {results['threads']} thread{'s' * (results['threads'] > 1)} of two cores, "
        "`cpu_seconds` of all threads together; ours with the photo doubt of the scored views.",
        "`psnr_visible` is over all pixels that a training photo saw, whatever is rendered there: nothing is won by "
        "removing. LPIPS needs weights that were not to be had; FLIP is the perceptual measure without any.", "",
        "## What is known of every place (synthetic scenes)", "",
        format_rows(rows, ("floater_recall", "surface_kept", "holes_filled", "free_space_error", "ause",
                           "ause_by_spread", "ause_by_photos")), "",
        "`floater_recall`: of what was opaque in the air, no longer opaque. `ause`: how badly an order of pixels (the "
        "method's own, by spread, by photos) ranks depth errors among those that it is scored on; 0 is perfect.", "",
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
    path.with_name("README.md").write_text(page(results, path.parent), encoding="utf-8")
    write_figures(path)


if __name__ == "__main__":
    main()
