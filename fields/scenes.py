"""Random rooms and objects of known geometry, photographed as a person with a phone would."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.cameras import Cameras
from ..core.frames import random_rotations
from .solids import Light, Solid, SolidScene, Texture

Array = NDArray[Any]


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def random_texture(rng: np.random.Generator, *, plainness: float = 0.2) -> Texture:
    """A texture; with probability ``plainness`` it is nearly featureless, as walls are."""
    first = rng.uniform(0.05, 0.95, size=3)
    if rng.random() < plainness:
        second = np.clip(first + rng.normal(0, 0.06, size=3), 0, 1)
        pattern = str(rng.choice(["plain", "gradient", "noise"]))
    else:
        second = rng.uniform(0.05, 0.95, size=3)
        pattern = str(rng.choice(["checker", "stripes", "noise", "noise", "gradient"]))
    gloss = float(rng.choice([0.0, 0.0, 0.15, 0.5]))
    grain = _log_uniform(rng, 0.03, 0.25)
    return Texture(first, second, pattern, _log_uniform(rng, 0.1, 0.7), gloss, grain, rng.uniform(0, 1, size=3))


def _yaw(angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _box(center: Array, half: Array, texture: Texture, rotation: Array | None = None) -> Solid:
    rotation = np.eye(3) if rotation is None else rotation
    return Solid("box", (np.asarray(half),), np.asarray(center), texture, float(np.linalg.norm(half)), rotation)


def _random_shape(rng: np.random.Generator, center: Array, radius: float, rotation: Array) -> Solid:
    """Any single shape of about ``radius``."""
    r = radius
    ratio = rng.uniform(0.15, 1.0, size=3)
    points = np.cumsum(rng.normal(0, 0.5, size=(int(rng.integers(3, 7)), 3)), axis=0) * r
    points -= points.mean(axis=0)
    thin = _log_uniform(rng, 0.03, 0.2) * r
    options: list[tuple[str, tuple[Any, ...], float]] = [
        ("sphere", (r,), r),
        ("ellipsoid", (r * np.maximum(ratio, 0.3),), r * float(np.maximum(ratio, 0.3).max())),
        ("box", (r * ratio,), 1.75 * r),
        ("rounded_box", (r * np.maximum(ratio, 0.2), 0.15 * r), 1.75 * r),
        ("box", (np.array([r, r * ratio[1], thin / 2]),), 1.5 * r),
        ("cylinder", (r * ratio[0], r), 1.5 * r),
        ("cylinder", (thin, r), 1.1 * r + thin),
        ("tube", (r * max(ratio[0], 0.3), 0.5 * thin, r * ratio[1]), 1.6 * r),
        ("torus", (r * 0.8, r * 0.25 * ratio[0]), 1.1 * r),
        ("cone", (r * max(ratio[0], 0.3), r * 1.4), 1.8 * r),
        ("polyline_tube", (points, 0.6 * thin), float(np.linalg.norm(points, axis=1).max()) + thin),
    ]
    shape, parameters, bound = options[int(rng.integers(len(options)))]
    return Solid(shape, parameters, center, random_texture(rng), bound, rotation)


def table(rng: np.random.Generator, floor: Array, height: float) -> list[Solid]:
    """A table or stool: a top on legs, sometimes with things on it. ``floor (3,)`` is where it stands."""
    turn = _yaw(rng.uniform(0, 2 * np.pi))
    half = height * rng.uniform(0.4, 1.2, size=2)
    thick = height * rng.uniform(0.02, 0.08)
    leg = height * _log_uniform(rng, 0.02, 0.07)
    texture = random_texture(rng)
    top = floor + np.array([0.0, 0.0, height])
    solids = [_box(top, np.array([*half, thick]), texture, turn)]
    for x in (-0.85, 0.85):
        for y in (-0.85, 0.85):
            foot = floor + turn @ np.array([x * half[0], y * half[1], height / 2])
            solids.append(_box(foot, np.array([leg, leg, height / 2]), texture, turn))
    for _ in range(int(rng.integers(0, 4))):
        radius = height * rng.uniform(0.08, 0.25)
        place = top + turn @ np.array([*(rng.uniform(-0.7, 0.7, size=2) * half), thick + 0.8 * radius])
        solids.append(_random_shape(rng, place, radius, random_rotations(rng, 1)[0]))
    return solids


def seat(rng: np.random.Generator, floor: Array, height: float) -> list[Solid]:
    """A chair or sofa: seat, back, sometimes arms and legs."""
    turn = _yaw(rng.uniform(0, 2 * np.pi))
    width = height * rng.uniform(0.5, 1.6)
    depth, thick = height * rng.uniform(0.45, 0.7), height * rng.uniform(0.05, 0.3)
    texture = random_texture(rng)
    parts = [
        (np.array([0, 0, 0.5 * height]), np.array([width, depth, thick])),
        (np.array([0, -depth, height]), np.array([width, 0.12 * height, 0.6 * height])),
    ]
    if rng.random() < 0.5:
        parts += [
            (np.array([s * width, 0, 0.7 * height]), np.array([0.1 * height, depth, 0.25 * height])) for s in (-1, 1)
        ]
    leg = 0.04 * height
    parts += [
        (np.array([x * width * 0.9, y * depth * 0.9, 0.25 * height]), np.array([leg, leg, 0.25 * height]))
        for x in (-1, 1)
        for y in (-1, 1)
    ]
    return [_box(floor + turn @ center, half, texture, turn) for center, half in parts]


def shelf(rng: np.random.Generator, floor: Array, height: float) -> list[Solid]:
    """Boards between two sides, with things on them."""
    turn = _yaw(rng.uniform(0, 2 * np.pi))
    width, depth, tall = height * rng.uniform(0.5, 1.1), height * rng.uniform(0.2, 0.4), height * rng.uniform(1.2, 2.2)
    texture, board = random_texture(rng), 0.03 * height
    solids = [
        _box(floor + turn @ np.array([s * width, 0, tall / 2]), np.array([board, depth, tall / 2]), texture, turn)
        for s in (-1, 1)
    ]
    for level in np.linspace(0.08, 1.0, int(rng.integers(3, 6))):
        center = np.array([0, 0, level * tall])
        solids.append(_box(floor + turn @ center, np.array([width, depth, board]), texture, turn))
        if level < 0.95 and rng.random() < 0.7:
            radius = depth * rng.uniform(0.3, 0.7)
            place = center + np.array([rng.uniform(-0.7, 0.7) * width, 0, board + radius])
            solids.append(_random_shape(rng, floor + turn @ place, radius, turn))
    return solids


def plant(rng: np.random.Generator, floor: Array, height: float) -> list[Solid]:
    """A pot with leaves: flat ellipsoids and thin stems."""
    pot = height * rng.uniform(0.15, 0.25)
    solids = [Solid("cylinder", (pot, pot), floor + np.array([0, 0, pot]), random_texture(rng), 1.5 * pot)]
    leaf = random_texture(rng)
    base = floor + np.array([0, 0, 2 * pot])
    for _ in range(int(rng.integers(5, 12))):
        tip = np.array([*rng.normal(0, 0.35, size=2), rng.uniform(0.3, 1.0)]) * height
        points = np.stack([np.zeros(3), tip * np.array([0.4, 0.4, 0.7]), tip])
        solids.append(
            Solid("polyline_tube", (points, 0.012 * height), base, leaf, float(np.linalg.norm(tip)) * 1.1 + 0.05)
        )
        radii = height * np.array([0.14, 0.08, 0.03]) * rng.uniform(0.6, 1.4)
        solids.append(Solid("ellipsoid", (radii,), base + tip, leaf, float(radii.max()), random_rotations(rng, 1)[0]))
    return solids


def clutter(rng: np.random.Generator, floor: Array, height: float) -> list[Solid]:
    """A single random shape standing or floating about."""
    radius = height * rng.uniform(0.2, 0.7)
    lift = radius * rng.uniform(0.6, 2.5)
    return [_random_shape(rng, floor + np.array([0, 0, lift]), radius, random_rotations(rng, 1)[0])]


FURNITURE: tuple[Callable[[np.random.Generator, Array, float], list[Solid]], ...] = (
    table,
    seat,
    shelf,
    plant,
    clutter,
    clutter,
)


def _walls(rng: np.random.Generator, half: Array, center: Array) -> list[Solid]:
    """The room's hollow, lined with thin slabs so that every wall has its own texture, and some pictures."""
    solids = [Solid("box", (half,), center, random_texture(rng, plainness=0.3), 0.0, inside_out=True)]
    thin = 0.004 * half.max()
    for axis in range(3):
        for side in (-1.0, 1.0):
            lining = half.copy()
            lining[axis] = thin
            place = center.copy()
            place[axis] += side * half[axis]
            solids.append(_box(place, lining, random_texture(rng, plainness=0.3)))
            if axis < 2 and rng.random() < 0.7:
                picture = half * rng.uniform(0.15, 0.4, size=3)
                picture[axis] = 0.015 * half.max()
                shift = rng.uniform(-0.4, 0.4, size=3) * half
                shift[axis] = 0.0
                solids.append(_box(place + shift, picture, random_texture(rng, plainness=0.1)))
    return solids


@dataclass(frozen=True)
class PhotographedScene:
    """Known geometry, the cameras that a field is told, and what they saw.

    Attributes:
        scene: the truth.
        cameras: as given to a field (with pose noise).
        true_cameras: where the photos were really taken.
        images: ``(N, H, W, 3)`` float32 in [0, 1], with exposure and pixel noise.
        depth_maps: ``(N, H, W)`` depth along the optical axis, inf for sky.
    """

    scene: SolidScene
    cameras: Cameras
    true_cameras: Cameras
    images: NDArray[np.float32]
    depth_maps: NDArray[np.float64]


def random_scene(rng: np.random.Generator) -> SolidScene:
    """A furnished room, or (one in four) objects on an open floor. Cameras are meant to lie in [-1, 1]^3."""
    solids: list[Solid] = []
    indoor = rng.random() < 0.75
    ground = -rng.uniform(0.3, 0.9)
    if indoor:
        half = np.array([_log_uniform(rng, 1.0, 3.5), _log_uniform(rng, 1.0, 3.5), rng.uniform(0.6, 1.6)])
        center = np.array([*rng.uniform(-0.3, 0.3, size=2) * half[:2], ground + half[2]])
        solids += _walls(rng, half, center)
        reach = half[:2] * 0.8
    else:
        center = np.array([0.0, 0.0, ground])
        slab = np.array([12.0, 12.0, 0.05])
        solids.append(_box(np.array([0, 0, ground - 0.05]), slab, random_texture(rng, plainness=0.3)))
        reach = np.array([1.6, 1.6])
    for _ in range(int(rng.integers(5, 13))):
        floor = np.array([*(center[:2] + rng.uniform(-1, 1, size=2) * reach), ground])
        maker = FURNITURE[int(rng.integers(len(FURNITURE)))]
        solids += maker(rng, floor, _log_uniform(rng, 0.2, 0.8))
    middle = np.array([*(rng.normal(0, 0.15, size=2)), ground])
    solids += FURNITURE[int(rng.integers(len(FURNITURE)))](rng, middle, _log_uniform(rng, 0.25, 0.6))
    lights = [Light(rng.uniform(-1, 1, size=3) + np.array([0, 0, 1.0]), float(rng.uniform(0.2, 0.6))) for _ in range(2)]
    return SolidScene(solids, lights, float(rng.uniform(0.35, 0.7)), rng.uniform(0.3, 1.0, size=3))


def look_at(origins: Array, targets: Array) -> Array:
    """OpenGL camera-to-world ``(N, 3, 4)`` for cameras at ``origins (N, 3)`` facing ``targets (N, 3)``, z up.

    A camera that looks straight up or down has its right along +X.
    """
    back = origins - targets
    back /= np.linalg.norm(back, axis=1, keepdims=True)
    right = np.cross(np.array([0.0, 0.0, 1.0]), back)
    length = np.linalg.norm(right, axis=1, keepdims=True)
    right = np.where(length < 1e-9, np.array([1.0, 0.0, 0.0]), right / np.maximum(length, 1e-9))
    return np.stack([right, np.cross(back, right), back, origins], axis=-1)


def sweep(rng: np.random.Generator, scene: SolidScene, count: int) -> Array:
    """A casual arc round the middle of the scene: ``(count, 3, 4)`` poses, all in free space."""
    for _ in range(200):
        start, span = rng.uniform(0, 2 * np.pi), np.deg2rad(_log_uniform(rng, 45, 220)) * rng.choice([-1, 1])
        angle = start + span * np.linspace(0, 1, count)
        radius = rng.uniform(0.5, 0.95) + 0.08 * np.sin(angle * 3 + start)
        height = rng.uniform(-0.2, 0.5) + rng.uniform(0, 0.15) * np.sin(angle * 2)
        origins = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)
        outward = rng.random() < 0.12
        targets = origins * (1.6 if outward else rng.uniform(-0.4, 0.3)) + rng.normal(0, 0.06, size=(count, 3))
        targets[:, 2] = rng.uniform(-0.5, 0.1)
        origins = np.clip(origins + rng.normal(0, 0.015, size=(count, 3)), -1, 1)
        if scene.signed_distance(origins).min() > 0.08:
            return look_at(origins, targets)
    raise RuntimeError("sweep: no free path through the scene after 200 tries")


def photograph(
    rng: np.random.Generator, scene: SolidScene, *, count: int, width: int, height: int
) -> PhotographedScene:
    """Take ``count`` photos along a casual sweep, with the faults that casual photos have."""
    poses = sweep(rng, scene, count)
    focal = width / (2 * np.tan(np.deg2rad(rng.uniform(50, 75)) / 2))
    intrinsics = np.array([focal, focal, width / 2, height / 2])
    cameras = Cameras.create(poses, intrinsics, width, height)
    exposure = (
        1.0 + rng.normal(0, rng.uniform(0, 0.03), size=(count, 1, 1, 3)) + rng.normal(0, 0.015, size=(count, 1, 1, 1))
    )
    noise = rng.uniform(0.0, 0.015)
    images = np.zeros((count, height, width, 3), dtype=np.float32)
    depth_maps = np.zeros((count, height, width))
    rays = [[ray.reshape(-1, 3) for ray in cameras.rays(index)] for index in range(count)]
    # all at once: most rays arrive within a few steps, and the long tail of the others is traced together
    colors, distances = scene.render(*(np.concatenate(part) for part in zip(*rays)))
    shape = (count, height, width)
    for index, (color, distance) in enumerate(zip(colors.reshape(*shape, 3), distances.reshape(shape))):
        color = color * exposure[index] + rng.normal(0, noise, size=(height, width, 3))
        images[index] = np.clip(color, 0, 1)
        depth_maps[index] = distance * -(rays[index][1] @ poses[index, :, 2]).reshape(height, width)
    jitter = poses.copy()
    jitter[:, :, 3] += rng.normal(0, _log_uniform(rng, 5e-4, 5e-3), size=(count, 3))
    axis = rng.normal(0, np.deg2rad(_log_uniform(rng, 0.03, 0.25)), size=(count, 3))
    jitter[:, :, :3] = _small_rotations(axis) @ poses[:, :, :3]
    return PhotographedScene(scene, Cameras.create(jitter, intrinsics, width, height), cameras, images, depth_maps)


def _small_rotations(axes: Array) -> Array:
    """Rotation matrices ``(N, 3, 3)`` for rotation vectors ``(N, 3)`` in radians (Rodrigues)."""
    angle = np.linalg.norm(axes, axis=1)[:, None, None]
    x, y, z = (axes / np.maximum(angle[:, :, 0], 1e-12)).T
    zero = np.zeros_like(x)
    cross = np.moveaxis(np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]), -1, 0)
    rotations: Array = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    return rotations
