"""The model cards of the shipped priors, NAME.md beside the weights: scores and settings from their manifests and
``docs/results``. What is said of the data (``DATA``) and the limits is typed by hand.

python -m benchmarks.release.model_cards
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from unghost.core.channels import SUPPORT, VIEW_COUNT
from unghost.core.manifest import Manifest
from unghost.core.metrics import format_value
from unghost.export.container import precision_of
from unghost.export.runtime import read_manifest
from unghost.prior.networks.restoration import SIZES, RestorationNet, parameter_count

from .readme import ROOT, load, table

WEIGHTS = ROOT / "unghost" / "weights"
CALLED = {"default": "unghost"}  # in the reference measurement
DATA = """unghost curate procedural --out out/procedural --n 64000 --seed 0 --workers 2
unghost curate meshes --out out/meshes --n 40000 --seed 0 --workers 2 --mesh-root MESHES
unghost harvest --out out/rooms --scenes 80 --first 4 --seed 1000 --cubes 112 --no-fit --workers 2 --mesh-root MESHES
unghost harvest --out out/harvest-train --scenes 128 --seed 0 --workers 2 --mesh-root MESHES"""
EVIDENCE_DATA = """unghost curate procedural --out out/procedural --n 16000 --seed 0
unghost curate meshes --out out/meshes --n 24000 --seed 0 --mesh-root MESHES
unghost harvest --out out/rooms --scenes 40 --first 4 --seed 1000 --cubes 112 --no-fit --mesh-root MESHES
unghost harvest --out out/rooms2 --scenes 28 --first 4 --seed 1000 --cubes 224 --no-fit --room-pitch .012 .06 \\
  --mesh-root MESHES
unghost harvest --out out/train2 --scenes 47 --seed 0 --workers 2 --mesh-root MESHES"""
EVIDENCE = (
    " Of each voxel it also takes sparse points near it (`support`), sight lines through it, from cameras to points "
    "that they observed (`crossings`), and how many training photos have it in their frustum (`view_count`). Each may "
    "be left unknown. Its last layer is calibrated on harvested scenes that were not trained on: `(x0_pred + 1) / 2` "
    "is the probability that an opaque voxel is surface."
)
EVIDENCE_LIMITS = (
    " Sparse points were simulated in training; the last layer and the threshold were fitted to scenes 128 to 135 of "
    "the harvest's seed with other points (`benchmarks.denoise.point_sets`). At this threshold it removes fewer ghosts "
    "of the labelled rooms than `default` at its own (docs/results/threshold_evidence.json), so that it is never "
    "chosen by itself. The reference measurement does not have it yet."
)
LICENCES = (
    "Procedural solids, synthetic rooms and harvested fields are made by this project; the meshes are CC0-1.0 and "
    "MIT-0 only (KayKit, Quaternius, Kenney, AWS RoboMaker worlds), `train` split; none is in this repository. Scenes "
    "whose fit failed are given up by `unghost harvest`. Runs at commit `e3fec21538ce` learned from procedural and "
    "mesh cubes curated at that commit, later ones from cubes of the recipes as they are now (soft ones have changed)."
)
ABOUT = (
    "A restoration prior: reads one 32³ cube of signed opacity (−1 empty … +1 opaque; bits are a special case) and "
    "says in one step which voxels are surface (`x0_pred`, −1 … +1). `timestep / 999` is the most corruption to "
    "expect; from 800 on: any amount."
)
VIEWS = (
    " Of each voxel it also takes how many training photos have it in their frustum (`view_count`), which may be left "
    "unknown."
)
LIMITS = (
    "Harvested were dense grids and hash grids fitted to synthetic rooms, few photos each; on a real capture's field "
    "the scores fall off, and without view counts on every kind of field. Surfaces thinner than a voxel may go. The "
    "set `capture` is a real capture that was not trained on, but has been looked at while the method was made."
)
SEEN_GHOSTS = (
    " Told of cameras that see every ghost, it removes fewer of them and more of the surface than told nothing "
    "(docs/results/cleaning.json): it knows fog where nobody looked."
)


def models() -> list[tuple[str, Path, Manifest]]:
    """Name, ONNX file and manifest of every shipped model."""
    return [(path.stem, path, read_manifest(path)) for path in sorted(WEIGHTS.glob("*.onnx"))]


def size_of(manifest: Manifest) -> str:
    """The size among ``SIZES`` with as many parameters."""
    for name, config in SIZES.items():
        if parameter_count(RestorationNet(dataclasses.replace(config, channels=manifest.channels))) == (
            manifest.parameters
        ):
            return name
    return "custom"


def sources(shards: Iterable[dict[str, Any]]) -> list[list[str]]:
    """Shards, cubes and share of the stream by folder."""
    found = list(shards)
    whole = sum(entry["weight"] for entry in found)
    return [[e["source"], f"{e['shards']}", f"{e['cubes']}", f"{e['weight'] / whole:.2f}"] for e in found]


def stages(training: dict[str, Any]) -> list[dict[str, Any]]:
    """The runs that led to a model, the first one first."""
    earlier = training.get("started_from")
    return [*(stages(earlier) if earlier else []), training]


def run_folder(manifest: Manifest, number: int) -> str:
    """Where the commands put stage ``number``."""
    return f"out/{manifest.name}" + (f"-{number}" if number < len(stages(manifest.training)) - 1 else "")


def train_commands(manifest: Manifest) -> list[str]:
    """What trained it, up to the folders' places; a command a stage."""
    commands = []
    every = stages(manifest.training)
    for index, stage in enumerate(every):
        shards = " ".join(f"out/{source}={share}" for source, _, _, share in sources(stage["shards"]))
        later = [
            *every[index:],
            {"channels": manifest.channels},
        ]  # an early run's record lacks what its successor's has
        dropped, channels = (next(s[key] for s in later if key in s) for key in ("drop_channels", "channels"))
        seen = f" --channels {' '.join(channels)} --drop-channels {dropped:g}" if len(channels) > 1 else ""
        online = "".join(f" --online {part['name']}={part['share']:g}" for part in stage.get("online", []))
        start = f" --init-from {run_folder(manifest, index - 1)}/model.safetensors" if index else ""
        commands.append(
            f"unghost train {shards} \\\n  --out {run_folder(manifest, index)} --size {size_of(manifest)} --steps "
            f"{stage['steps']} --batch-size {stage['batch_size']} --learning-rate {stage['learning_rate']:g} "
            f"\\\n  --seed {stage['seed']} --name {manifest.name}{seen}{online}{start} --threads 2"
        )
    return commands


def told(stage: dict[str, Any]) -> str:
    """A stage in words."""
    return (
        f"{stage['steps']} steps of {stage['batch_size']} cubes ({stage['seconds'] / 60:.0f} minutes, seed "
        f"{stage['seed']}, commit `{stage['commit']}`)"
    )


def section(name: str, path: Path, manifest: Manifest) -> list[str]:
    """The card of one model."""
    training, chosen = manifest.training, load(f"threshold_{name}")
    files = [
        [file.name, f"{file.stat().st_size / 1e6:.2f} MB", f"`{hashlib.sha256(file.read_bytes()).hexdigest()}`"]
        for file in (path, path.with_suffix(".safetensors"))
    ]
    folder = run_folder(manifest, len(stages(training)) - 1)
    command = chosen["command"].replace("release.ship ", f"release.ship {folder}/")
    harvested = ", and .97 of harvested surface" if "calibration" in training else ""
    half = " Its weights are stored in half precision." if precision_of(manifest) == "fp16" else ""
    return [
        f"`{manifest.name}`, size {size_of(manifest).upper()}: {manifest.parameters} parameters, "
        f"{training['gflop']:.2f} GFLOP a cube. It sees {', '.join(manifest.channels)}.{half} Default timestep "
        f"{manifest.default_timestep}; removal threshold {manifest.removal_threshold:.2f}, for `clean`: the largest of "
        f"those tried at which it keeps {chosen['kept']:g} of the surface of rooms made for that{harvested} "
        f"(docs/results/threshold_{name}.json). Score distillation has thresholds of its own "
        "(docs/regularizer.md).",
        "",
        *table(("file", "size", "sha256"), files),
        "",
        f"From random weights: {' and then '.join(map(told, stages(training)))}, on two CPU cores "
        f"({training['precision']}), torch {training['torch']}. In harvested cubes, voxels that are opaque and true "
        f"surface weigh {training['keep_weight']:g} times.",
        "",
        *table(("source", "shards", "cubes", "share of the stream"), sources(training["shards"])),
        "",
        "```",
        *train_commands(manifest),
        command,
        "```",
        "",
        *scores(name),
    ]


def scores(name: str) -> list[str]:
    """The rows of the reference measurement about a model."""
    called = CALLED.get(name, name)
    rows = [
        [
            row["method"].removeprefix(called).removeprefix(", ") or "–",
            row["set"],
            str(row.get("severity", row.get("family", "–"))),
            str(row["cubes"]),
            *(format_value(row[k], k) for k in ("iou_before", "iou", "ghosts_removed_98", "ghosts_removed_90")),
        ]
        for row in load("denoise")["rows"]
        if row.get("model") == called and "cubes" in row and row.get("family", "mixed") in ("mixed", "bits", "soft")
    ]
    head = ("told", "set", "severity", "cubes", "IoU before", "after", "ghosts removed at .98 kept", "at .90")
    return [*table(head, rows), ""] if rows else []


def card(name: str, path: Path, manifest: Manifest) -> str:
    lines = [
        f"# {name}",
        "",
        ABOUT + (EVIDENCE if SUPPORT in manifest.channels else VIEWS if VIEW_COUNT in manifest.channels else ""),
        "",
        *section(name, path, manifest),
        "## The data",
        "",
        "```",
        EVIDENCE_DATA if SUPPORT in manifest.channels else DATA,
        "```",
        "",
        LICENCES,
        "",
        "Scores above are of the reference measurement (`benchmarks/denoise/run.py`, docs/results/denoise.json), "
        "on what "
        "was not trained on: cubes of meshes of the `test` split, of fields fitted to scenes 128 to 139 of the "
        "harvest's seed (129 and 134 were watched while it trained; nothing was chosen by them), of MLP fields, of a "
        "real capture's field. Ghosts removed: one threshold for a set.",
        "",
        "## Limits",
        "",
        LIMITS
        + (EVIDENCE_LIMITS if SUPPORT in manifest.channels else SEEN_GHOSTS if VIEW_COUNT in manifest.channels else ""),
        "",
    ]
    return "\n".join(lines)


def main() -> None:
    for name, path, manifest in models():
        (WEIGHTS / f"{name.upper()}.md").write_text(card(name, path, manifest), encoding="utf-8")


if __name__ == "__main__":
    main()
