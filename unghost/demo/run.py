"""``unghost demo``: clean a room whose ghosts are known, and show and score what happened.

numpy, scipy, matplotlib, Jinja2 and onnxruntime only; no torch, no data, no network.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InvalidArgument, needs_extra
from ..core.occupancy import OccupancyRule
from ..core.results import build_results, write_results
from ..denoisers import load_denoiser
from ..facade import clean
from ..fields.adapters.grids import cell_centers, grid_density_fn
from ..scenes.labelled_room.ghosts import KINDS
from ..scenes.labelled_room.room import AABB, SHAPE, Room, build_room

Mask = NDArray[np.bool_]
RULE = OccupancyRule()
SCORES = ("floater_recall", "floater_precision", "surface_kept", "iou_before", "iou", "seconds")  # in the tables


@dataclass(frozen=True)
class Outcome:
    """What one method did: cells kept ``(X, Y, Z)`` bool, and how long it took."""

    kept: Mask
    seconds: float


def _run_clean(room: Room, denoiser: Any) -> Mask:
    keep_mask = clean(grid_density_fn(room.density, AABB), AABB, denoiser=denoiser, field_pitch=room.pitch)
    return np.asarray(keep_mask.keep(cell_centers(AABB, SHAPE)))


def _run_components(room: Room, denoiser: Any) -> Mask:
    """Plain connected-component removal: of all that is occupied, keep the largest piece."""
    with needs_extra("demo", caller="demo"):
        from scipy.ndimage import label

    pieces, _ = label(room.occupied(RULE))
    counts = np.bincount(pieces.ravel())
    counts[0] = 0
    return np.asarray(pieces == counts.argmax())


METHODS: Mapping[str, Callable[[Room, Any], Mask]] = {"clean": _run_clean, "components": _run_components}


def _share(part: Mask, whole: Mask) -> float | None:
    """Share of ``whole`` that is also in ``part``; None if there is no whole."""
    total = int(whole.sum())
    return float((part & whole).sum() / total) if total else None


def score(room: Room, kept: Mask) -> dict[str, Any]:
    """Compare what was kept with what is known to be there.

    Cells that the field without ghosts occupies are surface; all other occupied cells are ghosts.

    Args:
        room: the patient.
        kept: cells ``(X, Y, Z)`` that the method keeps; only occupied ones matter.

    Returns:
        Shares in [0, 1] (None where nothing is there to count): ``floater_recall`` of the ghost cells
        removed, ``floater_precision`` of the removed cells that are ghosts, ``surface_kept``,
        ``iou_before`` and ``iou`` of the occupied cells with the surface, ``recall_by_kind``.
    """
    if kept.shape != SHAPE or kept.dtype != np.bool_:
        raise InvalidArgument(f"score: kept must be bool {SHAPE}, got {kept.dtype} {kept.shape}")
    occupied, surface = room.occupied(RULE), room.surface(RULE)
    ghosts, removed, left = occupied & ~surface, occupied & ~kept, occupied & kept
    return {
        "floater_recall": _share(removed, ghosts),
        "floater_precision": _share(ghosts, removed),
        "surface_kept": _share(kept, surface & occupied),
        "iou_before": _share(surface & occupied, surface | occupied),
        "iou": _share(surface & left, surface | left),
        "recall_by_kind": {
            kind: _share(removed, ghosts & (room.ghost_kind == index)) for index, kind in enumerate(KINDS)
        },
    }


def run_methods(room: Room, denoiser: Any) -> dict[str, Outcome]:
    """Every method once, timed from the density callable to the mask."""
    outcomes = {}
    for name, method in METHODS.items():
        start = time.perf_counter()
        kept = method(room, denoiser)
        outcomes[name] = Outcome(kept, time.perf_counter() - start)
    return outcomes


def run_demo(out: str | Path, *, seed: int = 0, denoiser: Any = None) -> dict[str, Any]:
    """Build the room, clean it, score it, draw it.

    Args:
        out: folder for ``result.json`` and ``index.html`` (and the page's pictures as PNG); made if absent.
        seed: of the room and its ghosts, >= 0.
        denoiser: the shipped one if None.

    Returns:
        The results object that was written.
    """
    from .page import write_page
    from .pictures import draw_pictures

    folder = Path(out)
    start = time.perf_counter()
    denoiser = load_denoiser() if denoiser is None else denoiser
    room = build_room(seed)
    outcomes = run_methods(room, denoiser)
    rows = [{"method": name, **score(room, item.kept), "seconds": item.seconds} for name, item in outcomes.items()]
    pictures = draw_pictures(room, {name: item.kept for name, item in outcomes.items()})
    results = build_results(
        rows,
        command=f"unghost demo --seed {seed}",
        seeds=[seed],
        seconds=time.perf_counter() - start,
        weights={"name": denoiser.manifest.name, "body_sha256": denoiser.manifest.body_sha256},
    )
    folder.mkdir(parents=True, exist_ok=True)
    for name, png in pictures.items():
        (folder / f"{name}.png").write_bytes(png)
    write_results(folder / "result.json", results)
    write_page(folder / "index.html", results, pictures)
    return results


def summary_table(results: Mapping[str, Any]) -> str:
    """The rows of a demo's results as a few lines of plain text."""
    lines = [f"{'':12}" + "".join(f"{name:>19}" for name in SCORES)]
    for row in results["rows"]:
        cells = ["-" if row[name] is None else f"{row[name]:.3f}" for name in SCORES]
        lines.append(f"{row['method']:12}" + "".join(f"{cell:>19}" for cell in cells))
    lines.append("ghosts removed by kind: ")
    for row in results["rows"]:
        kinds = ", ".join(
            f"{kind} {'-' if share is None else f'{share:.2f}'}" for kind, share in row["recall_by_kind"].items()
        )
        lines.append(f"  {row['method']:11} {kinds}")
    return "\n".join(lines)
