"""The README's results: every number in that section is read from ``docs/results`` and from nowhere else.

python -m benchmarks.release.readme           writes the section anew
python -m benchmarks.release.readme --check   exit status 1 if it is not what the results say
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from unghost.core.metrics import format_value, get_metric

ROOT = Path(__file__).resolve().parents[2]
BEGIN, END = "<!-- results: written by benchmarks/release/readme.py -->", "<!-- end of results -->"
Row = dict[str, Any]


def load(name: str, root: Path = ROOT) -> dict[str, Any]:
    loaded: dict[str, Any] = json.loads((root / "docs" / "results" / f"{name}.json").read_text(encoding="utf-8"))
    return loaded


def headings(keys: Iterable[str], **told: str) -> list[str]:
    """The metrics' labels, or what a table calls them instead."""
    return [told.get(key, get_metric(key).label) for key in keys]


def table(header: Iterable[str], rows: Iterable[Iterable[str]]) -> list[str]:
    head = list(header)
    return [f"| {' | '.join(cells)} |" for cells in (head, ["---"] * len(head), *rows)]


def demo(results: dict[str, Any]) -> list[str]:
    keys = ("floater_recall", "floater_precision", "surface_kept", "iou_before", "iou", "seconds")
    rows = [[row["method"], *(format_value(row[key], key) for key in keys)] for row in results["rows"]]
    head = ["method", *headings(keys, floater_precision="of what was removed, ghosts", iou="after")]
    said = "The prior's removal threshold was chosen on other rooms of this kind (`benchmarks/release/ship.py`)."
    return ["**The demo's room** (`make demo`; every ghost labelled):", "", *table(head, rows), "", said]


GONE = "ghosts_removed_98"
SHIPPED = ("unghost", "xs", "views")  # as the reference measurement calls the default and the others
RETIRED = ("m",)  # measured while it was shipped
FOG = {
    "harvest": "fields of scenes not trained on",
    "harvest-unseen-field": "a kind of field not trained on",
    "capture": "a real capture's field",
}


def denoise(results: dict[str, Any]) -> list[str]:
    rows = results["rows"]
    speeds = {row["method"]: row for row in rows if "cubes_per_second" in row}
    smaller = tuple(name for name in speeds if name.endswith(("-fp16", "-int8")))  # in the table of models
    shown = [
        name
        for name in dict.fromkeys(row["method"] for row in rows if row["set"] != "speed")
        if "@" not in name and not name.startswith(smaller or ("\n",))
    ]
    methods = [name for name in shown if any(row["method"] == name and row["set"] == "clean" for row in rows)]
    found = {(row["method"], row["set"], row.get("family"), row.get("severity")): row for row in rows}
    severities = results["severities"]
    wanted = [
        ("clean", None, None),
        *(("synthetic", "mixed", severity) for severity in severities),
        ("synthetic-in-a-field", None, 0.8),
    ]
    head = [
        "method",
        "untouched",
        *(f"severity {severity:g}" for severity in severities),
        "0.8, in a field",
        "bubbles",
        "cubes/s",
    ]
    lines = []
    for method in methods:
        ious = [format_value(found[(method, *key)]["iou"], "iou") for key in wanted]
        bubbles = " / ".join(
            format_value(found[method, "bubbles", family, None][GONE], GONE) for family in ("bits", "soft")
        )
        speed = format_value(speeds.get(method, {}).get("cubes_per_second"), "cubes_per_second")
        lines.append([method, *ious, bubbles, speed])
    text = [
        "**Cubes of meshes that were never trained on**, one step at the default timestep (mean IoU with the truth, "
        f"{found['input', 'clean', None, None]['cubes']} cubes each):",
        "",
        *table(head, lines),
        "",
        "In a field: the same cubes at the edge fraction of a window of `clean` (.5), so that it must be no hint about "
        "the content. Bubbles, too: closed smooth bodies beside the untouched surfaces, as bits / as soft opacities; "
        "the share of them that is gone when .98 of the surface stays.",
        "",
    ]
    foggy = [name for name in FOG if ("input", name, None, None) in found]
    if foggy:
        lines = [[method, *(_removed(found[method, name, None, None]) for name in foggy)] for method in shown]
        text += [
            "**Cubes of badly constrained fields**: ghost voxels removed while .98 / .90 of the true ones stay, one "
            "threshold for all cubes of a set:",
            "",
            *table(["method", *(FOG[name] for name in foggy)], lines),
            "",
            *(f"{line}\n" for line in (_beaten(found, name, shown) for name in foggy) if line),
            "`unghost` is the default, `xs` a smaller one; `m` was the default once and is no longer shipped; `views` "
            "is told who looks where, and blind it is not. The diffusions are compact ones after short training "
            "([the prior](docs/prior.md)), shown at timestep 50; at 10 and 100 they are in docs/results/denoise.json.",
            "",
        ]
    speed = next(iter(speeds.values()))
    bare = [f"{name} {row['cubes_per_second']:.1f}" for name, row in speeds.items() if not row.get("trained", True)]
    said = f" Not trained, so nothing but their speed can be told: {', '.join(bare)} cubes/s." if bare else ""
    return [
        *text,
        *table(MODEL_HEAD, (_model(row, found) for row in speeds.values() if row.get("trained", True))),
        "",
        f"Speed with batches of {speed['batch']} and {speed['threads']} threads.{said}",
        "",
        "![speed against error](docs/results/denoise.png)",
    ]


MODEL_HEAD = (
    "model",
    "sees",
    "IoU, corrupted",
    "untouched",
    "parameters",
    "GFLOP a cube",
    "MB",
    "stored in",
    "cubes/s, onnxruntime",
    "torch",
)


def _model(row: Row, found: dict[Any, Row]) -> list[str]:
    """How good on mixed corruption a model is, how large, and how fast."""
    wanted = (("synthetic", "mixed", "mean"), ("clean", None, None))
    ious = [format_value(found[(row["method"], *key)]["iou"], "iou") for key in wanted]
    speeds = [format_value(row.get(key), key) for key in ("cubes_per_second", "torch_cubes_per_second")]
    seen = ", ".join(name.removeprefix("signed_").replace("_count", "s") for name in row["channels"])
    return [
        row["method"],
        seen,
        *ious,
        str(row["parameters"]),
        format_value(row["gflop"], "gflop"),
        format_value(row["megabytes"], "megabytes"),
        row["precision"],
        *speeds,
    ]


def _beaten(found: dict[Any, Row], name: str, shown: list[str]) -> str:
    """Which of the shipped priors lose to something else on a set of fog, in a sentence."""
    scores = {key[0]: row[GONE] for key, row in found.items() if key[1] == name and key[0] in shown}
    best = max(
        (method for method in scores if method.split(",")[0] not in SHIPPED + RETIRED),
        key=lambda method: scores[method],
    )
    losing = [f"{method} ({scores[method]:.3f})" for method in SHIPPED if scores.get(method, 1.0) < scores[best]]
    if not losing:
        return ""
    return f"At .98 kept, on {FOG[name]}, {best} ({scores[best]:.3f}) **beats** {', '.join(losing)}."


def _removed(row: Row) -> str:
    return " / ".join(format_value(row[key], key) for key in (GONE, "ghosts_removed_90"))


def channels(results: dict[str, Any]) -> list[str]:
    """What the network sees, and what it does about it."""
    rows = results["rows"]
    found = {(row["method"], row["set"], row.get("severity")): row for row in rows}
    methods = [name for name in dict.fromkeys(row["method"] for row in rows) if not name.endswith(", blind")]
    lines = [
        [
            name,
            format_value(found[name, "clean", None]["iou"], "iou"),
            format_value(found[name, "synthetic", "mean"]["iou"], "iou"),
            *(_removed(found[name, fog, None]) for fog in FOG if (name, fog, None) in found),
        ]
        for name in methods
    ]
    head = ["the network sees", "IoU, untouched", "IoU, corrupted", *FOG.values()]
    return [
        f"**What should it see?** The same small network ({results['size']}), data and {results['steps']} steps each, "
        "with more and more of what is known about a cube; ghosts removed while .98 / .90 of the true voxels stay:",
        "",
        *table(head, lines),
        "",
        "How many training photos have a voxel in their frustum (views) helps most; the largest share of light that "
        "one of them gets from it through the field itself (transmittance) helps on scenes like those trained on and "
        "on the capture, not on another kind of field; the surroundings (the same centre, three times the edge) add "
        "little. Of the shipped priors `views` takes view counts too, the others see the opacity alone.",
    ]


def statistics(results: dict[str, Any]) -> list[str]:
    distances = {row["method"]: row["distance"] for row in results["rows"]}
    shown = (
        "harvest, dense fields",
        "harvest",
        "harvest-unseen-field",
        "rooms",
        "meshes",
        "procedural, soft",
        "procedural, bits",
    )
    lines = [[name, format_value(distances[name], "distance")] for name in shown if name in distances]
    return [
        "**Do training cubes look like a real capture's field?** Distance of what the cubes show, in [0, 1]; two "
        f"halves of the capture's own cubes are at {results['sampling_floor']:.3f} ([the harvest](docs/harvest.md)):",
        "",
        *table(("cubes", "distance"), lines),
    ]


def capture(results: dict[str, Any]) -> list[str]:
    names = {"field": "(a) fine-tuned alone", "visibility": "(b) + visibility"}
    names |= {
        row["method"]: f"(c) + visibility + {row['method'].replace('dsds', 'DSDS')}" for row in results["rows"][2:]
    }
    keys = ("psnr", "psnr_common", "ssim", "disparity_mae", "normal_mean_deg", "coverage")
    rows = [[names[row["method"]], *(format_value(row[key], key) for key in keys)] for row in results["rows"]]
    told = {"psnr": "PSNR (own mask)", "psnr_common": "PSNR (common mask)", "disparity_mae": "disparity error"}
    head = ["", *headings(keys, **told)]
    seeds, priors = len(results["seeds"]), results.get("priors") or {"dsds": results["prior"]}
    called = ", ".join(f"{prior['name']} {prior['sha256'][:8]}" for prior in priors.values())
    return [
        f"**A real capture** ({results['capture']}: trained on one sweep of phone photos, scored on another; the "
        f"paper's masks, convention `{results['rows'][0]['convention']}`, depth limit {results['depth_limit']:.2f}, "
        f"{seeds} seed(s), DSDS with "
        f"{called}):",
        "",
        *table(head, rows),
        "",
        verdict({row["method"]: row for row in results["rows"]}),
        "",
        "![photo, (a), (b), (c), colour and depth](docs/results/capture.png)",
    ]


def verdict(rows: dict[str, Row]) -> str:
    """What the capture's table says, a sentence a prior."""
    said = []
    for method in rows:
        if not method.startswith("dsds"):
            continue
        gain, name = rows[method]["psnr"] - rows["visibility"]["psnr"], method.replace("dsds", "DSDS")
        depth = [format_value(rows[of]["disparity_mae"], "disparity_mae") for of in (method, "visibility")]
        said.append(
            f"{name} {'adds' if gain > 0 else '**loses**'} {abs(gain):.2f} dB to visibility alone; its disparity "
            f"error is {depth[0]}, that of visibility alone {depth[1]}."
        )
    return " ".join(said)


def curate(results: dict[str, Any]) -> list[str]:
    rows = [
        [
            row["method"],
            format_value(row["cubes_per_second"], "cubes_per_second"),
            f"{row['milliseconds']:.2f}",
            format_value(row["iou"], "iou"),
        ]
        for row in results["rows"]
        if "sweep" not in row
    ]
    head = ("cubes", "a second", "processor ms a cube", "IoU with ours")
    return [
        "**Making cubes** (two processes; mesh rows: a bumpy ball of 70,000 faces, from choosing where the cube lies "
        "to its packed bits, no corruption):",
        "",
        *table(head, rows),
    ]


def splats(results: dict[str, Any]) -> list[str]:
    methods = list(dict.fromkeys(row["method"] for row in results["rows"]))
    keys = ("floater_recall", "recall_blob", "recall_haze", "recall_needle", "surface_kept")
    lines = []
    for method in methods:
        rows = [row for row in results["rows"] if row["method"] == method]
        means = [format_value(sum(row[key] for row in rows) / len(rows), key) for key in keys]
        seconds = sorted(row["seconds"] for row in rows)
        worst = format_value(min(row["surface_kept"] for row in rows), "surface_kept")
        lines.append([method, *means, worst, format_value(seconds[len(seconds) // 2], "seconds")])
    head = (
        "method",
        "floaters removed",
        "clusters",
        "haze",
        "needles",
        "true splats kept",
        "in the worst room",
        "seconds",
    )
    count = results["rows"][0]["splats"]
    return [
        f"**3D Gaussian splats**: {len(results['seeds'])} furnished rooms of {count:,} splats, "
        f"{results['floaters']:.0%} of them floaters put there; no photos; the others with the parameters that people "
        "copy:",
        "",
        *table(head, lines),
        "",
        "The largest component is perfect, and nearly free, where all that is true hangs together.",
    ]


def two_trajectory(results: dict[str, Any]) -> list[str]:
    rows = [row for row in results["rows"] if row["table"] == "main" and "@" not in row["method"]]
    equal = ("psnr_at_coverage", "psnr_area", "psnr_area_by_photos", "disparity_mae_area")
    own = ("psnr", "coverage", "free_space_error", "cpu_seconds")
    lines = [[row["method"], *(format_value(row.get(key), key) for key in (*equal, *own))] for row in rows]
    head = (
        "method",
        "PSNR, equal coverage",
        "mean over coverages",
        "all cut by photo doubt",
        "disparity error, mean",
        "PSNR, own coverage",
        "coverage",
        "opacity in free space",
        "CPU seconds",
    )
    scenes = sorted({scene for row in rows for scene in row["scenes"]})
    (convention,), most = {row["convention"] for row in rows}, max(row["runs"] for row in rows)
    fewer = ", ".join(f"`{row['method']}` {row['runs']}" for row in rows if row["runs"] < most)
    return [
        f"**Two trajectories**: trained on one sweep of photos, scored on another; {len(scenes)} scenes "
        f"({', '.join(scenes)}), convention `{convention}`, {most} runs a method{f' ({fewer})' if fewer else ''}, "
        "equal steps for all that train. `pseudo-gt` has seen what it is scored on, and its fit is not in the seconds. "
        "The first four columns cut every method to the lowest coverage among them, and to all from .1 up to it, in "
        "its own order of pixels or all by photo doubt:",
        "",
        *table(head, lines),
        "",
        "Who wins where, the knobs, the curves and the paper's ablation, us losing included: "
        "[docs/results](docs/results/README.md).",
        "",
        "![score over coverage](docs/results/two_trajectory.png)",
    ]


SECTIONS = {
    "demo": demo,
    "splats": splats,
    "two_trajectory": two_trajectory,
    "denoise": denoise,
    "channels": channels,
    "capture": capture,
    "statistics": statistics,
    "curate": curate,
}


def made_by(results: dict[str, Any]) -> str:
    """The command, or the first of several; the rest stand in the results."""
    first, *more = results["command"].split(" ; ")
    return f"`{first}`" + (f" and {len(more)} more such commands, which the file lists," if more else "")


def section(root: Path = ROOT) -> str:
    """The whole section, markers included."""
    lines = [BEGIN, ""]
    for name, write in SECTIONS.items():
        if (root / "docs" / "results" / f"{name}.json").exists():
            results = load(name, root)
            lines += [*write(results), "", f"<sub>{made_by(results)} → docs/results/{name}.json</sub>", ""]
    return "\n".join([*lines, END])


def replaced(text: str, new: str) -> str:
    """``text`` with its results section replaced."""
    start, stop = text.index(BEGIN), text.index(END) + len(END)
    return text[:start] + new + text[stop:]


def main() -> int:
    path = ROOT / "README.md"
    text = path.read_text(encoding="utf-8")
    wanted = replaced(text, section())
    if "--check" in sys.argv[1:]:
        return int(text != wanted)
    path.write_text(wanted, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
