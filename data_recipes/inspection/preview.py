"""A page that shows what is in a shard, or in a folder of shards: cubes, statistics, sources."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.errors import InvalidArgument, InvalidFile
from ...core.io import write_text
from ...core.occupancy import DEFAULT_OPACITY_THRESHOLD, FREE_LABEL, IGNORE_LABEL, SURFACE_LABEL, opacity_from_signed
from ...core.shards.finding import find_shards
from ...core.shards.packing import dequantize_signed, unpack_labels
from ...core.shards.storage import Shard, read_shard
from .drawing import GHOST, MISSING, SURFACE, UNJUDGED, Image, best_turn, render_cube
from .page import page_text
from .statistics import CubeStatistics, cube_features, feature_distances, sampling_floor, shard_statistics

MEASURED = 200  # cubes; about 15 ms each
_PALETTE = np.zeros((3, 3), dtype=np.float32)
_PALETTE[FREE_LABEL], _PALETTE[SURFACE_LABEL], _PALETTE[IGNORE_LABEL] = GHOST, SURFACE, UNJUDGED


@dataclass(frozen=True)
class DrawnCube:
    """One cube of the page: two pictures and what is known of it."""

    seen: Image
    truth: Image
    features: dict[str, float]
    severity: float
    edge_fraction: float
    shard: str
    row: int


def draw_pair(signed: NDArray[np.floating], labels: NDArray[np.uint8], *, width: int = 168) -> tuple[Image, Image]:
    """Input and truth of one cube as two pictures from the same corner.

    In the input, true surface is grey, ghosts are orange and what nobody judges is violet, each as opaque as it is.
    In the truth, surface that the input lacks (opacity at most 0.1) is blue. Of four corners, the one that shows
    most of the ghosts is taken.

    Args:
        signed: ``(R, R, R)`` signed opacity in [-1, 1].
        labels: ``(R, R, R)`` of 0 free, 1 surface, 2 ignore.
        width: of each picture, pixels.
    """
    opacity, surface = opacity_from_signed(signed), labels == SURFACE_LABEL
    turn = best_turn(opacity, (labels == FREE_LABEL) + 0.3 * surface)
    lacking = surface & (opacity <= DEFAULT_OPACITY_THRESHOLD)
    truth = np.where(lacking[..., None], MISSING, SURFACE)
    first, second = (
        render_cube(np.rot90(solid, turn), np.rot90(colors, turn), width=width)
        for solid, colors in ((opacity, _PALETTE[labels]), (surface.astype(np.float32), truth))
    )
    return first, second


def _draw(shards: list[tuple[str, Shard]], count: int, seed: int) -> list[DrawnCube]:
    """Up to ``count`` random cubes, in the order of the shards."""
    places = [(name, shard, row) for name, shard in shards for row in range(len(shard))]
    chosen = np.random.default_rng(seed).choice(len(places), size=min(count, len(places)), replace=False)
    drawn = []
    for index in np.sort(chosen):
        name, shard, row = places[int(index)]
        signed = dequantize_signed(shard.inputs[row])
        labels = unpack_labels(shard.labels[row : row + 1])[0]
        seen, truth = draw_pair(signed, labels)
        numbers = float(shard.severity[row]), float(shard.edge_fraction[row])
        drawn.append(DrawnCube(seen, truth, cube_features(signed, labels), *numbers, name, row))
    return drawn


def sources_of(shard: Shard) -> Counter[tuple[str, str]]:
    """How many cubes came from which (source, licence), from the shard's provenance.

    With per-cube sources, each is named by the first folder of its path; else the recipe's name and the licence
    that the provenance states. What was generated from numbers alone has the licence "generated".
    """
    provenance: dict[str, Any] = shard.provenance
    recipe = provenance.get("recipe", "unknown")
    name = str(recipe.get("name", "unknown")) if isinstance(recipe, dict) else str(recipe)
    stated = provenance.get("licence")
    if stated is None and isinstance(recipe, dict):
        made = recipe.get("source") != "meshes"  # of shards that state no licence
        stated = "generated" if made else "any of " + ", ".join(map(str, recipe.get("licences", ["unknown"])))
    whole = name, str(stated or "unknown")
    rows = shard.source
    if rows is None:
        return Counter({whole: len(shard)})
    entries: list[dict[str, Any]] = list(provenance.get("sources", []))
    found: Counter[tuple[str, str]] = Counter()
    for row, cubes in zip(*np.unique(rows, return_counts=True)):
        if row < 0:
            found[name, "generated"] += int(cubes)
            continue
        entry = entries[int(row)]
        folder = str(entry.get("path", "")).split("/")[0]
        found[f"{name}: {folder}" if folder else name, str(entry.get("licence", "unknown"))] += int(cubes)
    return found


def _rejected(shards: Sequence[Shard]) -> dict[str, str]:
    """Path and reason of the meshes that were passed over for some shard."""
    notes = [note for shard in shards for note in shard.provenance.get("rejected") or () if isinstance(note, dict)]
    return {str(note.get("path", "unknown")): str(note.get("reason", "unknown")) for note in notes}


def compare(found: CubeStatistics, other: CubeStatistics) -> dict[str, Any]:
    """Distance of two sets, ``distance``, its parts, ``features``, and what chance makes of it, ``floor``."""
    parts = feature_distances(found, other)
    halves = [sampling_floor(each) for each in (found, other) if len(each) > 1]
    return {"distance": float(np.mean(list(parts.values()))), "features": parts, "floor": max(halves, default=None)}


def write_preview(
    folder: str | Path,
    *,
    out: str | Path | None = None,
    cubes: int = 24,
    seed: int = 0,
    against: str | Path | None = None,
    measured: int = MEASURED,
) -> tuple[Path, dict[str, Any]]:
    """Write one HTML file, which needs nothing else and asks no network, about the cubes in ``folder``.

    Args:
        folder: a shard, or a folder of shards.
        out: the file; ``FOLDER-preview.html`` beside the folder if None.
        cubes: how many to draw, >= 0.
        seed: of the choice of cubes.
        against: another shard or folder, to which the distance is stated.
        measured: how many cubes the statistics are of, at most; >= 1.

    Returns:
        The file, and the statistics on it: the summary of :class:`CubeStatistics`, ``shards``, ``total`` and, with
        ``against``, ``against`` (see :func:`compare`).

    Raises:
        ValueError: no shard there, a shard that is not valid, or numbers out of range.
        OSError: the page cannot be written; one that was there stays.
    """
    if cubes < 0 or measured < 1:
        raise InvalidArgument(f"write_preview: cubes must be >= 0 and measured >= 1, got {cubes} and {measured}")
    root = Path(folder)
    shards = [(path.name, read_shard(path)) for path in find_shards(root)]
    total = sum(len(shard) for _, shard in shards)
    if total == 0:
        raise InvalidFile(f"write_preview: the shards in {root} hold no cube")
    statistics = shard_statistics([shard for _, shard in shards], most=measured, seed=seed)
    facts: dict[str, Any] = {**statistics.summary(), "shards": len(shards), "total": total}
    if against is not None:
        facts["against"] = compare(statistics, shard_statistics(find_shards(against), most=measured, seed=seed))
        facts["against"]["name"] = Path(against).resolve().name
    text = page_text(
        name=root.resolve().name,
        facts=facts,
        statistics=statistics,
        drawn=_draw(shards, cubes, seed),
        edges=np.concatenate([np.asarray(shard.edge_fraction, dtype=np.float64) for _, shard in shards]),
        severities=np.concatenate([np.asarray(shard.severity, dtype=np.float64) for _, shard in shards]),
        sources=sum((sources_of(shard) for _, shard in shards), Counter()),
        rejected=_rejected([shard for _, shard in shards]),
    )
    target = root.resolve().with_name(f"{root.resolve().name}-preview.html") if out is None else Path(out)
    write_text(target, text)
    return target, facts
