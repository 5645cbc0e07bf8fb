"""Random rooms and objects of known geometry, photographed as a person with a phone would."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.cameras import Cameras, look_at
from ..core.distances.sampled import SampledDistance
from .furniture import FURNITURE, box_solid, log_uniform, random_texture, sampled_object
from .solids import Light, Solid, SolidScene

Array = NDArray[Any]


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
            solids.append(box_solid(place, lining, random_texture(rng, plainness=0.3)))
            if axis < 2 and rng.random() < 0.7:
                picture = half * rng.uniform(0.15, 0.4, size=3)
                picture[axis] = 0.015 * half.max()
                shift = rng.uniform(-0.4, 0.4, size=3) * half
                shift[axis] = 0.0
                solids.append(box_solid(place + shift, picture, random_texture(rng, plainness=0.1)))
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
        look: what the camera does to every colour: how much it mutes and how much it veils, each in [0, 1].

    Example:
        >>> rng = np.random.default_rng(0)
        >>> scene = random_scene(rng)
        >>> shot = photograph(rng, scene, count=2, width=8, height=6)
        >>> shot.depth_maps.shape, bool((shot.depth_maps > 0).all())
        ((2, 6, 8), True)
    """

    scene: SolidScene
    cameras: Cameras
    true_cameras: Cameras
    images: NDArray[np.float32]
    depth_maps: NDArray[np.float64]
    look: tuple[float, float] = (0.0, 0.0)


def random_scene(rng: np.random.Generator, objects: Sequence[SampledDistance] = ()) -> SolidScene:
    """A furnished room, or (one in four) objects on an open floor. Cameras are meant to lie in [-1, 1]^3.

    Each of ``objects`` (solids of longest side 1) stands somewhere on the floor, beside the furniture.

    Example:
        >>> rng = np.random.default_rng(0)
        >>> scene = random_scene(rng)
        >>> len(scene.solids) > 5
        True
    """
    solids: list[Solid] = []
    indoor = rng.random() < 0.75
    ground = -rng.uniform(0.3, 0.9)
    if indoor:
        half = np.array([log_uniform(rng, 1.0, 3.5), log_uniform(rng, 1.0, 3.5), rng.uniform(0.6, 1.6)])
        center = np.array([*rng.uniform(-0.3, 0.3, size=2) * half[:2], ground + half[2]])
        solids += _walls(rng, half, center)
        reach = half[:2] * 0.8
    else:
        center = np.array([0.0, 0.0, ground])
        slab = np.array([12.0, 12.0, 0.05])
        solids.append(box_solid(np.array([0, 0, ground - 0.05]), slab, random_texture(rng, plainness=0.3)))
        reach = np.array([1.6, 1.6])
    for _ in range(int(rng.integers(5, 13))):
        floor = np.array([*(center[:2] + rng.uniform(-1, 1, size=2) * reach), ground])
        maker = FURNITURE[int(rng.integers(len(FURNITURE)))]
        solids += maker(rng, floor, log_uniform(rng, 0.2, 0.8))
    for shape in objects:
        floor = np.array([*(center[:2] + rng.uniform(-0.8, 0.8, size=2) * np.minimum(reach, 1.3)), ground])
        solids += sampled_object(rng, floor, log_uniform(rng, 0.2, 0.8), shape)
    middle = np.array([*(rng.normal(0, 0.15, size=2)), ground])
    solids += FURNITURE[int(rng.integers(len(FURNITURE)))](rng, middle, log_uniform(rng, 0.25, 0.6))
    lights = [Light(rng.uniform(-1, 1, size=3) + np.array([0, 0, 1.0]), float(rng.uniform(0.2, 0.6))) for _ in range(2)]
    return SolidScene(solids, lights, float(rng.uniform(0.35, 0.7)), rng.uniform(0.3, 1.0, size=3))


def sweep(rng: np.random.Generator, scene: SolidScene, count: int) -> Array:
    """A casual arc round the middle of the scene: ``(count, 3, 4)`` poses, all in free space."""
    for _ in range(200):
        start, span = rng.uniform(0, 2 * np.pi), np.deg2rad(log_uniform(rng, 45, 220)) * rng.choice([-1, 1])
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
    """Take ``count`` photos along a casual sweep, with the faults that casual photos have.

    Example:
        >>> rng = np.random.default_rng(0)
        >>> scene = random_scene(rng)
        >>> shot = photograph(rng, scene, count=2, width=8, height=6)
        >>> shot.images.shape, len(shot.cameras)
        ((2, 6, 8, 3), 2)
    """
    poses = sweep(rng, scene, count)
    focal = width / (2 * np.tan(np.deg2rad(rng.uniform(50, 75)) / 2))
    intrinsics = np.array([focal, focal, width / 2, height / 2])
    cameras = Cameras.create(poses, intrinsics, width, height)
    exposure = (
        1.0 + rng.normal(0, rng.uniform(0, 0.03), size=(count, 1, 1, 3)) + rng.normal(0, 0.015, size=(count, 1, 1, 1))
    )
    noise = rng.uniform(0.0, 0.015)
    muted, flat = rng.uniform(0.0, 0.9), rng.uniform(0.0, 0.5)  # colours that real rooms have, and a lens's veil
    colors, depth_maps = _photos(scene, cameras, (muted, flat))
    images = np.zeros(colors.shape, dtype=np.float32)
    for index, color in enumerate(colors):
        images[index] = np.clip(color * exposure[index] + rng.normal(0, noise, size=(height, width, 3)), 0, 1)
    jitter = poses.copy()
    jitter[:, :, 3] += rng.normal(0, log_uniform(rng, 5e-4, 5e-3), size=(count, 3))
    axis = rng.normal(0, np.deg2rad(log_uniform(rng, 0.03, 0.25)), size=(count, 3))
    jitter[:, :, :3] = _small_rotations(axis) @ poses[:, :, :3]
    told = Cameras.create(jitter, intrinsics, width, height)
    return PhotographedScene(scene, told, cameras, images, depth_maps, (muted, flat))


def photograph_again(rng: np.random.Generator, first: PhotographedScene, *, count: int) -> PhotographedScene:
    """Another casual sweep with the same lens and the same look, without faults: what renders are scored against.

    Raises:
        RuntimeError: there is no free path through the scene.

    Example:
        >>> rng = np.random.default_rng(0)
        >>> scene = random_scene(rng)
        >>> again = photograph_again(rng, photograph(rng, scene, count=2, width=8, height=6), count=3)
        >>> again.images.shape
        (3, 6, 8, 3)
    """
    lens = first.true_cameras
    cameras = Cameras.create(sweep(rng, first.scene, count), lens.intrinsics[0], lens.width, lens.height)
    colors, depth_maps = _photos(first.scene, cameras, first.look)
    images = np.clip(colors, 0, 1).astype(np.float32)
    return PhotographedScene(first.scene, cameras, cameras, images, depth_maps, first.look)


def photograph_larger(first: PhotographedScene, *, width: int) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Take the photos of a sweep once more, ``width`` pixels wide and without exposure errors and noise.

    Returns:
        Images ``(N, H, W, 3)`` in [0, 1], and depth along the optical axis ``(N, H, W)``, inf for sky; for the cameras
        ``first.true_cameras.resized(width / first.true_cameras.width)``.

    Example:
        >>> rng = np.random.default_rng(0)
        >>> scene = random_scene(rng)
        >>> images, depth_maps = photograph_larger(photograph(rng, scene, count=2, width=8, height=6), width=16)
        >>> images.shape
        (2, 12, 16, 3)
    """
    colors, depth_maps = _photos(first.scene, first.true_cameras.resized(width / first.true_cameras.width), first.look)
    return np.clip(colors, 0, 1).astype(np.float32), depth_maps


def _photos(scene: SolidScene, cameras: Cameras, look: tuple[float, float]) -> tuple[Array, Array]:
    """Colours ``(N, H, W, 3)`` with a camera's look, and depth along the optical axis ``(N, H, W)``."""
    muted, flat = look
    shape = (len(cameras), cameras.height, cameras.width)
    rays = [[ray.reshape(-1, 3) for ray in cameras.rays(index)] for index in range(len(cameras))]
    # all at once: most rays arrive within a few steps, and the long tail of the others is traced together
    colors, distances = scene.render(*(np.concatenate(part) for part in zip(*rays)))
    colors = colors.reshape(*shape, 3)
    colors = colors + muted * (colors.mean(axis=-1, keepdims=True) - colors)
    colors = colors + flat * (0.5 - colors)
    facing = np.stack([-(ray[1] @ pose[:, 2]) for ray, pose in zip(rays, cameras.camera_to_world)])
    return colors, (distances.reshape(len(cameras), -1) * facing).reshape(shape)


def observers(
    rng: np.random.Generator, scene: SolidScene, *, count: int = 16, width: int = 64, height: int = 48
) -> tuple[Cameras, NDArray[np.float64]]:
    """Another sweep through a scene, of which only the depth is kept: where might a viewer look later?

    Returns:
        The cameras, and depth along the optical axis ``(count, height, width)``, inf for sky. No cameras if there is
        no free path.

    Example:
        >>> rng = np.random.default_rng(0)
        >>> scene = random_scene(rng)
        >>> cameras, depth = observers(rng, scene, count=3, width=8, height=6)
        >>> len(cameras), depth.shape
        (3, (3, 6, 8))
    """
    try:
        poses = sweep(rng, scene, count)
    except RuntimeError:
        poses = np.zeros((0, 3, 4))
    focal = width / (2 * np.tan(np.deg2rad(rng.uniform(50, 75)) / 2))
    cameras = Cameras.create(poses, np.array([focal, focal, width / 2, height / 2]), width, height)
    depth_maps = np.zeros((len(poses), height, width))
    for index in range(len(poses)):
        origins, directions = (ray.reshape(-1, 3) for ray in cameras.rays(index))
        distance = scene.trace(origins, directions)
        depth_maps[index] = (distance * -(directions @ poses[index, :, 2])).reshape(height, width)
    return cameras, depth_maps


def _small_rotations(axes: Array) -> Array:
    """Rotation matrices ``(N, 3, 3)`` for rotation vectors ``(N, 3)`` in radians (Rodrigues)."""
    angle = np.linalg.norm(axes, axis=1)[:, None, None]
    x, y, z = (axes / np.maximum(angle[:, :, 0], 1e-12)).T
    zero = np.zeros_like(x)
    cross = np.moveaxis(np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]), -1, 0)
    rotations: Array = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    return rotations
