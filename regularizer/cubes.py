"""One step's cubes as tensors (torch)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..core.aabb import scene_extent
from ..core.frames import unit_lattice
from .proposals import ImportanceGrid, sample_edges
from .settings import RegularizerSettings

FieldPitch = float | Callable[[NDArray[np.float64]], NDArray[np.float64]] | None

GRID_STRIDE = 4  # every fourth voxel of a cube refreshes the importance grid


def wide_dtype(device: torch.device) -> torch.dtype:
    """float64, or float32 where there is none (mps)."""
    return torch.float32 if device.type == "mps" else torch.float64


@dataclass(frozen=True)
class CubeBatch:
    """Axis-aligned cubes.

    Attributes:
        positions: ``(N, R, R, R, 3)`` float32 voxel centres, scene units.
        inside: ``(N, R, R, R)`` bool: in the scene's box.
        pitch: ``(N, 1, 1, 1)`` what an opacity is measured over: the field's cell, or the cube's voxel.
        edge_fraction: ``(N,)``.
        centers, edges: ``(N, 3)`` and ``(N,)`` float64, scene units.
    """

    positions: Tensor
    inside: Tensor
    pitch: Tensor
    edge_fraction: NDArray[np.float64]
    centers: NDArray[np.float64]
    edges: NDArray[np.float64]

    def thinned(self, values: Tensor, used: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Positions ``(M, 3)``, ``values`` and pitches ``(M,)`` of every fourth voxel that is ``used``."""
        step = (slice(None), *[slice(GRID_STRIDE // 2, None, GRID_STRIDE)] * 3)
        kept = used[step]
        return self.positions[step][kept], values[step][kept], self.pitch.expand(used.shape)[step][kept]


def draw_cubes(
    grid: ImportanceGrid,
    rng: np.random.Generator,
    settings: RegularizerSettings,
    *,
    field_pitch: FieldPitch,
    resolution: int,
    device: torch.device,
) -> CubeBatch:
    """Centres from the importance grid, edges by the settings' rule.

    A cube that would stick out of the box is moved in as far as it fits, so that no voxel is wasted; one with
    an edge longer than a side of the box is centred there and sticks out at both ends.

    Raises:
        ValueError: ``field_pitch`` gave something that is not finite and > 0.
    """
    count, box = settings.cubes, grid.aabb
    centers = grid.sample(rng, count, strategy=settings.strategy, uniform_share=settings.uniform_share)
    pitch: Any = field_pitch(centers) if callable(field_pitch) else field_pitch
    if pitch is not None:
        pitch = np.broadcast_to(np.asarray(pitch, dtype=np.float64), (count,))
        if not (np.isfinite(pitch) & (pitch > 0)).all():
            raise ValueError("DensityRegularizer: field_pitch must be finite and > 0 at every cube centre")
    edges = sample_edges(rng, count, aabb=box, edge_range=settings.edge_range, field_pitch=pitch, resolution=resolution)
    reach = np.minimum(edges[:, None] / 2, (box[1] - box[0]) / 2)
    centers = np.clip(centers, box[0] + reach, box[1] - reach)
    made = [
        torch.as_tensor(array, dtype=torch.float32, device=device)
        for array in (unit_lattice(resolution), centers, edges, box)
    ]
    lattice, middles, sides, corners = made
    positions = middles[:, None, None, None] + lattice * sides[:, None, None, None, None]
    inside = ((positions >= corners[0]) & (positions <= corners[1])).all(dim=-1)
    cell = edges / resolution if pitch is None else np.array(pitch)
    cell_tensor = torch.as_tensor(cell, dtype=wide_dtype(device), device=device)[:, None, None, None]
    return CubeBatch(positions, inside, cell_tensor, edges / scene_extent(box), centers, edges)
