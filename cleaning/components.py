"""Connected components of a voxel grid in plain numpy: the base install has no scipy."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]


def neighbour_steps(connectivity: int) -> list[tuple[int, int, int]]:
    """Half of the neighbours of a voxel (the other half are their opposites): 3 for 6, 13 for 26."""
    if connectivity not in (6, 26):
        raise ValueError(f"neighbour_steps: connectivity must be 6 or 26, got {connectivity}")
    span = (-1, 0, 1)
    steps = [(x, y, z) for x, y, z in itertools.product(span, span, span) if (x, y, z) > (0, 0, 0)]
    return [step for step in steps if connectivity == 26 or sum(map(abs, step)) == 1]


def label_components(occupied: Mask, *, connectivity: int = 26) -> tuple[NDArray[np.int64], int]:
    """Label connected voxels.

    Args:
        occupied: ``(X, Y, Z)`` bool.
        connectivity: 6 (faces) or 26 (faces, edges, corners).

    Returns:
        labels ``(X, Y, Z)``: 0 where empty, else 1 … count, in the order of each component's first voxel
        (C order, as scipy's); and the count.

    Example:
        >>> occupied = np.zeros((4, 4, 4), dtype=bool)
        >>> occupied[0, 0, :2] = occupied[3, 3, 3] = True
        >>> labels, count = label_components(occupied)
        >>> count, labels[0, 0].tolist()
        (2, [1, 1, 0, 0])
    """
    padded = np.pad(occupied, 1)  # so that a step never leaves the grid
    cells = np.flatnonzero(padded)
    number = np.full(padded.size, -1, dtype=np.int64)
    number[cells] = np.arange(cells.size)
    edges = []
    for step in neighbour_steps(connectivity):
        other = number[cells + int(np.dot(step, [padded.shape[1] * padded.shape[2], padded.shape[2], 1]))]
        touching = np.flatnonzero(other >= 0)
        edges.append(np.stack([touching, other[touching]]))
    parent = _join(cells.size, np.concatenate(edges, axis=1))
    roots, compact = np.unique(parent, return_inverse=True)
    labels = np.zeros(occupied.shape, dtype=np.int64)
    labels[occupied] = compact + 1
    return labels, len(roots)


def _join(count: int, edges: NDArray[np.int64]) -> NDArray[np.int64]:
    """Smallest node number reachable from each node: hooking and pointer jumping, a logarithmic number of rounds."""
    parent = np.arange(count)
    while edges.size:
        first, second = parent[edges[0]], parent[edges[1]]
        differ = first != second
        edges, first, second = edges[:, differ], first[differ], second[differ]
        np.minimum.at(parent, np.maximum(first, second), np.minimum(first, second))
        while True:
            jumped = parent[parent]
            if np.array_equal(jumped, parent):
                break
            parent = jumped
    return parent


def dilate(mask: Mask) -> Mask:
    """``mask (X, Y, Z)`` and all its 26-neighbours.

    Example:
        >>> occupied = np.zeros((3, 3, 3), dtype=bool)
        >>> occupied[1, 1, 1] = True
        >>> int(dilate(occupied).sum())
        27
    """
    grown = mask.copy()
    for axis in range(3):
        step = grown.copy()
        low: list[slice] = [slice(None)] * 3
        high: list[slice] = [slice(None)] * 3
        low[axis], high[axis] = slice(None, -1), slice(1, None)
        step[tuple(high)] |= grown[tuple(low)]
        step[tuple(low)] |= grown[tuple(high)]
        grown = step
    return grown
