"""Connected components of a voxel grid, by scipy where it is installed, and dilation.

The base install has no scipy, so ``label_components`` has a fallback in numpy with the same labels. Measured on one
core, grids with about a tenth of the cells occupied, from random cells to thick shells: ``scipy.ndimage.label`` is 1.6
to 9 times as fast at 64^3 and 2 to 11 times at 128^3 (12 ms instead of 129 ms for a shell among specks).

``dilate`` is written in numpy on purpose: six shifted ORs take 0.8 ms at 128^3, ``scipy.ndimage.binary_dilation``
25 to 30 ms, ``maximum_filter`` 27 to 40 ms.
"""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InvalidArgument

Mask = NDArray[np.bool_]


def _neighbour_steps(connectivity: int) -> list[tuple[int, int, int]]:
    """Half of the neighbours of a voxel (the other half are their opposites): 3 for 6, 13 for 26."""
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
        (C order); and the count.

    Raises:
        ValueError: another connectivity.

    Example:
        >>> occupied = np.zeros((4, 4, 4), dtype=bool)
        >>> occupied[0, 0, :2] = occupied[3, 3, 3] = True
        >>> labels, count = label_components(occupied)
        >>> count, labels[0, 0].tolist()
        (2, [1, 1, 0, 0])
    """
    if connectivity not in (6, 26):
        raise InvalidArgument(f"label_components: connectivity must be 6 or 26, got {connectivity}")
    try:
        from scipy import ndimage
    except ImportError:
        return _label_in_numpy(occupied, connectivity)
    structure = ndimage.generate_binary_structure(3, 1 if connectivity == 6 else 3)
    cells = np.ascontiguousarray(occupied)  # scipy numbers along the axis of the smallest stride
    labels, count = ndimage.label(cells, structure, output=np.int64)
    return labels, int(count)


def _label_in_numpy(occupied: Mask, connectivity: int) -> tuple[NDArray[np.int64], int]:
    """The same labels without scipy."""
    padded = np.pad(occupied, 1)  # so that a step never leaves the grid
    cells = np.flatnonzero(padded)
    number = np.full(padded.size, -1, dtype=np.int64)
    number[cells] = np.arange(cells.size)
    edges = []
    for step in _neighbour_steps(connectivity):
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
