"""One step's cubes as tensors (torch)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..core.aabb import scene_extent
from ..core.errors import InvalidArgument
from ..core.frames import random_rotations, unit_lattice
from .pitch import FieldPitch
from .proposals import ImportanceGrid, sample_edges
from .settings import RegularizerSettings

GRID_STRIDE = 4  # every fourth voxel of a cube refreshes the importance grid


def wide_dtype(device: torch.device) -> torch.dtype:
    """float64, or float32 where there is none (mps)."""
    return torch.float32 if device.type == "mps" else torch.float64


@dataclass(frozen=True)
class CubeBatch:
    """Cubes of one step.

    Attributes:
        positions: ``(N, R, R, R, 3)`` float32 voxel centres, scene units.
        inside: ``(N, R, R, R)`` bool: in the scene's box.
        pitch: ``(N, 1, 1, 1)`` what an opacity is measured over: the field's cell, or the cube's voxel.
        edge_fraction: ``(N,)``.
        centers, edges: ``(N, 3)`` and ``(N,)`` float64, scene units.
        rotations: ``(N, 3, 3)`` cube-to-world, or None for axis-aligned.
    """

    positions: Tensor
    inside: Tensor
    pitch: Tensor
    edge_fraction: NDArray[np.float64]
    centers: NDArray[np.float64]
    edges: NDArray[np.float64]
    rotations: NDArray[np.float64] | None = None

    def frames(self, asked: Tensor) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64] | None]:
        """Centres, edges and rotations of those ``asked (N,)`` about."""
        some = asked.cpu().numpy()
        return self.centers[some], self.edges[some], None if self.rotations is None else self.rotations[some]

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
    an edge longer than a side of the box is centred there and sticks out at both ends. A turned one moves in as far
    as the box around it fits.

    Raises:
        ValueError: ``field_pitch`` gave something that is not finite and > 0.
    """
    count, box = settings.cubes, grid.aabb
    centers = grid.sample(rng, count, strategy=settings.strategy, uniform_share=settings.uniform_share)
    pitch: Any = field_pitch(centers) if callable(field_pitch) else field_pitch
    if pitch is not None:
        pitch = np.broadcast_to(np.asarray(pitch, dtype=np.float64), (count,))
        if not (np.isfinite(pitch) & (pitch > 0)).all():
            raise InvalidArgument("DensityRegularizer: field_pitch must be finite and > 0 at every cube centre")
    edges = sample_edges(rng, count, aabb=box, edge_range=settings.edge_range, field_pitch=pitch, resolution=resolution)
    rotations = random_rotations(rng, count) if settings.rotate else None
    spread: Any = 1.0 if rotations is None else np.abs(rotations).sum(axis=2)
    reach = np.minimum(edges[:, None] / 2 * spread, (box[1] - box[0]) / 2)
    centers = np.clip(centers, box[0] + reach, box[1] - reach)
    made = [
        torch.as_tensor(array, dtype=torch.float32, device=device)
        for array in (unit_lattice(resolution), centers, edges, box)
    ]
    lattice, middles, sides, corners = made
    positions = middles[:, None, None, None] + _turned(lattice, rotations) * sides[:, None, None, None, None]
    inside = ((positions >= corners[0]) & (positions <= corners[1])).all(dim=-1)
    cell = edges / resolution if pitch is None else np.array(pitch)
    cell_tensor = torch.as_tensor(cell, dtype=wide_dtype(device), device=device)[:, None, None, None]
    return CubeBatch(positions, inside, cell_tensor, edges / scene_extent(box), centers, edges, rotations)


def _turned(lattice: Tensor, rotations: NDArray[np.float64] | None) -> Tensor:
    """``(R, R, R, 3)`` as it is, or ``(N, R, R, R, 3)`` in the world's axes."""
    if rotations is None:
        return lattice
    turns = torch.as_tensor(rotations, dtype=lattice.dtype, device=lattice.device)
    return torch.einsum("nab,ijkb->nijka", turns, lattice)
