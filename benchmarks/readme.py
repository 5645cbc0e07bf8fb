"""The README's results: every number in that section is read from ``docs/results`` and from nowhere else.

python benchmarks/readme.py           writes the section anew
python benchmarks/readme.py --check   exit status 1 if it is not what the results say
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
BEGIN, END = "<!-- results: written by benchmarks/readme.py -->", "<!-- end of results -->"
Row = dict[str, Any]


def load(name: str, root: Path = ROOT) -> dict[str, Any]:
    loaded: dict[str, Any] = json.loads((root / "docs" / "results" / f"{name}.json").read_text(encoding="utf-8"))
    return loaded


def number(value: float | None, digits: int = 3) -> str:
    return "–" if value is None else f"{value:.{digits}f}"


def table(header: Iterable[str], rows: Iterable[Iterable[str]]) -> list[str]:
    head = list(header)
    return [f"| {' | '.join(cells)} |" for cells in (head, ["---"] * len(head), *rows)]


def demo(results: dict[str, Any]) -> list[str]:
    keys = ("floater_recall", "floater_precision", "surface_kept", "iou_before", "iou")
    rows = [[row["method"], *(number(row[key]) for key in keys), number(row["seconds"], 1)] for row in results["rows"]]
    head = ("method", "ghosts removed", "of what was removed, ghosts", "surface kept", "IoU before", "after", "seconds")
    said = "The prior's removal threshold was chosen on other rooms of this kind (`benchmarks/threshold.py`)."
    return ["**The demo's room** (`make demo`; every ghost labelled):", "", *table(head, rows), "", said]


def denoise(results: dict[str, Any]) -> list[str]:
    rows = results["rows"]
    found = {(row["method"], row["set"], row.get("severity")): row for row in rows}
    ours = [row for row in rows if row["method"] == "unghost" and row["set"] in ("clean", "synthetic")]
    lines = []
    for row in ours:
        rival = found["components+closing", row["set"], row.get("severity")]
        label = f"corrupted, severity {row['severity']}" if "severity" in row else "untouched"
        lines.append([label, *(number(value) for value in (row["iou_before"], rival["iou"], row["iou"]))])
    text = [
        "**Cubes of meshes that were never trained on**, one step at the default timestep (mean IoU with the truth):"
    ]
    text += ["", *table(("cubes", "as they come", "components + closing", "unghost"), lines), ""]
    harvest = found.get(("unghost", "harvest", None))
    if harvest:
        text += [
            f"**Cubes of badly constrained fields** of {harvest['scenes']} held-out scenes: ghost voxels removed while "
            ".98 / .95 / .90 of the true ones stay, the threshold set for each scene by itself, mean over scenes: "
            + " / ".join(number(harvest[f"ghosts_removed_{k}"], 2) for k in (98, 95, 90))
            + " (thresholding the opacity: "
            + " / ".join(number(harvest[f"ghosts_removed_{k}_opacity"], 2) for k in (98, 95, 90))
            + "). With one threshold for all scenes far fewer go: the model card.", "",
        ]  # fmt: skip
    speed = found["unghost", "speed", None]
    text += [
        f"**Speed**: {speed['cubes_per_second']:.0f} cubes/s through onnxruntime (fp32, batch {speed['batch']}, "
        f"{speed['threads']} threads)."
    ]
    return text


def capture(results: dict[str, Any]) -> list[str]:
    names = {"field": "(a) fine-tuned alone", "visibility": "(b) + visibility", "dsds": "(c) + visibility + DSDS"}
    keys = (("psnr", 2), ("psnr_common", 2), ("ssim", 3), ("disparity_mae", 3), ("normal_mean_deg", 1), ("coverage", 3))
    rows = [[names[row["method"]], *(number(row[key], digits) for key, digits in keys)] for row in results["rows"]]
    head = ("", "PSNR (own mask)", "PSNR (common mask)", "SSIM", "disparity error", "normals, mean °", "coverage")
    seeds = len(results["seeds"])
    return [
        f"**A real capture** ({results['capture']}: trained on one sweep of phone photos, scored on another; the "
        f"paper's masks, depth limit {results['depth_limit']:.2f}, {seeds} seed(s)):", "",
        *table(head, rows), "", verdict({row["method"]: row for row in results["rows"]}), "",
        "![photo, (a), (b), (c), colour and depth](docs/results/capture.png)",
    ]  # fmt: skip


def verdict(rows: dict[str, Row]) -> str:
    """What the capture's table says, in a sentence."""
    gain = rows["dsds"]["psnr"] - rows["visibility"]["psnr"]
    if gain > 0:
        return f"DSDS adds {gain:.2f} dB to visibility alone."
    return (
        f"Here DSDS still **loses** {-gain:.2f} dB to visibility alone: it takes the fog off, and with it true "
        "surfaces that the field holds only faintly (the bed, the walls)."
    )


def curate(results: dict[str, Any]) -> list[str]:
    rows = [
        [row["method"], f"{row['cubes_per_second']:.0f}", number(row["milliseconds"], 2), number(row["iou"])]
        for row in results["rows"]
        if "sweep" not in row
    ]
    head = ("cubes", "a second", "processor ms a cube", "IoU with ours")
    return [
        "**Making cubes** (two processes; mesh rows: a bumpy ball of 70,000 faces, from choosing where the cube lies "
        "to its packed bits, no corruption):", "",
        *table(head, rows),
    ]  # fmt: skip


SECTIONS = {"demo": demo, "denoise": denoise, "capture": capture, "curate": curate}


def section(root: Path = ROOT) -> str:
    """The whole section, markers included."""
    lines = [BEGIN, ""]
    for name, write in SECTIONS.items():
        if (root / "docs" / "results" / f"{name}.json").exists():
            results = load(name, root)
            lines += [*write(results), "", f"<sub>`{results['command']}` → docs/results/{name}.json</sub>", ""]
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
