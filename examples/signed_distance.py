"""A signed distance (NeuS, VolSDF, a mesh's own) with floaters in it, cleaned as a density field.

    python examples/signed_distance.py

A learned distance grows bubbles where no photo looked: closed little surfaces in free space. They are floaters.
"""

from __future__ import annotations

import numpy as np

from unghost import clean
from unghost.core.distances import signed as sd
from unghost.fields.adapters.grids import cell_centers
from unghost.fields.adapters.sdf import sdf_density_fn

AABB = np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
CELLS = 64
PITCH = 2.0 / CELLS


def mug(p: np.ndarray) -> np.ndarray:
    """A mug on a table."""
    wall = sd.tube(p - [0, 0, -0.25], 0.4, 0.09, 0.45)
    floor = sd.cylinder(p - [0, 0, -0.65], 0.4, 0.05)
    handle = sd.torus((p - [0.45, 0, -0.25])[..., [0, 2, 1]], 0.22, 0.07)
    table = sd.box(p - [0, 0, -0.8], [0.95, 0.95, 0.09])
    return sd.union([wall, floor, np.maximum(handle, 0.4 - p[..., 0]), table])


def bubbles(p: np.ndarray) -> np.ndarray:
    return sd.union([sd.sphere(p - [-0.6, 0.5, 0.3], 0.14), sd.ellipsoid(p - [0.5, -0.5, 0.5], [0.2, 0.12, 0.1])])


def main() -> None:
    # A NeuS model: sharpness = exp(10 * variance). A VolSDF model: beta, alpha as trained.
    density_fn = sdf_density_fn(lambda p: np.minimum(mug(p), bubbles(p)), beta=0.3 * PITCH)

    mask = clean(density_fn, AABB, field_pitch=PITCH)
    kept = mask.keep(cell_centers(AABB, (CELLS,) * 3))
    inside_mug, inside_bubbles = (sdf(cell_centers(AABB, (CELLS,) * 3)) < 0 for sdf in (mug, bubbles))
    print(f"{(~kept)[inside_bubbles].mean():.1%} of the bubbles removed, {kept[inside_mug].mean():.1%} of the mug kept")

    cleaned_fn = mask.apply(density_fn)
    print(f"density in a bubble: {density_fn(np.array([[-0.6, 0.5, 0.3]])).item():.1f} before,", end=" ")
    print(f"{cleaned_fn(np.array([[-0.6, 0.5, 0.3]])).item():.1f} after")


if __name__ == "__main__":
    main()
