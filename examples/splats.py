"""A 3D Gaussian splat scene, cleaned: a filtered .ply that viewers open.

    python examples/splats.py [scene.ply]

The same as ``unghost clean scene.ply``. Without an argument, a scene that it makes itself: a pedestal with a vase on
it, and floaters. Needs no torch.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from unghost.facade import clean_ply
from unghost.splats.ply import read_splat_ply

NAMES = [
    "x",
    "y",
    "z",
    "f_dc_0",
    "f_dc_1",
    "f_dc_2",
    "opacity",
    *(f"scale_{i}" for i in range(3)),
    *(f"rot_{i}" for i in range(4)),
    "made_as",
]


def make(path: Path, seed: int = 0) -> None:
    """Discs on two surfaces, and blobs; the property ``made_as`` says which is which (0 surface, 1 floater)."""
    rng = np.random.default_rng(seed)
    angle, height = rng.uniform(0, 2 * np.pi, 9000), rng.uniform(-0.2, 0.6, 9000)
    radius = 0.25 + 0.1 * np.cos(4 * height)
    vase = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)
    pedestal = rng.uniform(-0.45, 0.45, (9000, 3))
    side = rng.integers(0, 6, 9000)
    pedestal[np.arange(9000), side % 3] = np.where(side < 3, 0.45, -0.45)
    pedestal = pedestal * [1, 1, 0.6] - [0, 0, 0.5]
    centers = np.array([[0.7, 0.6, 0.5], [-0.7, 0.2, 0.4], [0.1, -0.75, 0.3]])
    floaters = centers[rng.integers(0, 3, 900)] + rng.normal(size=(900, 3)) * 0.05
    means = np.concatenate([vase, pedestal, floaters])
    rows = np.zeros(len(means), [(name, "<f4") for name in NAMES])
    rows["x"], rows["y"], rows["z"] = means.T
    rows["made_as"][-900:] = 1
    ghost = rows["made_as"] == 1
    for i in range(3):
        rows[f"f_dc_{i}"] = rng.normal(size=len(means))
        rows[f"scale_{i}"] = np.log(rng.uniform(0.008, 0.02, len(means)))
    rows["opacity"] = np.where(ghost, rng.normal(-1, 0.5, len(means)), rng.normal(2, 1, len(means)))
    for i in range(4):
        rows[f"rot_{i}"] = rng.normal(size=len(means))
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    lines += [f"property float {name}" for name in NAMES] + ["end_header\n"]
    path.write_bytes("\n".join(lines).encode() + rows.tobytes())


def main() -> None:
    path = Path(sys.argv[1]) if len(sys.argv) > 1 else Path("made_here.ply")
    if len(sys.argv) == 1:
        make(path)

    target = path.with_name(path.stem + "_clean.ply")
    cleaned = clean_ply(path, target)

    keep = cleaned.keep
    print(f"{target}: {keep.sum():,} of {len(keep):,} Gaussians kept")
    splats = read_splat_ply(path)
    if "made_as" in (splats.rows.dtype.names or ()):
        ghost = np.asarray(splats.rows["made_as"]) == 1
        print(f"{(~keep)[ghost].mean():.1%} of the floaters removed, {keep[~ghost].mean():.1%} of the rest kept")


if __name__ == "__main__":
    main()
