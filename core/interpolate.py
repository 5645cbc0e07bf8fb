"""Trilinear interpolation on a regular grid, for numpy arrays and torch tensors.

The one owner of the convention. A grid has the index order ``[x, y, z]``; its values stand at nodes, node ``[i, j, k]``
at the coordinates ``(i, j, k)``. A cell lies between eight neighbouring nodes; they are listed in the order 000, 001,
.., 111 of ``xyz``, and the weight of each is ``(x * y) * z``, each factor ``1 - share`` or ``share``.

::

    node-centred: values on the faces of the box     cell-centred: values at the centres of cells
    |o-----o-----o-----o|                            |  o  |  o  |  o  |  o  |
     0     1     2     3    coordinate               -.5   0  .5  1     2     3 3.5

For values at cell centres, subtract one half: ``coordinates = (positions - low) / pitch - 0.5``.

Sparse products and hash tables take the corners themselves (:func:`trilinear_corners`, :func:`lower_nodes`,
:func:`corner_weights`); everything else calls :func:`interpolate_grid`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from .arrays import Array, is_tensor, namespace
from .errors import InvalidArgument, InvalidType


def lower_nodes(columns: Sequence[Array], shape: Sequence[int]) -> tuple[list[Array], list[Array]]:
    """Lower node of the cell around each position, and the position in that cell.

    Beyond the grid the cell is the nearest one, and the share leaves [0, 1]. A NaN has node 0 and a share of NaN.

    Args:
        columns: for each axis the coordinates ``(...)``, in node units.
        shape: nodes along x, y and z, each >= 1; an axis of one node has one cell of no width.

    Returns:
        For each axis the node ``(...)``, as floating-point numbers, and the share ``(...)``.

    Example:
        >>> nodes, shares = lower_nodes([np.array([0.25, 1.0, 3.5])] * 3, (2, 2, 3))
        >>> nodes[2], shares[2]
        (array([0., 1., 1.]), array([0.25, 0.  , 2.5 ]))
    """
    module = namespace(columns[0])
    nodes = [
        module.clip(module.nan_to_num(module.floor(column), nan=0.0), 0, max(length - 2, 0))
        for column, length in zip(columns, shape)
    ]
    return nodes, [column - node for column, node in zip(columns, nodes)]


def corner_weights(shares: Sequence[Array]) -> list[Array]:
    """Trilinear weights ``(...)`` of a cell's eight corners 000, 001, .., 111.

    One long product a corner is five times as fast on a CPU as broadcasting over (N, 2, 2, 2).

    Args:
        shares: for each axis ``(...)``, the position in the cell, in [0, 1] within it.

    Example:
        >>> x, y, z = np.array([0.25]), np.array([0.0]), np.array([0.5])
        >>> np.stack(corner_weights([x, y, z]), axis=-1)
        array([[0.375, 0.375, 0.   , 0.   , 0.125, 0.125, 0.   , 0.   ]])
    """
    x, y, z = ((1.0 - share, share) for share in shares)
    return [first * last for one in x for two in y for first in (one * two,) for last in z]


def _flat_corners(columns: Sequence[Array], shape: Sequence[int]) -> tuple[Array, list[int], list[Array]]:
    """Flat index ``(...)`` of the lowest corner, what to add for each of the eight, and the shares."""
    nodes, shares = lower_nodes(columns, shape)
    if is_tensor(columns[0]):  # int32 is half the memory traffic, and what a compressed-row product takes
        torch = namespace(columns[0])
        integer = torch.int32 if np.prod(shape, dtype=np.int64) < 2**31 else torch.int64
        x, y, z = (node.to(integer) for node in nodes)
    else:
        x, y, z = (node.astype(np.int64) for node in nodes)
    strides = (shape[1] * shape[2], shape[2], 1)
    steps = [(0, stride if length > 1 else 0) for stride, length in zip(strides, shape)]
    offsets = [i + j + k for i in steps[0] for j in steps[1] for k in steps[2]]
    return (x * shape[1] + y) * shape[2] + z, offsets, shares


def _columns(coordinates: Array) -> list[Array]:
    return [coordinates[..., axis] for axis in range(3)]


def trilinear_corners(coordinates: Array, shape: Sequence[int]) -> tuple[Array, Array]:
    """Flat indices and trilinear weights of the eight nodes around each position.

    Beyond the grid the nearest cell is extrapolated: weights leave [0, 1] and still add up to 1.

    Args:
        coordinates: ``(..., 3)`` numpy array or tensor, in node units.
        shape: nodes along x, y and z.

    Returns:
        ``(..., 8)`` each. The index is int64; that of a tensor int32 if the grid has fewer than 2^31 nodes. The
        weights have the coordinates' type, and for tensors their gradient.

    Example:
        >>> index, weights = trilinear_corners(np.array([0.5, 0.0, 1.0]), (2, 2, 3))
        >>> float(weights @ np.arange(12.0)[index])  # half way from node 1 to node 7
        4.0
    """
    module = namespace(coordinates)
    base, offsets, shares = _flat_corners(_columns(coordinates), shape)
    return module.stack([base + offset for offset in offsets], -1), module.stack(corner_weights(shares), -1)


def interpolate_grid(values: Array, coordinates: Array, *, dtype: Any = None) -> Array:
    """Interpolate a grid trilinearly; beyond its outermost nodes the nearest value holds.

    Args:
        values: ``(X, Y, Z)`` or ``(X, Y, Z, C)`` numpy array or tensor, floating-point.
        coordinates: ``(..., 3)`` in node units, of the same library. A NaN gives NaN.
        dtype: of the weights; None for that of the values.

    Returns:
        ``(...)`` or ``(..., C)``. For tensors differentiable in the values and, except at the nodes, where the
        derivative jumps, in the coordinates (0 beyond the grid).

    Raises:
        ValueError: values or coordinates of another shape.
        TypeError: one is a numpy array and the other a tensor.

    Example:
        >>> grid = np.array([[[0.0]], [[4.0]]])  # two nodes along x
        >>> interpolate_grid(grid, np.array([[0.25, 0.0, 0.0], [9.0, 0.0, 0.0]]))
        array([1., 4.])
    """
    if is_tensor(values) != is_tensor(coordinates):
        raise InvalidType("interpolate_grid: values and coordinates must both be numpy arrays or both be tensors")
    shape = tuple(values.shape[:3])
    if values.ndim not in (3, 4) or 0 in shape:
        raise InvalidArgument(
            f"interpolate_grid: values must have shape (X, Y, Z) or (X, Y, Z, C), got {tuple(values.shape)}"
        )
    if coordinates.ndim < 1 or coordinates.shape[-1] != 3:
        raise InvalidArgument(f"interpolate_grid: coordinates must have shape (..., 3), got {tuple(coordinates.shape)}")
    module = namespace(values)
    within = [module.clip(column, 0, length - 1) for column, length in zip(_columns(coordinates), shape)]
    base, offsets, shares = _flat_corners(within, shape)
    wanted = values.dtype if dtype is None else dtype
    shares = [share.to(wanted) if is_tensor(share) else share.astype(wanted) for share in shares]
    flat = values.reshape(-1, *values.shape[3:])
    total: Array = 0
    for offset, weight in zip(offsets, corner_weights(shares)):
        total += (weight if values.ndim == 3 else weight[..., None]) * flat[base + offset]
    return total
