"""Local thickness of occupancy cubes, through a distance transform that is exact for odd and even slabs alike."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...core.errors import needs_extra

Values = NDArray[np.float64]
Occupancy = NDArray[np.bool_]


def half_lattice_distance(occupied: Occupancy) -> Values:
    """How far each place in ``occupied (X, Y, Z)`` is from what is empty, in voxels, ``(2X - 1, 2Y - 1, 2Z - 1)``.

    The places are the voxel centres and the midpoints between them; a midpoint is occupied if all the voxels that
    it touches are. A slab of T voxels then has the distance T / 2 in its middle, whether T is odd or even. Beyond the
    array nothing is known: only what is empty inside counts (inf everywhere if nothing is).
    """
    with needs_extra("recipes", caller="thickness"):
        from scipy.ndimage import distance_transform_edt

    fine: Occupancy = occupied
    for axis in range(3):
        fine = np.repeat(fine, 2, axis=axis)
    fine = fine[:-1, :-1, :-1]
    for axis in range(3):
        ahead, between = [slice(None)] * 3, [slice(None)] * 3
        ahead[axis], between[axis] = slice(2, None, 2), slice(1, None, 2)
        fine[tuple(between)] &= fine[tuple(ahead)]
    if fine.all():
        return np.full(fine.shape, np.inf)
    distance: Values = distance_transform_edt(fine) / 2
    return distance


def _summits(distance: NDArray[np.float32]) -> NDArray[np.int32]:
    """Flat index of where the steepest of 26 steps, taken again and again, leads from each place that is > 0, none
    of them on the grid's border; other places lead to themselves."""
    shape, flat = np.array(distance.shape), distance.ravel()
    strides = np.array([shape[1] * shape[2], shape[2], 1])
    places = np.flatnonzero(flat > 0).astype(np.int32)
    here = flat[places]
    steepest, target = np.full(len(places), 1e-6, dtype=np.float32), places.copy()
    for step in np.ndindex(3, 3, 3):
        move = np.array(step) - 1
        if not move.any():
            continue
        candidates = places + np.int32(move @ strides)
        slope = (flat[candidates] - here) * np.float32(1.0 / np.linalg.norm(move))
        better = slope > steepest
        np.copyto(steepest, slope, where=better)
        np.copyto(target, candidates, where=better)
    leads = np.arange(flat.size, dtype=np.int32)
    leads[places] = target
    while True:
        further = leads[target]
        if np.array_equal(further, target):
            return leads
        leads[places] = target = further


def local_thickness(occupied: Occupancy) -> Values:
    """Thickness ``(n,)`` in voxels of the part to which each of the ``n`` occupied voxels belongs, in their order.

    From a voxel one climbs the distance to what is empty (:func:`half_lattice_distance`) until no step leads higher;
    the thickness is the diameter of the ball that fits in there. A slab of T voxels has exactly T, a rod of T x T
    voxels too; of a ball it is up to a voxel or so less than the diameter. What lies beyond the cube counts as empty,
    so that a full cube has R.

    Args:
        occupied: ``(R, R, R)`` bool.
    """
    filled = np.argwhere(occupied)
    if len(filled) == 0:
        return np.zeros(0)
    low, high = filled.min(axis=0), filled.max(axis=0) + 1
    box = np.pad(occupied[low[0] : high[0], low[1] : high[1], low[2] : high[2]], 1)  # the rest cannot matter
    distance = half_lattice_distance(box).astype(np.float32)
    where = np.ravel_multi_index(tuple((2 * (filled - low + 1)).T), distance.shape)
    summits: Values = distance.ravel()[_summits(distance)[where]].astype(np.float64)
    return 2.0 * summits
