"""Opacity and evidence in and around a harvested cube. View counts: :mod:`unghost.core.visibility.view_counts`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.aabb import contains
from ...core.channels import evidence_share, pool_surroundings, surroundings_lattice
from ...core.occupancy import EMPTY, opacity_from_density, signed_from_opacity
from ...core.shards.packing import quantize_share
from ...core.sight_lines import SightLines

DensityFn = Callable[[NDArray[Any]], NDArray[np.float32]]


def signed_opacity(
    density_fn: DensityFn,
    lattice: NDArray[np.float64],
    pitch: NDArray[np.float64],
    aabb: NDArray[np.float64],
) -> NDArray[np.float32]:
    """Signed opacity at the points of some cubes, empty outside the box.

    Args:
        density_fn: ``(M, 3)`` float32 to ``(M,)``, per scene unit.
        lattice: ``(N, R, R, R, 3)``.
        pitch: ``(N,)``, what a cell is taken to measure, scene units.
        aabb: ``(2, 3)``.

    Returns:
        ``(N, R, R, R)`` float32 in [-1, 1].
    """
    density = density_fn(lattice.reshape(-1, 3).astype(np.float32)).reshape(lattice.shape[:-1])
    signed: NDArray[np.float32] = signed_from_opacity(opacity_from_density(density, pitch[:, None, None, None]))
    signed = signed.astype(np.float32)
    signed[~contains(aabb, lattice)] = EMPTY
    return signed


def surroundings(
    density_fn: DensityFn,
    centers: NDArray[np.float64],
    edges: NDArray[np.float64],
    rotations: NDArray[np.float64],
    pitch: NDArray[np.float64],
    aabb: NDArray[np.float64],
) -> NDArray[np.float32]:
    """The mean signed opacity of 16^3 voxels over a cube of three times the edge, same centre and rotation.

    Each is the mean over 2 x 2 x 2 points (:func:`unghost.core.channels.surroundings_lattice`).

    Args:
        density_fn, pitch, aabb: as :func:`signed_opacity` has them.
        centers, edges, rotations: ``(N, 3)``, ``(N,)``, ``(N, 3, 3)`` of the cubes (not of their surroundings).

    Returns:
        ``(N, 16, 16, 16)`` float32 in [-1, 1].
    """
    lattice = surroundings_lattice(centers, edges, rotations)
    return pool_surroundings(signed_opacity(density_fn, lattice, pitch, aabb))


def evidence(lines: SightLines, lattice: NDArray[np.float64]) -> dict[str, NDArray[np.uint8]]:
    """Sparse points and sight lines at the points of some cubes, as a shard stores them.

    Args:
        lines: on a grid of the field's own pitch.
        lattice: ``(N, R, R, R, 3)``.

    Returns:
        ``support`` and ``crossings``, ``(N, R, R, R)`` uint8.
    """
    return {
        "support": quantize_share(evidence_share(lines.support(lattice))),
        "crossings": quantize_share(evidence_share(lines.crossings(lattice))),
    }
