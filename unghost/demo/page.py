"""The demo's page: one HTML file with its pictures inside, no script from elsewhere."""

from __future__ import annotations

import base64
import html
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..core.metrics import get_metric
from .run import SCORES

STYLE = """
:root { color-scheme: light; --ink: #23252b; --soft: #6b6d75; --line: #ddd6cb; --accent: #d9720b; }
* { box-sizing: border-box; }
body { margin: 0; background: #f6f4f0; color: var(--ink); font: 17px/1.55 system-ui, sans-serif; }
main { max-width: 940px; margin: 0 auto; padding: 48px 20px 80px; }
h1 { font-size: 40px; line-height: 1.1; margin: 0 0 8px; letter-spacing: -.02em; }
h2 { font-size: 22px; margin: 56px 0 12px; }
p { max-width: 66ch; } .soft, figcaption { color: var(--soft); font-size: 15px; }
.facts { display: flex; flex-wrap: wrap; gap: 12px 44px; margin: 28px 0; }
.facts b { display: block; font-size: 34px; letter-spacing: -.02em; }
.facts span { color: var(--soft); font-size: 15px; }
figure { margin: 0; } img { display: block; width: 100%; border-radius: 6px; }
.wipe { position: relative; border: 1px solid var(--line); border-radius: 8px; overflow: hidden; }
.wipe img { border-radius: 0; }
.wipe .top { position: absolute; inset: 0; clip-path: inset(0 calc(100% - var(--at, 50%)) 0 0); }
.wipe .bar { position: absolute; top: 0; bottom: 0; left: var(--at, 50%); width: 2px; background: var(--accent); }
.wipe input { position: absolute; inset: 0; width: 100%; height: 100%; margin: 0; opacity: 0; cursor: ew-resize; }
.wipe input:focus-visible ~ .bar { width: 4px; }
.wipe em { position: absolute; top: 12px; font-style: normal; font-size: 14px; background: #fffc; padding: 1px 9px;
  border-radius: 9px; pointer-events: none; }
.pair { display: grid; grid-template-columns: 1fr 1fr; gap: 16px; }
@media (max-width: 640px) { .pair { grid-template-columns: 1fr; } }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; font-size: 15px; }
th, td { text-align: right; padding: 7px 8px; border-bottom: 1px solid var(--line); }
th:first-child, td:first-child { text-align: left; }
.key i { display: inline-block; width: 12px; height: 12px; border-radius: 3px; margin: 0 6px 0 14px; }
code { background: #ece7de; padding: 1px 5px; border-radius: 4px; }
"""
NAMES = {"clean": "unghost clean", "components": "largest component"}
COLUMNS = {key: get_metric(key).label for key in SCORES} | {"iou": "IoU after"}


def _image(png: bytes, alt: str) -> str:
    data = base64.b64encode(png).decode("ascii")
    return f'<img alt="{html.escape(alt)}" src="data:image/png;base64,{data}">'


def _number(value: float | None, *, digits: int = 3) -> str:
    return "–" if value is None else f"{value:.{digits}f}"


def _percent(value: float | None) -> str:
    return "–" if value is None else f"{100 * value:.1f} %"


def _table(heads: list[str], rows: list[list[str]]) -> str:
    top = "".join(f"<th>{html.escape(head)}</th>" for head in heads)
    body = "".join("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f"<table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table>"


def _wipe(before: bytes, after: bytes) -> str:
    return (
        '<div class="wipe">'
        + _image(after, "The room after cleaning")
        + '<div class="top">'
        + _image(before, "The same room full of ghosts")
        + "</div>"
        + '<input type="range" min="0" max="100" value="50" aria-label="Before and after" '
        "oninput=\"this.parentNode.style.setProperty('--at', this.value + '%')\">"
        + '<div class="bar"></div><em style="left:12px">before</em><em style="right:12px">after</em></div>'
    )


def page_text(results: Mapping[str, Any], pictures: Mapping[str, bytes]) -> str:
    """The whole page for the results and pictures of one demo run; its first row is the headline."""
    rows = list(results["rows"])
    first = rows[0]
    kinds = list(first["recall_by_kind"])
    scores = [[NAMES.get(row["method"], row["method"]), *(_number(row[key]) for key in COLUMNS)] for row in rows]
    by_kind = [
        [NAMES.get(row["method"], row["method"]), *(_percent(row["recall_by_kind"][kind]) for kind in kinds)]
        for row in rows
    ]
    others = "".join(
        f"<figure>{_image(pictures['after_' + row['method']], NAMES.get(row['method'], row['method']))}"
        f"<figcaption>{html.escape(NAMES.get(row['method'], row['method']))}</figcaption></figure>"
        for row in rows
    )
    machine = results["machine"]
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>unghost · the demo room</title><style>{STYLE}</style></head><body><main>
<h1>A room, and its ghosts</h1>
<p>A radiance field that saw too little fills empty air with density that is not there. This room is synthetic, so
every ghost in it is known. A small network that has learned what local geometry looks like was asked which of the
density to keep. It was told nothing of this room.</p>
<div class="facts">
<div><b>{_percent(first["floater_recall"])}</b><span>of the ghost cells removed</span></div>
<div><b>{_percent(first["surface_kept"])}</b><span>of the true surface kept</span></div>
<div><b>{_number(first["iou_before"], digits=2)} → {_number(first["iou"], digits=2)}</b>
<span>IoU with the truth</span></div>
<div><b>{_number(first["seconds"], digits=1)} s</b><span>on {machine["cores"]} CPU cores</span></div>
</div>
<figure>{_wipe(pictures["before"], pictures["after_" + first["method"]])}
<figcaption>Drag across the picture.</figcaption></figure>
<h2>What was decided</h2>
<figure>{_image(pictures["removed"], "Ghosts removed, ghosts left and surface lost, in colour")}
<figcaption class="key"><i style="background:#fa8c1f"></i>ghost, removed<i style="background:#80339e"></i>ghost, left
<i style="background:#d90d1a"></i>true surface, lost</figcaption></figure>
<h2>Beside the usual remedy</h2>
<p>Keeping only the largest connected piece is what most people do today. It cannot touch a ghost that touches
anything.</p>
<div class="pair">{others}</div>
<h2>Cut open</h2>
<figure>{_image(pictures["sections"], "Two cross-sections of the room before, after and in truth")}
<figcaption>Surfaces black, ghosts violet, lost surface red; the darker, the more opaque.</figcaption></figure>
<h2>In numbers</h2>
{_table(["", *COLUMNS.values()], scores)}
<h2>Ghosts removed, by kind</h2>
{_table(["", *kinds], by_kind)}
<p class="soft">Detached: blobs that hang free. Touching: blobs on a surface. Fog: wide, without an edge. Faint: opacity
under .3 per cell. Streak: drawn out towards a camera. Shares are of cells with an opacity above .1;
<code>{html.escape(str(results["command"]))}</code>, commit {html.escape(str(results["commit"]))}. The numbers are in
<code>result.json</code> beside this page.</p>
</main></body></html>
"""


def write_page(path: str | Path, results: Mapping[str, Any], pictures: Mapping[str, bytes]) -> None:
    """Write the page atomically; see :func:`page_text`."""
    target = Path(path)
    partial = target.with_name(target.name + ".partial")
    partial.write_text(page_text(results, pictures), encoding="utf-8")
    os.replace(partial, target)
