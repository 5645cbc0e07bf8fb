"""Show what a harvest is: a page with pictures, the statistics beside a real capture's, and a small sample.

    python -m benchmarks.data.harvest_page out/harvest --seconds S --scenes N

Writes docs/harvest.md and docs/harvest/pairs.png, and docs/harvest/sample: a shard of a few cubes of scenes
without meshes (so that all of it is generated), for a look and for tests. Run benchmarks/data/harvest_statistics.py
and benchmarks/data/point_statistics.py first.
"""

from __future__ import annotations

import json
import shutil
from collections import Counter
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from numpy.typing import NDArray

from unghost.core.occupancy import FREE_LABEL, SURFACE_LABEL, opacity_from_signed
from unghost.core.shards.finding import find_shards
from unghost.core.shards.packing import dequantize_signed, unpack_labels
from unghost.core.shards.storage import ARRAYS, Shard, read_shard, write_shard
from unghost.data_recipes.harvest.config import HarvestConfig
from unghost.data_recipes.inspection.drawing import GHOST, SURFACE, UNJUDGED
from unghost.data_recipes.inspection.preview import draw_pair

from ..options import HARVEST, NOT_GIVEN, give_up
from ..progress import wrote

ROOT = Path(__file__).resolve().parents[2]
SAMPLE_CUBES = 8  # 82 kB each
SHOWN, WIDTH, GAP = 6, 192, 8
HEADINGS = ("what the field shows", "the truth", "a slice: opacity", "labels", "surroundings", "views (white: 24+)")
MOST_VIEWS = 24
POINT_MEASURES = {  # of docs/results/points.json, and what the page calls them
    "points": "points",
    "views": "photos that observed a point, mean",
    "views_2": "share of points of two photos",
    "views_5": "share of points of five photos or more",
    "error_p50": "reprojection error, median, pixels",
    "error_p90": "reprojection error, highest tenth, pixels",
    "angle_p10": "triangulation angle, lowest tenth, degrees",
    "angle_p50": "triangulation angle, median, degrees",
    "angle_p90": "triangulation angle, highest tenth, degrees",
    "off_pixels_p50": "distance to the surface, median, pixels",
    "off_pixels_p90": "distance to the surface, highest tenth, pixels",
    "off_sigmas_p50": "distance to the surface, median, own uncertainties",
    "off_sigmas_p90": "distance to the surface, highest tenth, own uncertainties",
    "wrong": "share of wrong points",
    "outvoted": "share of observations that the vote drops",
    "texture_ratio": "contrast at points over contrast anywhere, medians",
    "texture_rank": "probability of more contrast than a random pixel",
}


@dataclass(frozen=True)
class Options:
    """What to show.

    Attributes:
        harvest: folder of harvested shards.
        seconds: that the harvest took: the processor time of all workers over two, scaled up where only some
            scenes were timed; told in the page.
        scenes: that were asked for.
        docs: the folder that is written to.
    """

    harvest: tyro.conf.Positional[Path] = NOT_GIVEN
    seconds: float | None = None
    scenes: int = 0
    docs: Path = ROOT / "docs"


def facts(shards: list[Shard]) -> dict[str, Any]:
    """What is in a harvest."""
    told = [shard.provenance for shard in shards]
    return {
        "scenes": len(shards),
        "pairs": sum(map(len, shards)),
        "kinds": dict(sorted(Counter((p["field"], p["resolution"]) for p in told).items())),
        "with_meshes": sum(bool(p["meshes"]) for p in told),
        "meshes": len({mesh["sha256"] for p in told for mesh in p["meshes"]}),
        "licences": dict(Counter(p["licence"] for p in told)),
        "psnr": [float(q) for q in np.quantile([p["psnr"] for p in told], [0.1, 0.5, 0.9])],
    }


def generated(shards: list[Shard]) -> list[Shard]:
    """Those of scenes without meshes."""
    return [shard for shard in shards if shard.provenance["licence"] == "generated"]


def interesting(shard: Shard) -> NDArray[np.int64]:
    """Rows from the one with the best mixture of surface and ghosts to the one with the worst."""
    opaque = opacity_from_signed(dequantize_signed(np.array(shard.inputs))) > 0.1
    labels = unpack_labels(np.array(shard.labels))
    counts = [(opaque & (labels == label)).sum(axis=(1, 2, 3)) for label in (SURFACE_LABEL, FREE_LABEL)]
    return np.argsort(-np.minimum(*counts), kind="stable")


def alternating(shards: list[Shard]) -> list[Shard]:
    """Shards in turn from every kind of field, each kind in its own order."""
    kinds: dict[str, list[Shard]] = {}
    for shard in shards:
        kinds.setdefault(shard.provenance["field"], []).append(shard)
    return [shard for turn in zip_longest(*kinds.values()) for shard in turn if shard is not None]


def write_sample(shards: list[Shard], target: Path) -> int:
    """Write the best mixture of surface and ghosts of some scenes; returns how many bytes the cubes take."""
    chosen = sorted(alternating(shards)[:SAMPLE_CUBES], key=lambda shard: int(shard.provenance["scene"]))
    rows = [interesting(shard)[:1] for shard in chosen]
    names = (*ARRAYS, "surroundings", "view_count", "transmittance", "frames")
    arrays = {name: np.concatenate([getattr(s, name)[r] for s, r in zip(chosen, rows)]) for name in names}
    if target.exists():
        shutil.rmtree(target)
    provenance = {
        "recipe": "harvest",
        "licence": "generated",
        "sample_of": f"{len(shards)} scenes",
        "scenes": [{k: s.provenance[k] for k in ("seed", "scene", "field", "resolution", "steps")} for s in chosen],
    }
    write_shard(target, arrays, provenance, kind="harvest")
    return sum(path.stat().st_size for path in target.iterdir())


def _grown(slab: NDArray[Any]) -> NDArray[np.uint8]:
    """A slice ``(n, n)`` or ``(n, n, 3)`` in [0, 1] as a square picture, its second axis upwards."""
    factor = WIDTH // len(slab)
    picture = np.repeat(np.repeat(np.swapaxes(slab, 0, 1)[::-1], factor, axis=0), factor, axis=1)
    picture = np.repeat(picture[..., None], 3, axis=2) if picture.ndim == 2 else picture
    levels: NDArray[np.uint8] = (255 * np.clip(picture, 0, 1)).round().astype(np.uint8)
    return levels


def draw_row(shard: Shard, row: int) -> list[NDArray[np.uint8]]:
    """Six pictures of one pair."""
    assert shard.surroundings is not None
    assert shard.view_count is not None
    signed, labels = dequantize_signed(shard.inputs[row]), unpack_labels(shard.labels[row : row + 1])[0]
    middle, colors = signed.shape[2] // 2, np.array([GHOST, SURFACE, UNJUDGED])
    opaque = opacity_from_signed(signed)[:, :, middle]
    about = opacity_from_signed(dequantize_signed(shard.surroundings[row]))
    return [
        *draw_pair(signed, labels, width=WIDTH),
        _grown(np.sqrt(opaque)),
        _grown(colors[labels[:, :, middle]]),
        _grown(np.sqrt(about[:, :, about.shape[2] // 2])),
        _grown(np.asarray(shard.view_count[row][:, :, middle], dtype=np.float64) / MOST_VIEWS),
    ]


def draw(shards: list[Shard], path: Path) -> None:
    """Some pairs, one a row."""
    from PIL import Image, ImageDraw

    chosen = [shards[i] for i in np.linspace(0, len(shards) - 1, SHOWN).round().astype(int)]
    rows = [draw_row(shard, int(interesting(shard)[2])) for shard in chosen]
    across, top = len(HEADINGS) * (WIDTH + GAP) + GAP, 26
    sheet = Image.new("RGB", (across, top + SHOWN * (WIDTH + GAP)), "white")
    pen = ImageDraw.Draw(sheet)
    for column, heading in enumerate(HEADINGS):
        left = GAP + column * (WIDTH + GAP)
        pen.text((left, 8), heading, fill=(60, 60, 60))
        for line, pictures in enumerate(rows):
            sheet.paste(Image.fromarray(pictures[column]), (left, top + line * (WIDTH + GAP)))
    path.parent.mkdir(parents=True, exist_ok=True)
    sheet.quantize(200).save(path, optimize=True)


def statistics_table(docs: Path) -> list[str]:
    """The sets of docs/results/statistics.json, nearest first."""
    results = json.loads((docs / "results" / "statistics.json").read_text(encoding="utf-8"))
    keys = ("occupied_share", "thickness", "components", "contrast", "iou", "ghost_share")
    lines = [
        "| cubes | distance | occupied | thickness | components | contrast | IoU with the truth | opaque, a ghost |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in sorted(results["rows"], key=lambda row: row["distance"]):
        cells = [f"{row[key]['mean']:.2f}" if key in row else "–" for key in keys]
        lines.append(f"| {row['method']} | {row['distance']:.3f} | {' | '.join(cells)} |")
    return [
        *lines,
        "",
        f"Two random halves of the capture's cubes are at {results['sampling_floor']:.3f} from each other. "
        f"`{results['command']}`",
    ]


def points_table(docs: Path) -> list[str]:
    """The comparison of docs/results/points.json, and the command that repeats it."""
    results = json.loads((docs / "results" / "points.json").read_text(encoding="utf-8"))
    lines = [
        "| measure | triangulated: median (lowest to highest set) | simulated: median (one set in ten below, above) "
        "| differs |",
        "|---|---|---|---|",
    ]
    for name, label in POINT_MEASURES.items():
        if name not in results["compared"]:
            continue
        both = results["compared"][name]
        digits = 0 if name == "points" else 3 if name in ("wrong", "outvoted") else 2
        cells = [
            f"{mid:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})"
            for low, mid, high in (both["real"], both["simulated"])
        ]
        lines.append(f"| {label} | {' | '.join(cells)} | {'yes' if both['outside'] else 'no'} |")
    return [*lines, "", f"`{results['command']}`"]


def points_section(docs: Path) -> list[str]:
    """The page's part on sparse points; empty as long as they were not measured."""
    if not (docs / "results" / "points.json").exists():
        return []
    return [
        "## Do simulated sparse points look like triangulated ones?",
        "",
        "The evidence of harvested cubes comes from simulated points "
        "(`unghost.scenes.sparse_points.simulate_sparse_points`), because matching photos of every scene would take "
        "a minute each. Here they stand beside points that were triangulated from the photos of one sweep: of two "
        "real captures (photos of 1,000 pixels), and of three synthetic scenes (seed 555, rendered at 384 pixels). "
        "The surface of a capture is unknown, so distances to it are of the synthetic scenes alone. A point is wrong "
        "if it is farther from the surface than three of its uncertainties and five pixels together; the vote is that "
        "of `SightLines.build`. A measure *differs* if the medians are farther apart than the triangulated sets are "
        "among themselves.",
        "",
        *points_table(docs),
        "",
        "![distributions of the measures](results/points.png)",
        "",
    ]


def page(options: Options, found: dict[str, Any], sample_bytes: int) -> str:
    """The text of docs/harvest.md."""
    config = HarvestConfig()
    kinds = ", ".join(f"{count} {kind} at {resolution}" for (kind, resolution), count in found["kinds"].items())
    low, middle, high = found["psnr"]
    time = f", in about {options.seconds / 3600:.1f} hours of two cores' processor time" if options.seconds else ""
    asked = f" of {options.scenes} (in the others a fit failed or no free path was found)" if options.scenes else ""
    return "\n".join(
        [
            "# The harvest",
            "",
            "What a badly constrained field gets wrong is thick smooth fog, not blobs, and no synthetic corruption "
            "looks like it. So the larger part of the training pairs is *harvested*: a synthetic room of known "
            f"geometry is photographed along a casual sweep ({config.photos[0]}–{config.photos[1]} small photos with "
            "wrong exposures, noise and poses that are slightly off), a radiance field is fitted to the photos, and "
            "not for long, and cubes of its opacity become inputs. The signed distance of the room gives the labels. "
            "This page is written by `python -m benchmarks.data.harvest_page`.",
            "",
            f"**This one**: {found['pairs']:,} pairs of {found['scenes']} scenes{asked}{time}. "
            f"Fields (kind, cells along an axis): {kinds}. PSNR on their own photos: {middle:.1f} dB (one in ten below "
            f"{low:.1f}, one above {high:.1f}). {found['with_meshes']} scenes hold some of {found['meshes']} different "
            "meshes beside procedural furniture.",
            "",
            f"    unghost harvest --out out/harvest --scenes {options.scenes or found['scenes']} --seed 0 --workers 2 "
            "--mesh-root MESHES",
            "",
            "It can be killed and started again; scene i depends on (seed, i) alone. A frequency-encoded MLP is never "
            "harvested for training (`--kinds mlp --seed 1` makes the set that is held out).",
            "",
            "![six pairs, one a row](harvest/pairs.png)",
            "",
            "Grey is true surface, **orange** a ghost, **blue** surface that the field lacks, violet what nobody "
            "judges: inside solids and walls, the band about a surface, what no photo saw. A slice is the middle one "
            "along z; opacities are drawn as their square roots, so that thin fog shows. `surroundings` is the same "
            "centre at three times the edge; `views` counts the photos that have a voxel in their frustum, hidden or "
            "not.",
            "",
            f"[A sample](harvest/sample) of {SAMPLE_CUBES} pairs ({sample_bytes / 1e6:.1f} MB, scenes without meshes) "
            "is in the repository: `unghost preview docs/harvest/sample`.",
            "",
            "## Does it look like a real capture's field?",
            "",
            "Cubes of fields fitted to the first sweep of a real capture, cut as the harvest's are, against those of "
            "the harvest and of the synthetic recipes. The distance "
            "(`unghost.data_recipes.inspection.statistics`) compares seven "
            "features of the *input* alone: 0 for the same distributions, 1 at most.",
            "",
            *statistics_table(options.docs),
            "",
            "![distances, and distributions of the features](results/statistics.png)",
            "",
            *points_section(options.docs),
        ]
    )


def main() -> None:
    options = tyro.cli(Options, description=__doc__)
    if not options.harvest.exists():
        give_up(Options, f"needs HARVEST, {HARVEST}; there is no {options.harvest}")
    shards = [read_shard(path) for path in find_shards(options.harvest)]
    found = facts(shards)
    draw(shards, options.docs / "harvest" / "pairs.png")
    size = write_sample(generated(shards), options.docs / "harvest" / "sample")
    (options.docs / "harvest.md").write_text(page(options, found, size), encoding="utf-8")
    print(f"{found['pairs']} pairs of {found['scenes']} scenes")
    wrote(options.docs / "harvest.md")


if __name__ == "__main__":
    main()
