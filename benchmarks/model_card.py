"""The model card of the shipped prior, from its manifest and ``docs/results``: no number is typed by hand.

python benchmarks/model_card.py
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from typing import Any

from readme import ROOT, load, number, table

from unghost.export.runtime import read_manifest

WEIGHTS = ROOT / "unghost" / "weights"
COMMANDS = """git show {start}:unghost/weights/default.safetensors > out/first.safetensors
unghost curate procedural --out out/procedural --count {procedural} --seed 0 --workers 2
unghost curate meshes --out out/meshes --count {meshes} --seed 0 --workers 2 --mesh-root MESHES
unghost harvest --out out/rooms --scenes 60 --first 4 --seed 1000 --cubes 112 --no-fit --workers 2
unghost harvest --out out/harvest --scenes {scenes} --first 6 --seed 0 --workers 2
unghost train out/procedural=.27 out/meshes=.25 out/rooms=.13 out/harvest=.35 --out out/second --seed 1 \\
  --init-from out/first.safetensors --max-seconds 3900 --batch-size 48 --learning-rate 1.2e-3 --threads 2
unghost train out/procedural=.33 out/meshes=.32 out/rooms=.15 out/harvest=.20 --out out/third --seed {seed} \\
  --init-from SECOND --max-seconds {seconds:.0f} --batch-size {batch_size} --learning-rate {learning_rate:g} \\
  --threads 2 --threshold-from {threshold_from} --name unghost-m
python benchmarks/threshold.py out/third/model.safetensors"""
DATA = "e1cedc8"  # the commit whose recipes and harvest made the data, and whose code trained
START = "ca135c4"  # the commit whose weights the shipped run started from


def sources(shards: Iterable[dict[str, Any]]) -> list[list[str]]:
    """Weight and cubes by folder: harvested shards are one a scene, curated ones are numbered."""
    total: dict[str, list[float]] = {}
    for shard in shards:
        entry = total.setdefault(shard["source"], [0, 0, 0.0])
        entry[0] += shard.get("shards", 1)
        entry[1], entry[2] = entry[1] + shard["cubes"], entry[2] + shard["weight"]
    whole = sum(entry[2] for entry in total.values())
    return [[name, f"{n}", f"{cubes}", f"{weight / whole:.2f}"] for name, (n, cubes, weight) in total.items()]


def history(training: dict[str, Any]) -> list[str]:
    """How long, from what weights, and what was looked at."""
    second = training["started_from"]
    first = second["started_from"]
    return [
        f"{training['steps']} steps of {training['batch_size']} cubes, {training['seconds'] / 60:.0f} minutes on two "
        f"CPU cores ({training['precision']}), seed {training['seed']}, commit `{training['commit']}`, torch "
        f"{training['torch']}. It started from the averaged weights of a run of {second['seconds'] / 60:.0f} minutes "
        f"({second['steps']} steps; stopped before its time and taken out of its state file by hand: it had begun to "
        f"know the harvested scenes by heart), and that one from an earlier model of ours: {first['steps']} steps, "
        f"{first['seconds'] / 60:.0f} minutes, sha256 `{first['sha256']}` (its card: `git show "
        f"{START}:unghost/weights/MODEL_CARD.md`).", "",
        f"In harvested cubes, voxels that are opaque and true surface weigh {training['keep_weight']:g} times: a score "
        f"of 0 then means ghost at {training['keep_weight']:g} : 1. The set `capture` (cubes of a field fitted to "
        "trajectory_1 of a real capture, labelled by one fitted to trajectories 1 and 2) was not trained on, but "
        "looked at: it showed that labels had to count what lies behind a surface, and was watched when the second "
        "run was stopped.", "",
    ]  # fmt: skip


def card() -> str:
    manifest = read_manifest(WEIGHTS / "default.onnx")
    training = manifest.training
    harvested = [shard["name"] for shard in training["shards"] if shard["source"] == "harvest"]
    counts = {name: int(cubes) for name, _, cubes, _ in sources(training["shards"])}
    command = COMMANDS.format(
        start=START, scenes=int(max(harvested).removeprefix("scene-")) - 5, **{**training, **counts}
    )  # fmt: skip
    files = [
        [path.name, f"{path.stat().st_size / 1e6:.2f} MB", f"`{hashlib.sha256(path.read_bytes()).hexdigest()}`"]
        for path in sorted(WEIGHTS.glob("default.*"))
    ]
    scores = [
        [name, str(row["cubes"]), *(number(row[k]) for k in ("iou_before", "iou", "iou_clean", "ghosts_removed_98"))]
        for name, row in training["validation"].items()
    ]
    head = ("held-out set", "cubes", "IoU before", "IoU after", "IoU on clean input", "ghosts removed at .98 kept")
    meshes = [
        [row["set"], str(row.get("severity", "–")), str(row["cubes"]), number(row["iou_before"]), number(row["iou"]),
         number(row["ghosts_removed_98"])]
        for row in load("denoise")["rows"]
        if row["method"] == "unghost" and "cubes" in row and row.get("family", "mixed") == "mixed" and "iou" in row
    ]  # fmt: skip
    lines = [
        f"# {manifest.name}", "",
        "A restoration prior: reads one 32³ cube of signed opacity (−1 empty … +1 opaque; bits are a special case), "
        "says in one step which voxels are surface (`x0_pred`, −1 … +1). `timestep / 999` is the most corruption to "
        f"expect; from 800 on: any amount. The default is {manifest.default_timestep}.", "",
        *table(("file", "size", "sha256"), files), "",
        f"{manifest.parameters} parameters, {training['gflop']:.2f} GFLOP a cube. Removal threshold "
        f"{manifest.removal_threshold:.2f}, for `clean`: the largest at which it keeps .985 of the surface of four "
        "rooms made for that (`benchmarks/threshold.py`, docs/results/threshold.json). The default timestep was chosen "
        "for the first model with an eye on the demo's room. DSDS decides at 0 unless told otherwise.", "",
        "## Training", "",
        *history(training),
        *table(("source", "shards", "cubes", "share of the stream"), sources(training["shards"])), "",
        "```",
        command,
        "```", "",
        f"Run these at commit {DATA} (later ones draw other solids and other kinds of field); the second training ran "
        "without the jitter of the optical depth, at the commit before. Scenes whose "
        "fit failed are given up by `unghost harvest`. The time budget makes the weights depend "
        "on the machine's speed; the data do not. Licences: procedural "
        "solids, synthetic rooms and harvested fields are made by this project; the meshes are CC0-1.0 and MIT-0 "
        "only (KayKit, Quaternius, Kenney, AWS RoboMaker worlds), `train` split; none is in this repository.", "",
        "## Scores on what it has not seen", "",
        "Ghosts removed: one threshold for all cubes of a set.", "",
        *table(head, scores), "",
        "The reference measurement (`benchmarks/denoise.py`, docs/results/denoise.json): cubes of meshes of the `test` "
        "split under mixed corruption, of fields fitted to scenes held out, of a real capture's field. The last two "
        "are labelled by rules that are younger than this model (`data_recipes/harvest_labels.py`):", "",
        *table(("set", "severity", "cubes", "IoU before", "IoU after", "ghosts removed at .98 kept"), meshes), "",
        "## Limits", "",
        "One field type (dense trilinear grids) was harvested, from few synthetic scenes. Of the ghosts in such "
        "fields most stay when nearly all of the true surface must: the cube's opacity alone does not tell them apart. "
        "Surfaces thinner than a voxel may go.", "",
    ]  # fmt: skip
    return "\n".join(lines)


def main() -> None:
    (WEIGHTS / "MODEL_CARD.md").write_text(card(), encoding="utf-8")


if __name__ == "__main__":
    main()
