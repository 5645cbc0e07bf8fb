"""Any function of positions is a field: here an occupancy network's stand-in, in its own units, wrapped in two lines.

    python examples/numpy_callable.py

The function takes a flat list of points, answers with probabilities, and lives in centimetres: three things that
unghost does not take, and three adapters. Needs no torch.
"""

from __future__ import annotations

import numpy as np

from unghost import clean
from unghost.fields.adapters.callables import numpy_density_fn, occupancy_density_fn, transformed_density_fn
from unghost.fields.adapters.grids import cell_centers, grid_density_fn, load_grid, save_grid

AABB = np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])  # metres
PITCH = 2.0 / 64


def probability(points: np.ndarray) -> list[float]:
    """Somebody's occupancy of ``(M, 3)`` points in centimetres: a chair, and two ghosts above it."""
    x, y, z = points.T / 100.0
    seat = (np.abs(x) < 0.45) & (np.abs(y) < 0.45) & (np.abs(z + 0.2) < 0.07)
    back = (np.abs(x) < 0.45) & (np.abs(y - 0.4) < 0.06) & (z > -0.2) & (z < 0.7)
    legs = (np.abs(np.abs(x) - 0.38) < 0.07) & (np.abs(np.abs(y) - 0.38) < 0.07) & (z < -0.2) & (z > -0.9)
    ghosts = np.exp(-(((x - 0.5) ** 2 + (y + 0.4) ** 2 + (z - 0.5) ** 2) / 0.015))
    ghosts += 0.6 * np.exp(-(((x + 0.6) ** 2 + (y + 0.5) ** 2 + (z - 0.2) ** 2) / 0.01))
    return list(np.maximum(0.97 * (seat | back | legs), 0.9 * ghosts.clip(0, 1)))


def main() -> None:
    centimetres = numpy_density_fn(occupancy_density_fn(lambda p: np.array(probability(p)), pitch=100 * PITCH))
    density_fn = transformed_density_fn(centimetres, np.diag([100.0, 100.0, 100.0, 1.0]))

    mask = clean(density_fn, AABB, field_pitch=PITCH)

    centers = cell_centers(AABB, (64, 64, 64))
    solid = np.array(probability(centers.reshape(-1, 3) * 100)).reshape(64, 64, 64)
    chair, ghosts = solid == 0.97, (solid > 0.1) & (solid != 0.97)
    kept = mask.keep(centers)
    print(f"{(~kept)[ghosts].mean():.1%} of the ghosts removed, {kept[chair].mean():.1%} of the chair kept")

    # The same field as a grid in a file, which is what `unghost clean` takes.
    save_grid("chair.npz", mask.apply(density_fn)(centers)[..., 0], AABB)
    again = grid_density_fn(*load_grid("chair.npz"))
    print(f"chair.npz written; density in the seat {again(np.array([[0.0, 0.0, -0.2]])).item():.1f} per metre")


if __name__ == "__main__":
    main()
