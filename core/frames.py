r"""Cubes in a scene: where the voxels of a denoiser's input lie.

Cell-centred lattice, index order ``[i, j, k] = [x, y, z]``, shown along one axis for resolution 4:

    -edge/2                0                 +edge/2
       |----.----|----.----|----.----|----.----|
           i=0       i=1       i=2       i=3
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from .aabb import scene_extent
from .errors import InvalidArgument

FloatArray = NDArray[np.float64]

RESOLUTION = 32


def unit_lattice(resolution: int = RESOLUTION) -> FloatArray:
    """Voxel centres of the cube [-1/2, 1/2]^3, ``(R, R, R, 3)``, unitless."""
    if resolution < 1:
        raise InvalidArgument(f"unit_lattice: resolution must be >= 1, got {resolution}")
    axis = (np.arange(resolution) + 0.5) / resolution - 0.5
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)


def cube_lattices(
    centers: NDArray[np.floating],
    edge_lengths: NDArray[np.floating],
    rotations: NDArray[np.floating] | None = None,
    *,
    resolution: int = RESOLUTION,
) -> FloatArray:
    """World positions of the voxel centres of many cubes.

    Args:
        centers: ``(N, 3)``, scene units.
        edge_lengths: ``(N,)``, scene units, > 0.
        rotations: ``(N, 3, 3)`` cube-to-world, or None for axis-aligned.

    Returns:
        ``(N, R, R, R, 3)`` float64.
    """
    centers = np.asarray(centers, dtype=np.float64)
    edges = np.asarray(edge_lengths, dtype=np.float64)
    if centers.ndim != 2 or centers.shape[1] != 3:
        raise InvalidArgument(f"cube_lattices: centers must have shape (N, 3), got {centers.shape}")
    if edges.shape != centers.shape[:1]:
        raise InvalidArgument(f"cube_lattices: edge_lengths must have shape ({len(centers)},), got {edges.shape}")
    local = unit_lattice(resolution)[None] * edges[:, None, None, None, None]
    if rotations is not None:
        local = np.einsum("nab,nijkb->nijka", np.asarray(rotations, dtype=np.float64), local)
    lattice: FloatArray = local + centers[:, None, None, None, :]
    return lattice


def edge_fraction(edge_length: NDArray[np.floating] | float, aabb: NDArray[np.floating]) -> FloatArray:
    """``edge_length / scene_extent``: the conditioning of every denoiser."""
    return np.asarray(edge_length, dtype=np.float64) / scene_extent(aabb)


def random_rotations(rng: np.random.Generator, count: int) -> FloatArray:
    """``(count, 3, 3)`` rotations uniform on SO(3) (unit quaternions from normals)."""
    q = rng.normal(size=(count, 4))
    w, x, y, z = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


@dataclass(frozen=True)
class CubeFrame:
    """One cube: centre ``(3,)``, edge length in scene units, rotation ``(3, 3)`` cube-to-world."""

    center: FloatArray
    edge_length: float
    rotation: FloatArray = field(default_factory=lambda: np.eye(3))

    def __post_init__(self) -> None:
        object.__setattr__(self, "center", np.asarray(self.center, dtype=np.float64))
        object.__setattr__(self, "rotation", np.asarray(self.rotation, dtype=np.float64))
        if self.center.shape != (3,):
            raise InvalidArgument(f"CubeFrame: center must have shape (3,), got {self.center.shape}")
        if not (np.isfinite(self.edge_length) and self.edge_length > 0):
            raise InvalidArgument(f"CubeFrame: edge_length must be finite and > 0, got {self.edge_length}")
        if self.rotation.shape != (3, 3) or not np.allclose(self.rotation @ self.rotation.T, np.eye(3), atol=1e-6):
            raise InvalidArgument("CubeFrame: rotation must be an orthonormal (3, 3) matrix")

    def lattice(self, resolution: int = RESOLUTION) -> FloatArray:
        """World positions of the voxel centres, ``(R, R, R, 3)``."""
        return cube_lattices(
            self.center[None], np.array([self.edge_length]), self.rotation[None], resolution=resolution
        )[0]

    def to_local(self, positions: NDArray[np.floating]) -> FloatArray:
        """World ``(..., 3)`` to cube coordinates, the cube being [-1/2, 1/2]^3."""
        local: FloatArray = (np.asarray(positions, dtype=np.float64) - self.center) @ self.rotation / self.edge_length
        return local

    def voxel_index(self, positions: NDArray[np.floating], resolution: int = RESOLUTION) -> NDArray[np.int64]:
        """Index ``[i, j, k]`` of the voxel that holds each position; outside the cube it is out of range."""
        index: NDArray[np.int64] = np.floor((self.to_local(positions) + 0.5) * resolution).astype(np.int64)
        return index
