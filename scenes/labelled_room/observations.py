"""Cameras in the demo's room, and simulated sparse points of its surfaces."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...core.cameras import Cameras, look_at
from ...core.errors import InvalidArgument
from ...core.interpolate import interpolate_grid
from ...core.lattice import look_up_cells
from ...core.sparse_points import SparsePoints
from ..sparse_points import TWO_VIEW_SHARE, triangulate_noisy, with_wrong_points
from .ghosts import smooth_noise
from .room import AABB, SHAPE, Room

Floats = NDArray[np.float64]

WIDTH, HEIGHT, FOCAL = 640, 480, 460.0
STEPS = 160  # places between a camera and a point where something may be in the way
REPEATABILITY = 0.4
CLEARANCE = 0.15  # metres between a camera and anything solid


def room_cameras(room: Room, count: int = 24, *, seed: int = 0) -> Cameras:
    """Cameras of a walk round the room, looking across it.

    Args:
        room: the room; cameras keep clear of its solids.
        count: how many.
        seed: seed for the walk.

    Example:
        >>> from .room import build_room
        >>> len(room_cameras(build_room(0), 5))
        5
    """
    rng = np.random.default_rng([seed, 2])
    angles = rng.uniform(0, 2 * np.pi) + np.linspace(0, 2 * np.pi, count, endpoint=False)
    heights, lean = rng.uniform(1.1, 1.9, count), rng.uniform(-0.5, 0.5, size=(count, 2))
    origins = np.zeros((count, 3))
    for radius in np.linspace(2.1, 0.3, 19):  # as far out as there is room
        places = np.stack([radius * np.cos(angles), radius * np.sin(angles), heights], axis=1)
        clear = (_distance(room, places) > CLEARANCE) & (origins == 0).all(axis=1)
        origins[clear] = places[clear]
    targets = np.stack([*(-0.4 * origins[:, :2] + lean).T, rng.uniform(0.3, 0.9, count)], axis=1)
    return Cameras.create(look_at(origins, targets), np.array([FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2]), WIDTH, HEIGHT)


def room_points(
    room: Room, cameras: Cameras, count: int = 3000, *, seed: int = 0, noise: float = 0.7, wrong: float = 0.03
) -> SparsePoints:
    """Simulated sparse points: on the textured half of the surfaces, where two cameras or more see them.

    Ghosts have none, because nothing is there that photos could match.

    Args:
        room: the room.
        cameras: of the photos.
        count: of points at most; fewer where few surfaces are seen.
        seed: seed for every draw.
        noise: standard deviation of a keypoint, pixels.
        wrong: share of wrong points, in [0, 1).

    Raises:
        ValueError: a count < 1 or a share out of range.

    Example:
        >>> from .room import build_room
        >>> room = build_room(0)
        >>> points = room_points(room, room_cameras(room), 200)
        >>> 150 < len(points) < 250, bool(points.views().min() >= 2)
        (True, True)
    """
    if count < 1 or not 0 <= wrong < 1:
        raise InvalidArgument(f"room_points: count must be >= 1 and wrong in [0, 1), got {count} and {wrong}")
    rng = np.random.default_rng([seed, 3])
    textured = smooth_noise(rng, SHAPE, 6.0) > 0
    cells = np.argwhere((np.abs(room.distance) < room.pitch) & textured)
    cells = cells[rng.integers(len(cells), size=8 * count)]
    places = _onto_surface(room, AABB[0] + (cells + rng.random(cells.shape)) * room.pitch)
    point, camera = _observations(rng, room, places, cameras)
    points = triangulate_noisy(rng, places, point, camera, true=cameras, told=cameras, noise=noise)
    if len(points) > count:
        points = points.select(np.sort(rng.choice(len(points), count, replace=False)))
    return with_wrong_points(rng, points, cameras, wrong)


def _distance(room: Room, places: Floats) -> Floats:
    """Interpolated signed distance ``(...)``, metres."""
    local = (places - AABB[0]) / room.pitch - 0.5
    return np.asarray(interpolate_grid(room.distance, local.astype(np.float32)), dtype=np.float64)


def _onto_surface(room: Room, places: Floats) -> Floats:
    """Places moved along the gradient of the distance; those that do not arrive are left out."""
    step = room.pitch / 2
    for _ in range(3):
        here = _distance(room, places)
        slopes = [_distance(room, places + step * axis) - _distance(room, places - step * axis) for axis in np.eye(3)]
        gradient = np.stack(slopes, axis=1) / (2 * step)
        places = places - here[:, None] * gradient / np.maximum((gradient**2).sum(axis=1, keepdims=True), 0.25)
    arrived: Floats = places[np.abs(_distance(room, places)) < 0.1 * room.pitch]
    return arrived


def _observations(
    rng: np.random.Generator, room: Room, places: Floats, cameras: Cameras
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Which cameras match which places, ``(M,)`` each: those that see them, now and then."""
    whose, who = [], []
    for index in range(len(cameras)):
        seen = cameras.sees(np.full(len(places), index), places) & (rng.random(len(places)) < REPEATABILITY)
        chosen = np.flatnonzero(seen)
        start = cameras.origins[index]
        length = np.linalg.norm(places[chosen] - start, axis=1)
        reach = 1.0 - 2.5 * room.pitch / np.maximum(length, 3 * room.pitch)
        share = np.linspace(0.0, 1.0, STEPS)[:, None, None] * reach[:, None]
        between = start + share * (places[chosen] - start)
        inside = look_up_cells(room.distance < 0, between, aabb=AABB, pitch=room.pitch, outside=False)
        whose.append(chosen[~inside.any(axis=0)])
        who.append(np.full(len(whose[-1]), index))
    point, camera = np.concatenate(whose), np.concatenate(who)
    views = np.bincount(point, minlength=len(places))
    kept = (views >= 3) | ((views == 2) & (rng.random(len(places)) < TWO_VIEW_SHARE))
    return point[kept[point]], camera[kept[point]]
