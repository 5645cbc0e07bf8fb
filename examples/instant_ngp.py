"""The density grid of an instant-ngp snapshot, cleaned. Without an argument, of a snapshot that it makes itself.

    python examples/instant_ngp.py [fox.ingp]

What comes out is a keep mask in instant-ngp's coordinates (``grid.to_ngp`` leads there from ``transforms.json``), and
the cleaned grid as an .npz. Needs neither a GPU nor instant-ngp nor torch.
"""

from __future__ import annotations

import struct
import sys
from pathlib import Path
from typing import Any

import numpy as np

from unghost import clean
from unghost.core.distances import signed as sd
from unghost.fields.adapters.grids import cell_centers, save_grid
from unghost.fields.adapters.instant_ngp import CELLS, SHORTEST_STEP, load_instant_ngp, morton_index


def msgpack(value: dict[str, Any] | list[Any] | bytes | str | float) -> bytes:
    """Just enough of MessagePack to make a snapshot of."""
    if isinstance(value, dict):
        return b"\xdf" + struct.pack(">I", len(value)) + b"".join(msgpack(k) + msgpack(v) for k, v in value.items())
    if isinstance(value, list):
        return b"\xdd" + struct.pack(">I", len(value)) + b"".join(map(msgpack, value))
    if isinstance(value, bytes):
        return b"\xc6" + struct.pack(">I", len(value)) + value
    if isinstance(value, str):
        return b"\xdb" + struct.pack(">I", len(value)) + value.encode()
    return b"\xcb" + struct.pack(">d", value) if isinstance(value, float) else b"\xce" + struct.pack(">I", int(value))


def scene() -> tuple[np.ndarray, np.ndarray]:
    """Signed distances of a lamp on a shelf, and of two floaters, on the cells of one cascade (the unit cube)."""
    p = cell_centers([[0, 0, 0], [1, 1, 1]], (CELLS,) * 3).astype(float) - 0.5
    shelf = sd.union([sd.box(p - [0, 0, -0.3], [0.4, 0.25, 0.03]), sd.box(p - [0, 0.22, 0], [0.4, 0.03, 0.33])])
    shade = sd.shell(sd.cone(p - [0, -0.05, 0.05], 0.16, 0.3), 0.025)
    lamp = sd.union([sd.cylinder(p - [0, -0.05, -0.25], 0.09, 0.025), sd.cylinder(p - [0, -0.05, -0.1], 0.02, 0.2)])
    floaters = sd.union([sd.sphere(p - [0.3, -0.3, 0.2], 0.05), sd.ellipsoid(p - [-0.3, -0.2, 0.1], [0.06, 0.1, 0.05])])
    return sd.union([shelf, np.maximum(shade, 0.06 - p[..., 2]), lamp]), floaters


def make(path: Path) -> None:
    solid, floaters = scene()
    density = 600.0 / (1.0 + np.exp(solid * 400)) + 60.0 / (1.0 + np.exp(floaters * 200))
    cells = np.empty(CELLS**3)
    cells[morton_index().ravel()] = (density * SHORTEST_STEP).ravel()
    snapshot = {
        "version": 1,
        "mode": "nerf",
        "params_binary": bytes(1000),
        "density_grid_size": CELLS,
        "density_grid_binary": cells.astype("<f2").tobytes(),
        "aabb": {"min": [0.0] * 3, "max": [1.0] * 3},
        "nerf": {"aabb_scale": 1, "dataset": {"scale": 0.33, "offset": [0.5, 0.5, 0.5], "from_mitsuba": 0}},
    }
    path.write_bytes(msgpack({"snapshot": snapshot}))


def main() -> None:
    path = Path(sys.argv[1]) if len(sys.argv) > 1 else Path("made_here.msgpack")
    if len(sys.argv) == 1:
        make(path)

    grid = load_instant_ngp(path)
    mask = clean(grid.density_fn, grid.aabb, field_pitch=2 * grid.field_pitch)  # every second cell: four times as fast

    summary = mask.summary()
    print(f"{path}: {summary['removed']:,} of {summary['occupied']:,} occupied cells removed")
    if len(sys.argv) == 1:
        solid, floaters = scene()
        kept = mask.keep(cell_centers([[0, 0, 0], [1, 1, 1]], (CELLS,) * 3))
        print(
            f"{(~kept)[floaters < 0].mean():.1%} of the floaters removed, {kept[solid < 0].mean():.1%} of the rest kept"
        )
    density, box = grid.cascade(0)
    centers = cell_centers(box, density.shape)
    save_grid(path.with_suffix(".npz"), np.where(mask.keep(centers), density, 0), box)
    mask.save(path.with_suffix(".keep.npz"))
    print(f"{path.with_suffix('.npz')} and {path.with_suffix('.keep.npz')} written")


if __name__ == "__main__":
    main()
