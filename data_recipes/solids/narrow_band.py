"""A cube's voxels from a signed distance that is asked only near the surface.

A signed distance changes by no more than the way moved, so that its value at the middle of a block of voxels
tells whether a surface can cross any of them. Where it cannot, none of the block's voxels is ever asked.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.errors import InvalidArgument
from ...core.frames import RESOLUTION, unit_lattice
from .primitives import Solid

Array = NDArray[Any]
Occupancy = NDArray[np.bool_]

_SIDE = 4  # voxels along a block
_SLACK = 1.06  # distances may be a few percent too steep
_PADDED = RESOLUTION + 2


def _in_blocks(volume: Array) -> Array:
    """``(R, R, R, ...)`` reordered to ``(blocks, voxels of a block, ...)``."""
    count = RESOLUTION // _SIDE
    split = volume.reshape(count, _SIDE, count, _SIDE, count, _SIDE, *volume.shape[3:])
    return np.moveaxis(split, (0, 2, 4), (0, 1, 2)).reshape(count**3, _SIDE**3, *volume.shape[3:])


_MIDDLES = np.ascontiguousarray(_in_blocks(unit_lattice()).mean(axis=1).T)  # (3, blocks), in edges
_WITHIN = np.ascontiguousarray((_in_blocks(unit_lattice())[0] - _MIDDLES[:, 0]).T)  # (3, voxels of a block)
_PLACES = _in_blocks(np.arange(RESOLUTION**3).reshape((RESOLUTION,) * 3))  # in the cube's flat order
_WHOLE = np.pad(np.arange(RESOLUTION**3).reshape((RESOLUTION,) * 3), 1, constant_values=-1).reshape(-1)
_PADDED_PLACES = np.flatnonzero(_WHOLE >= 0)  # of the flat order, in the cube with one more voxel on each side
_BLOCK_PLACES = _PADDED_PLACES[_PLACES]
_LATTICE = np.ascontiguousarray(np.moveaxis(unit_lattice().reshape(-1, 3), -1, 0))
_STRIDES = np.array([_PADDED**2, _PADDED, 1])
_STEPS = np.stack([_STRIDES, -_STRIDES])[:, :, None]


def shell_in_cube(distance: Solid, *, thickness: float = 1.0, solid: bool = False) -> Occupancy:
    """Voxels that a surface crosses: :func:`compose.shell_from_distance` on a cube's lattice, most of it unasked.

    Args:
        distance: ``positions (N, 3) -> (N,)`` in cube coordinates, the cube being [-1/2, 1/2]^3; signed, in edges,
            1-Lipschitz (6 percent of slack). The positions' axes come first in memory, several times as fast.
        thickness: 1 marks the voxels that a plane would cross.
        solid: mark the inside too.

    Returns:
        ``(32, 32, 32)`` bool.

    Raises:
        ValueError: a thickness out of range.
    """
    if not 0 < thickness < np.inf:
        raise InvalidArgument(f"shell_in_cube: thickness must be finite and > 0, got {thickness}")
    widest = 1.5 * thickness * _SLACK / RESOLUTION  # three slopes of 1, half of it on each side
    coarse = distance(_MIDDLES.T)
    reach = widest + _SLACK * (_SIDE - 1) / 2 * np.sqrt(3.0) / RESOLUTION
    active = np.flatnonzero(np.abs(coarse) <= reach)
    fine = distance((_MIDDLES[:, active, None] + _WITHIN[:, None]).reshape(3, -1).T)
    places = _BLOCK_PLACES[active].reshape(-1)
    volume = np.full(_PADDED**3, np.nan, dtype=np.float32)
    volume[places] = fine
    candidates = places[np.abs(fine) <= widest]
    beside = _beside(volume, candidates, distance)
    own = volume[candidates]
    slopes = np.fmax(np.abs(beside[0] - own), np.abs(own - beside[1])).sum(axis=0)  # fmax passes over NaN

    occupancy = np.zeros(RESOLUTION**3, dtype=bool)
    occupancy[_WHOLE[candidates[np.abs(own) <= 0.5 * thickness * slopes]]] = True
    if solid:
        inside = coarse < 0
        inside[active] = False
        occupancy[_PLACES[inside].reshape(-1)] = True
        occupancy[_PLACES[active].reshape(-1)[fine < 0]] = True
    return occupancy.reshape((RESOLUTION,) * 3)


def _beside(volume: Array, places: Array, distance: Solid) -> Array:
    """Values after and before ``places (M,)`` along each axis, ``(2, 3, M)``; NaN beyond the cube.

    Where they lie in blocks left out they are asked now.
    """
    where = places + _STEPS
    values: Array = volume[where]
    unknown = np.flatnonzero(np.isnan(values))
    lattice = _WHOLE[where.reshape(-1)[unknown]]
    missing = lattice >= 0
    if missing.any():
        values.reshape(-1)[unknown[missing]] = distance(_LATTICE[:, lattice[missing]].T)
    return values
