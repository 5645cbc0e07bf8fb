"""A differentiable field on a grid, for benchmarks of the regularizer."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from unghost.fields.trilinear import trilinear
from unghost.scenes.labelled_room.room import AABB


class GridField(torch.nn.Module):
    """Trilinear in a table of densities of the demo's box; ``softplus``, so that matter can grow where there is none.

    Args:
        density: ``(X, Y, Z)`` of cells, per scene unit.
        pitch: side of a cell, scene units.
    """

    def __init__(self, density: NDArray[Any], pitch: float) -> None:
        super().__init__()
        self.shape, self.side, self.pitch = density.shape, max(density.shape), pitch
        padded = np.zeros((self.side,) * 3)
        padded[tuple(slice(0, count) for count in self.shape)] = density
        depth = torch.from_numpy(np.maximum(padded * pitch, 1e-3)).float()
        self.table = torch.nn.Parameter(torch.log(torch.expm1(depth)).reshape(-1, 1))
        self.low = torch.from_numpy(np.asarray(AABB)[0] + pitch / 2).float()

    def forward(self, positions: torch.Tensor) -> torch.Tensor:
        """Densities ``(M, 1)``."""
        place = ((positions - self.low) / self.pitch).clamp(0.0, self.side - 1.0)
        return torch.nn.functional.softplus(trilinear(self.table, place, self.side)) / self.pitch

    def cells(self) -> torch.Tensor:
        """Densities ``(X, Y, Z)`` at the cells' centres."""
        x, y, z = self.shape
        return torch.nn.functional.softplus(self.table.reshape((self.side,) * 3)[:x, :y, :z]) / self.pitch
