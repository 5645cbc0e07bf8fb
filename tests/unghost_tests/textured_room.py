"""Photos of a corner of a room with painted walls, rendered by intersecting planes; its poses are known."""

import numpy as np
from PIL import Image

from unghost.core.cameras import Cameras

WIDTH, HEIGHT, FOCAL = 256, 192, 240.0
CELLS = 160  # blotches along a wall


def look_at(origin, target):
    back = np.subtract(origin, target) / np.linalg.norm(np.subtract(origin, target))
    right = np.cross([0, 0, 1], back)
    right /= np.linalg.norm(right)
    return np.column_stack([right, np.cross(back, right), back, origin])


def arc(degrees, height, radius=3.0):
    """Cameras on an arc about the corner, looking at a point near it."""
    angles = np.radians(degrees)
    places = np.stack([radius * np.cos(angles), radius * np.sin(angles), np.full(len(angles), height)], axis=-1)
    poses = np.stack([look_at(place, [0.4, 0.4, 0.6]) for place in places])
    return Cameras.create(poses, [FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2], WIDTH, HEIGHT)


def walls(seed):
    """Three pictures ``(s, s)`` in [0, 255]: blotches of several sizes, nowhere alike."""
    generator = np.random.default_rng(seed)
    pictures = []
    for _ in range(3):
        layers = [
            np.kron(generator.uniform(0, 1, (CELLS // k, CELLS // k)), np.ones((4 * k, 4 * k))) for k in (1, 2, 5, 10)
        ]
        pictures.append(255 * np.mean(layers, axis=0) ** 1.5)
    return pictures


def photograph(cameras, paintings):
    """``(n, H, W, 3)`` uint8: each ray ends on the first of the planes x = 0, y = 0, z = 0, which are 4 units long."""
    shots = []
    for index in range(len(cameras)):
        origins, directions = cameras.rays(index)
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = np.where(directions < 0, -origins / directions, np.inf)
        wall = distance.argmin(axis=-1)
        points = origins + directions * distance.min(axis=-1, keepdims=True)
        shot = np.zeros(wall.shape)
        for axis, painting in enumerate(paintings):
            u, v = (np.delete(points, axis, axis=-1)[..., k] / 4.0 * len(painting) for k in (0, 1))
            u, v = (np.clip(each, 0, len(painting) - 1.001) for each in (u, v))
            row, column = u.astype(int), v.astype(int)
            shot = np.where(wall == axis, painting[row, column], shot)
        shots.append(np.repeat(shot[..., None], 3, axis=-1).astype(np.uint8))
    return np.stack(shots)


def save(folder, photos):
    folder.mkdir(parents=True)
    for number, photo in enumerate(photos):
        Image.fromarray(photo).save(folder / f"{number:02d}.png")
    return folder


def similarity_error(found, true):
    """Largest and median distance of origins in units of the true ones' extent, and angles in degrees, after Umeyama.

    ``found`` and ``true`` are ``(n, 3, 4)`` camera-to-world.
    """
    here, there = found[:, :, 3] - found[:, :, 3].mean(axis=0), true[:, :, 3] - true[:, :, 3].mean(axis=0)
    left, values, right = np.linalg.svd(there.T @ here)
    sign = np.diag([1, 1, np.sign(np.linalg.det(left @ right))])
    rotation = left @ sign @ right
    factor = (values * np.diag(sign)).sum() / (here**2).sum()
    extent = np.linalg.norm(there[:, None] - there[None], axis=-1).max()
    distance = np.linalg.norm(factor * here @ rotation.T - there, axis=1) / extent
    turned = np.swapaxes(rotation @ found[:, :, :3], 1, 2) @ true[:, :, :3]
    angle = np.degrees(np.arccos(np.clip((np.trace(turned, axis1=1, axis2=2) - 1) / 2, -1, 1)))
    return distance, angle
