"""Pitch of nerfacto's hash cells. Imports neither nerfstudio nor torch."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.errors import InvalidArgument

CONTRACTED_SIDE = 4.0  # of the cube [-2, 2]^3 that all space is contracted into

SURFACE_SHARE = 8  # a scene's surfaces touch about 8 n^2 of the n^3 corners: six faces of the cube, one to two deep


def surface_cells(log2_hashmap_size: int) -> int:
    """Cells along an axis of the finest level at which surfaces still fit into a hash table without collisions.

    ``8 n^2 = 2^log2_hashmap_size``: 256 for nerfacto's 2^19 entries. On finer levels dozens of places of the surface
    share an entry (64 at nerfacto's 2048), so a place alone cannot be emptied there, and the density does not follow
    single cells. nerfacto's proposal networks, which are regularized with it, have 128 and 256 cells as well: sight
    lines that end two cells of the finest level before their points would end inside theirs.

    A count by the sizes of the tables; how fine a trained density is has not been measured.

    Args:
        log2_hashmap_size: nerfacto's.

    Raises:
        ValueError: it is < 3.

    Example:
        >>> surface_cells(19), surface_cells(21)
        (256, 512)
    """
    if log2_hashmap_size < 3:
        raise InvalidArgument(f"surface_cells: log2_hashmap_size must be >= 3, got {log2_hashmap_size}")
    return math.isqrt((1 << log2_hashmap_size) // SURFACE_SHARE)


def hash_pitch(
    max_res: int, aabb: NDArray[Any], *, contracted: bool
) -> float | Callable[[NDArray[np.float64]], NDArray[np.float64]]:
    """Side of a cell of one of nerfacto's hash levels, scene units.

    With scene contraction the level covers [-2, 2]^3, so a cell in [-1, 1]^3 measures ``4 / max_res``. Farther out,
    ``x -> (2 - 1/|x|) x/|x|`` (largest coordinate as the norm) makes it deeper and wider than that: the side returned
    is that of a cube of the same volume. Without contraction the level covers the box; cells of a box that is no cube
    are measured by their volume as well.

    Args:
        max_res: cells along an axis: nerfacto's ``max_res``, or fewer for a coarser level.
        aabb: ``(2, 3)`` the scene box.
        contracted: not ``disable_scene_contraction``.

    Returns:
        A number, or for a contracted box that exceeds [-1, 1]^3 a function of places ``(N, 3)`` that returns ``(N,)``.

    Raises:
        ValueError: ``max_res`` < 1.

    Example:
        >>> hash_pitch(2048, np.array([[-1.0] * 3, [1.0] * 3]), contracted=True)
        0.001953125
    """
    if max_res < 1:
        raise InvalidArgument(f"hash_pitch: max_res must be >= 1, got {max_res}")
    if not contracted:
        return float(np.prod(aabb[1] - aabb[0]) ** (1 / 3)) / max_res
    cell = CONTRACTED_SIDE / max_res
    if np.abs(aabb).max() <= 1.0:
        return cell

    def pitch(places: NDArray[np.float64]) -> NDArray[np.float64]:
        norm = np.maximum(np.abs(places).max(axis=-1), 1.0)
        radial, across = norm**2, norm / (2.0 - 1.0 / norm)  # inverse derivatives of the contraction
        stretched: NDArray[np.float64] = cell * np.cbrt(radial * across**2)
        return stretched

    return pitch
