"""The two lines, on a field that unghost knows nothing of: a voxel grid with a table in it, and two floaters.

    python examples/two_lines.py

There are no photos here, so nothing defends the table but the prior itself: what stays, it left alone.
"""

from __future__ import annotations

import numpy as np
import torch

from unghost import DensityRegularizer, load_denoiser
from unghost.core.distances import signed as sd

AABB = np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
CELLS = 64
PITCH = 2.0 / CELLS


class VoxelField(torch.nn.Module):
    """Somebody's radiance field: all that matters is that it has a density."""

    def __init__(self, density: np.ndarray) -> None:
        super().__init__()
        raw = np.log(np.expm1(np.clip(density, 1e-3, 80.0)))
        self.raw = torch.nn.Parameter(torch.from_numpy(raw).float()[None, None])

    def density_fn(self, positions: torch.Tensor) -> torch.Tensor:
        """``(..., 3)`` to ``(..., 1)``."""
        points = positions.reshape(1, -1, 1, 1, 3).flip(-1) * (CELLS / (CELLS - 1))
        raw = torch.nn.functional.grid_sample(self.raw, points, align_corners=True)
        return torch.nn.functional.softplus(raw).reshape(*positions.shape[:-1], 1)


def scene() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Density, and which cells are table and which are floater, each ``(64, 64, 64)``."""
    axis = (np.arange(CELLS) + 0.5) * PITCH - 1.0
    p = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    legs = [sd.box(p - np.array([x, y, -0.45]), [0.06, 0.06, 0.4]) for x in (-0.5, 0.5) for y in (-0.4, 0.4)]
    table = sd.union([*legs, sd.box(p, [0.65, 0.5, 0.06]), sd.box(p - np.array([0, 0, -0.9]), [0.95, 0.95, 0.06])])
    floaters = sd.union(
        [sd.sphere(p - np.array([0.3, 0.1, 0.6]), 0.12), sd.sphere(p - np.array([-0.5, -0.2, 0.5]), 0.17)]
    )
    density = 60.0 / (1.0 + np.exp(table / (0.3 * PITCH))) + 12.0 / (1.0 + np.exp(floaters / (0.8 * PITCH)))
    return density, table < 0, floaters < 0


def main() -> None:
    density, table, floaters = scene()
    field = VoxelField(density)
    optimizer = torch.optim.Adam(field.parameters(), lr=0.4)  # raw values reach 60: they have far to go

    regularizer = DensityRegularizer(load_denoiser(), aabb=AABB, cubes=8)
    for step in range(180):
        loss = sum(regularizer(field.density_fn).values(), torch.zeros(()))  # add it to your photometric loss
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if step % 30 == 0 or step == 179:
            now = torch.nn.functional.softplus(field.raw.detach())[0, 0].numpy()
            opaque = 1 - np.exp(-now * PITCH) > 0.1
            left, kept = opaque[floaters].mean(), opaque[table].mean()
            print(f"step {step:3d}: {left:5.1%} of the floaters left, {kept:5.1%} of the table there")


if __name__ == "__main__":
    main()
