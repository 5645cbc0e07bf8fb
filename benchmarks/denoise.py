"""How well, and how fast, one denoising step restores cubes that the prior has not seen.

    python benchmarks/denoise.py --meshes ../shared/data/meshes --harvest out/harvest-val

Sets: ``synthetic`` (bits: cubes of meshes of the ``test`` split, corrupted), ``synthetic-soft`` (the same as soft
opacities), ``clean`` (the same, untouched) and, if a folder is given, ``harvest`` (cubes of fields fitted to scenes
that were not trained on). Methods: the input as it is, classical clean-up of the bits (small components removed,
then a closing), and the prior. Cubes without any surface are left out: both would score 1 for nothing.
Writes ``denoise.json``. IoU: opacity > 0.1 before, x0_pred > 0 after, ignored voxels left out.
"""

from __future__ import annotations

import dataclasses
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from numpy.typing import NDArray
from scipy import ndimage

from unghost import load_denoiser
from unghost.bench import measure_speed
from unghost.core.manifest import Manifest
from unghost.core.occupancy import DEFAULT_OPACITY_THRESHOLD, opacity_from_signed, signed_from_occupancy
from unghost.core.results import build_results, write_results
from unghost.core.shards import read_shard, unpack_labels, write_shard
from unghost.data_recipes.curate import curate
from unghost.data_recipes.recipe import load_recipe
from unghost.prior.evaluate import evaluate

ROOT = Path(__file__).resolve().parents[1]
BANDS = ((0.0, 0.25), (0.25, 0.5), (0.5, 0.75), (0.75, 1.0))
SEED = 77


@dataclass(frozen=True)
class Options:
    """What to measure.

    Attributes:
        meshes: folder of meshes with a manifest.csv.
        harvest: folder of harvested shards of scenes that were not trained on.
        cubes: per row.
        threads: of onnxruntime, for the speed.
        denoiser: a shipped name or a file.
        out: where denoise.json goes.
    """

    meshes: Path
    harvest: Path | None = None
    cubes: int = 400
    threads: int = 2
    denoiser: str = "default"
    out: Path = ROOT / "docs" / "results"


class Classical:
    """Bits in, bits out; the same interface as a denoiser."""

    kind = "numpy"

    def __init__(self, name: str) -> None:
        self.manifest = Manifest(name)

    def __call__(self, channels: Any, timestep: Any, edge_fraction: Any) -> NDArray[np.float32]:
        """See ``core.manifest.Denoiser``."""
        occupied = opacity_from_signed(channels[:, 0]) > DEFAULT_OPACITY_THRESHOLD
        if self.manifest.name != "input":
            occupied = np.stack([components_and_closing(cube) for cube in occupied])
        return signed_from_occupancy(occupied)[:, None]


def components_and_closing(occupied: NDArray[np.bool_], *, smallest: int = 64) -> NDArray[np.bool_]:
    labels, count = ndimage.label(occupied, structure=np.ones((3, 3, 3)))
    large = np.bincount(labels.ravel(), minlength=count + 1) >= smallest
    large[0] = False
    kept = np.pad(large[labels], 2, mode="edge")
    return ndimage.binary_closing(kept)[2:-2, 2:-2, 2:-2] | large[labels]


def with_surface(folder: Path, target: Path, count: int) -> Path:
    """A shard of the first ``count`` cubes of a shard whose labels hold any surface."""
    shard = read_shard(folder)
    chosen = [i for i in range(len(shard)) if (unpack_labels(shard.labels[i : i + 1]) == 1).any()][:count]
    names = ("inputs", "labels", "severity", "edge_fraction", "group")
    write_shard(target, {name: np.array(getattr(shard, name)[chosen]) for name in names}, shard.provenance)
    return target


def mesh_sets(options: Options, folder: Path) -> list[tuple[str, Path]]:
    base = dataclasses.replace(
        load_recipe("meshes"), split="test", licences=("CC0-1.0", "MIT-0", "CC-BY-3.0"), empty_share=0.0,
        on_share=0.8, near_share=0.2, cubes_per_mesh=4,
    )  # fmt: skip
    wanted = [("clean", {"clean_share": 1.0})]
    for kind, soft in (("synthetic", 0.0), ("synthetic-soft", 1.0)):
        wanted += [(kind, {"clean_share": 0.0, "soft_share": soft, "severity": band}) for band in BANDS]
    found = []
    for number, (kind, changes) in enumerate(wanted):
        raw = curate(
            dataclasses.replace(base, **changes), folder / f"raw-{number}",
            count=round(1.3 * options.cubes), seed=SEED, mesh_root=options.meshes,
        )  # fmt: skip
        band = changes.get("severity")
        name = f"{kind} {band[0]:g}-{band[1]:g}" if band else kind
        found.append((name, with_surface(raw[0], folder / f"set-{number}", options.cubes)))
    return found


def rows_of(denoiser: Any, name: str, sets: list[tuple[str, Path]], options: Options) -> list[dict[str, Any]]:
    rows = []
    for label, path in sets:
        kind, _, band = label.partition(" ")
        scores = evaluate(denoiser, read_shard(path))
        keys = ("cubes", "timestep", "iou_before", "iou", "ghosts_removed_98", "ghosts_removed_98_opacity")
        row: dict[str, Any] = {"method": name, "set": kind, **({"severity": band} if band else {})}
        rows.append(row | {key: scores[key] for key in keys})
    if options.harvest is not None:
        rows.append(harvest_row(denoiser, name, options.harvest))
    return rows


def harvest_row(denoiser: Any, name: str, folder: Path) -> dict[str, Any]:
    """Means over the shards (one a scene) of a harvest."""
    scores = [evaluate(denoiser, read_shard(path)) for path in sorted(folder.glob("scene-*"))]
    keys = ("iou_before", "iou", *(f"ghosts_removed_{k}{tail}" for k in (98, 95, 90) for tail in ("", "_opacity")))
    means = {key: float(np.mean([s[key] for s in scores if s[key] is not None])) for key in keys}
    return {"method": name, "set": "harvest", "scenes": len(scores), "cubes": sum(s["cubes"] for s in scores), **means}


def main() -> None:
    options = tyro.cli(Options, description=__doc__)
    prior = load_denoiser(options.denoiser, threads=options.threads)
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as temporary:
        sets = mesh_sets(options, Path(temporary))
        for name, denoiser in (("input", Classical("input")), ("components+closing", Classical("components+closing"))):
            rows += rows_of(denoiser, name, sets, options)
        rows += rows_of(prior, "unghost", sets, options)
    speed = measure_speed(prior, batch=40, seconds=8.0)
    rows.append({"method": "unghost", "set": "speed", "threads": options.threads, **speed})
    command = f"python benchmarks/denoise.py --meshes {options.meshes.name} --cubes {options.cubes}" + (
        f" --harvest {options.harvest.name}" if options.harvest else ""
    )
    write_results(
        options.out / "denoise.json",
        build_results(rows, command=command, seeds=[SEED], prior=prior.manifest.body_sha256),
    )
    for row in rows:
        text = " ".join(f"{k}={v:.3f}" if isinstance(v, float) else f"{k}={v}" for k, v in row.items())
        print(text)


if __name__ == "__main__":
    main()
