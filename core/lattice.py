"""Lattices of cubic cells over a box: where their centres lie, and which cell holds a position."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .aabb import as_aabb
from .errors import InvalidArgument


def cell_centers(aabb: ArrayLike, shape: tuple[int, int, int]) -> NDArray[np.float32]:
    """Centres of the cells of a grid that fills ``aabb``, ``(*shape, 3)`` float32, index order ``[x, y, z]``."""
    box = as_aabb(aabb, caller="cell_centers")
    axes = [low + (np.arange(n) + 0.5) * (high - low) / n for low, high, n in zip(box[0], box[1], shape)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).astype(np.float32)


def cell_pitch(aabb: ArrayLike, shape: tuple[int, ...], *, caller: str = "cell_pitch") -> float:
    """Side of the cells, scene units.

    Raises:
        ValueError: the cells are not cubes (sides differ by more than 1 %).
    """
    box = as_aabb(aabb, caller=caller)
    sides = (box[1] - box[0]) / np.array(shape, dtype=float)
    if sides.max() > 1.01 * sides.min():
        raise InvalidArgument(
            f"{caller}: aabb and grid must make cubic cells (to 1 %), got sides {sides.round(6).tolist()}"
        )
    return float(sides.mean())


def lattice_origin(aabb: NDArray[np.float64], pitch: float, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Lowest corner ``(3,)`` of ``shape`` cells of side ``pitch`` centred on the box."""
    middle: NDArray[np.float64] = (aabb[0] + aabb[1]) / 2 - np.array(shape) * pitch / 2
    return middle


def look_up_cells(
    cells: NDArray[Any], positions: NDArray[np.float64], *, aabb: NDArray[np.float64], pitch: float, outside: Any
) -> NDArray[Any]:
    """The value of the cell that holds each of ``positions (..., 3)``; ``outside`` where none does, or not finite."""
    inside = ((positions >= aabb[0]) & (positions <= aabb[1])).all(axis=-1)
    local = np.where(inside[..., None], positions - lattice_origin(aabb, pitch, cells.shape), 0.0)
    index = np.clip(np.floor(local / pitch).astype(np.int64), 0, np.array(cells.shape) - 1)
    values: NDArray[Any] = np.where(inside, cells[tuple(np.moveaxis(index, -1, 0))], outside)
    return values


def lattice_axes(aabb: NDArray[np.float64], pitch: float, shape: tuple[int, ...]) -> list[NDArray[np.float64]]:
    """Coordinates of the cells' centres along each axis, scene units."""
    origin = lattice_origin(aabb, pitch, shape)
    return [origin[axis] + (np.arange(length) + 0.5) * pitch for axis, length in enumerate(shape)]


def cells_within(axes: list[NDArray[np.float64]], box: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which cells ``(X, Y, Z)`` have their centre in a box ``(2, 3)``."""
    x, y, z = ((axis >= low) & (axis <= high) for axis, low, high in zip(axes, box[0], box[1]))
    within: NDArray[np.bool_] = x[:, None, None] & y[:, None] & z
    return within
