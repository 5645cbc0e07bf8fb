"""The demo's patient: a furnished room of known geometry, and ghosts whose place is known.

numpy, and scipy's Gaussian filter; the unit is the metre.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...core.errors import InvalidArgument
from ...core.lattice import cell_centers, cell_pitch
from ...core.occupancy import OccupancyRule
from .furniture import Floats, Solid, solids
from .ghosts import add_ghosts, sigmoid, smooth_noise

AABB = np.array([[-2.56, -2.56, -0.16], [2.56, 2.56, 2.40]])
SHAPE = (128, 128, 64)
FAR = 0.6  # metres; distances are exact up to here and stop here


@dataclass(frozen=True)
class Room:
    """The demo's volume, all arrays ``(X, Y, Z)``.

    Attributes:
        true_density: of the field without ghosts, per metre.
        density: with ghosts.
        ghost_kind: int8, -1 where no ghost was put, else an index into ``demo_ghosts.KINDS``.
        distance: signed distance to the true solids, metres.
        color: ``(X, Y, Z, 3)`` in [0, 1].

    Example:
        >>> density, color = np.zeros((2, 2, 2), np.float32), np.zeros((2, 2, 2, 3), np.float32)
        >>> density[0], ghost_kind = 50.0, np.full((2, 2, 2), -1, np.int8)
        >>> room = Room(density, density, ghost_kind, np.ones_like(density), color)
        >>> int(room.surface(OccupancyRule()).sum())
        4
    """

    true_density: Floats
    density: Floats
    ghost_kind: NDArray[np.int8]
    distance: Floats
    color: Floats

    @property
    def pitch(self) -> float:
        """Side of a cell, metres."""
        return cell_pitch(AABB, SHAPE)

    def surface(self, rule: OccupancyRule) -> NDArray[np.bool_]:
        """Cells that the field without ghosts occupies."""
        return np.asarray(rule.occupied(self.true_density, self.pitch))

    def occupied(self, rule: OccupancyRule) -> NDArray[np.bool_]:
        """Cells that the field with ghosts occupies."""
        return np.asarray(rule.occupied(self.density, self.pitch))


def field_density(rng: np.random.Generator, distance: Floats, pitch: float) -> Floats:
    """What training leaves at a surface: an uneven skin about two cells thick, hollow behind it.

    The skin's place wavers by an eighth of a cell and its optical depth per cell by a third around 2.2.
    """
    depth = distance / pitch + 0.12 * smooth_noise(rng, SHAPE, 2.0)
    skin = sigmoid(-depth / 0.2) * sigmoid((depth + 1.0) / 0.2)
    return np.asarray(skin * 2.2 * np.exp(0.33 * smooth_noise(rng, SHAPE, 3.0)) / pitch, dtype=np.float32)


def _windows(solid: Solid, positions: Floats, pitch: float, stride: int = 4) -> tuple[slice, slice, slice] | None:
    """The cells that may lie within ``FAR`` of a solid, from a look at every ``stride``-th one."""
    coarse = np.asarray(solid.distance(positions[::stride, ::stride, ::stride]))
    near = np.argwhere(coarse < FAR + stride * pitch * np.sqrt(3.0))
    if not len(near):
        return None
    low, high = near.min(axis=0) * stride, near.max(axis=0) * stride + stride
    x, y, z = (slice(int(a), int(b)) for a, b in zip(low, high))
    return x, y, z


def _merge(every: list[Solid], positions: Floats, pitch: float) -> tuple[Floats, Floats]:
    """Distance to the nearest solid, at most ``FAR``, and that solid's colour."""
    distance = np.full(SHAPE, FAR, dtype=np.float32)
    color = np.full((*SHAPE, 3), 0.8, dtype=np.float32)
    for solid in every:
        window = _windows(solid, positions, pitch)
        if window is None:
            continue
        own = np.asarray(solid.distance(positions[window]), dtype=np.float32)
        nearer = own < distance[window]
        distance[window][nearer] = own[nearer]
        color[window][nearer] = solid.color
    return distance, color


def build_room(seed: int = 0) -> Room:
    """The room and its ghosts; the same for the same ``seed``.

    Raises:
        ValueError: ``seed`` is negative.
    """
    if seed < 0:
        raise InvalidArgument(f"build_room: seed must be >= 0, got {seed}")
    rng = np.random.default_rng([seed, 0])
    positions, pitch = cell_centers(AABB, SHAPE), cell_pitch(AABB, SHAPE)
    distance, color = _merge(solids(rng), positions, pitch)
    true_density = field_density(rng, distance, pitch)
    ghosts, kind = add_ghosts(np.random.default_rng([seed, 1]), positions, distance, pitch)
    return Room(true_density, true_density + ghosts, kind, distance, color)
