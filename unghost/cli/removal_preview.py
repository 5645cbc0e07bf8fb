"""What a keep mask would remove, before anything is changed: the scene from three sides, and its regions in a table."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..cleaning.keep_mask import KeepMask
from ..cleaning.queries import make_query
from ..core.lattice import lattice_axes
from ..core.occupancy import OccupancyRule
from ..data_recipes.inspection.drawing import GHOST, png_bytes

SIDE = 420  # pixels that the longest side of the box takes at least
GAP = 12
SLAB = 1 << 20  # cells asked about at once
MOST_ROWS = 12
FAR, NEAR = 0.45, 0.92  # grey of kept cells at the far side of the box and at the near one


def occupied_cells(mask: KeepMask, density_fn: Callable[[Any], Any], rule: OccupancyRule | None = None) -> Any:
    """Which of the mask's cells the field (numpy or torch) occupies ``(X, Y, Z)`` bool; asked at their centres."""
    chosen, shape = rule or OccupancyRule(), mask.cells.shape
    axes = lattice_axes(mask.aabb, mask.pitch, shape)
    query = make_query(density_fn, place=mask.aabb.mean(axis=0), caller="occupied_cells")
    occupied = np.zeros(shape, dtype=bool)
    rows = max(1, SLAB // (shape[1] * shape[2]))
    for start in range(0, shape[0], rows):
        part = slice(start, start + rows)
        places = np.stack(np.meshgrid(axes[0][part], axes[1], axes[2], indexing="ij"), axis=-1)
        occupied[part] = chosen.occupied(query(places.reshape(-1, 3)).reshape(places.shape[:-1]), mask.pitch)
    return occupied


def _side(kept: NDArray[np.bool_], removed: NDArray[np.bool_], axis: int) -> NDArray[np.float64]:
    """The box seen along an axis, ``(rows, columns, 3)`` in [0, 1]: kept cells grey, nearer ones lighter; removed ones
    orange and half transparent."""
    kept, removed = np.moveaxis(kept, axis, 0), np.moveaxis(removed, axis, 0)
    if axis != 1:  # from +x, from -y and from +z the other axes run to the right and up, nothing mirrored
        kept, removed = kept[::-1], removed[::-1]
    first = np.where(kept.any(axis=0), kept.argmax(axis=0), len(kept)) / len(kept)
    shade = np.where(first < 1.0, NEAR + (FAR - NEAR) * first, 1.0)
    edge = np.abs(np.diff(first, axis=0, append=first[-1:])) + np.abs(np.diff(first, axis=1, append=first[:, -1:]))
    picture = (shade * (1.0 - np.minimum(0.6, 3.0 * edge)))[..., None] * np.ones(3)
    cover = 1.0 - 0.55 ** np.minimum(removed.sum(axis=0), 6)
    picture += (np.array(GHOST) - picture) * cover[..., None]
    return picture.swapaxes(0, 1)[::-1]  # the last axis upwards


def preview_png(mask: KeepMask, occupied: NDArray[np.bool_]) -> bytes:
    """Seen from +x (y to the right), from -y (x to the right) and from above: what stays in grey, what would go in
    orange."""
    kept, removed = occupied & mask.cells, ~mask.cells
    scale = max(1, -(-SIDE // max(mask.cells.shape)))
    views = [_side(kept, removed, axis).repeat(scale, axis=0).repeat(scale, axis=1) for axis in range(3)]
    height = max(view.shape[0] for view in views)
    width = sum(view.shape[1] for view in views) + GAP * (len(views) + 1)
    sheet, left = np.ones((height + 2 * GAP, width, 3)), GAP
    for view in views:
        top = GAP + height - view.shape[0]
        sheet[top : top + view.shape[0], left : left + view.shape[1]] = view
        left += view.shape[1] + GAP
    return png_bytes((sheet * 255).round().astype(np.uint8))


def region_table(mask: KeepMask) -> str:
    """The removed regions as lines of text, largest first."""
    summary = mask.summary()
    lines = [
        f"{summary.get('region_count', 0)} regions would go, {summary.get('removed', 0)} of "
        f"{summary.get('occupied', 0)} occupied cells"
    ]
    regions = summary.get("regions", [])[:MOST_ROWS]
    if regions:
        lines.append(f"{'cells':>9} {'volume':>10} {'confidence':>10}  box (scene units)")
    for region in regions:
        low, high = (" ".join(f"{value:.3g}" for value in corner) for corner in region["box"])
        lines.append(f"{region['voxels']:9d} {region['volume']:10.3g} {region['confidence']:10.2f}  {low} .. {high}")
    return "\n".join(lines)


def write_preview(path: Path, mask: KeepMask, density_fn: Callable[[Any], Any]) -> None:
    """The picture into a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(preview_png(mask, occupied_cells(mask, density_fn)))
