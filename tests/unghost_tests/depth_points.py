"""Sparse points without matching: places that the depth maps of a synthetic sweep show."""

import numpy as np

from unghost.core.sparse_points import SparsePoints


def depth_points(scene, count=60):
    """``count`` random places of the true surface, each observed by every training camera that has it in view."""
    rng, first = np.random.default_rng(0), scene.photographed
    places = []
    while len(places) < count:
        index = int(rng.integers(len(first.true_cameras)))
        row, column = rng.integers(first.depth_maps.shape[1]), rng.integers(first.depth_maps.shape[2])
        depth = first.depth_maps[index, row, column]
        origin, direction = first.true_cameras.rays(index, np.array([column + 0.5, row + 0.5]))
        if np.isfinite(depth):
            places.append(origin + direction * depth / -(direction @ first.true_cameras.camera_to_world[index, :, 2]))
    xyz = np.array(places)
    cameras = scene.train.cameras
    who, seen_by = np.repeat(np.arange(count), len(cameras)), np.tile(np.arange(len(cameras)), count)
    seen = cameras.sees(seen_by, xyz[who])
    return SparsePoints.create(xyz, point=who[seen], camera=seen_by[seen], cameras=cameras)
