"""Simulated structure-from-motion points of a photographed scene, for training data; no photo is matched.

Real points are where texture is, are seen by three or four photos each, lie off the surface along their rays, and
some are plain wrong. Each of these is imitated: corners are detected by the strength of the texture's structure
tensor, observations are lost with angle, foreshortening and scale, keypoints have noise, the points are triangulated
with the cameras that a field is given (which have pose noise), and wrong matches lie anywhere on a ray.

Scores use points that were triangulated from rendered photos instead (docs/harvest.md compares the two).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.cameras import Cameras
from ..core.sparse_points import SparsePoints
from .furniture import log_uniform
from .generator import PhotographedScene

Array = NDArray[Any]

CANDIDATES_PER_POINT, MOST_CANDIDATES = 4, 40_000
CORNER_STEP = 1.5  # pixels between the samples of a corner's structure tensor
MOST_ANGLE = 50.0  # degrees between two rays of a match
LEAST_ANGLE = 1.5  # degrees between the rays of a point: COLMAP's default
MOST_ERROR = 3.0  # pixels, mean reprojection error of a point that is kept
TWO_VIEW_SHARE = 0.3  # of the points seen by two photos are kept: COLMAP ignores tracks that begin with two
SELF_OCCLUSION = 0.02  # relative depth by which a surface may hide itself in a depth map of few pixels


@dataclass(frozen=True)
class MatchingConfig:
    """Properties of a simulated matching, each drawn per set of points.

    Attributes:
        points: lowest and highest number of points, log-uniform; fewer come out where texture is scarce.
        width: lowest and highest width of the matched photos, pixels, log-uniform.
        noise: lowest and highest standard deviation of a keypoint, pixels.
        wrong: lowest and highest share of wrong points, log-uniform.
        contrast: lowest and highest corner strength (grey levels in [0, 1]) that is detected half of the time,
            log-uniform.
        repeatability: lowest and highest probability that a detected corner is matched in another photo that sees it
            from the same direction.
    """

    points: tuple[float, float] = (100.0, 10_000.0)
    width: tuple[float, float] = (384.0, 1000.0)
    noise: tuple[float, float] = (0.3, 0.8)
    wrong: tuple[float, float] = (0.005, 0.08)
    contrast: tuple[float, float] = (0.003, 0.03)
    repeatability: tuple[float, float] = (0.15, 0.6)


def simulate_sparse_points(
    rng: np.random.Generator, photographed: PhotographedScene, config: MatchingConfig | None = None
) -> SparsePoints:
    """Simulate the sparse points that matching the training photos would give.

    Args:
        rng: source of every draw.
        photographed: the scene, its true cameras and the ones that a field is given.
        config: ranges of the matching's properties.

    Returns:
        Points in the frame of ``photographed.cameras``, whose indices their observations use.

    Example:
        >>> from unghost.scenes.generator import photograph, random_scene
        >>> rng = np.random.default_rng(0)
        >>> shot = photograph(rng, random_scene(rng), count=6, width=32, height=24)
        >>> points = simulate_sparse_points(rng, shot)
        >>> len(points) > 50, bool(points.views().min() >= 2)
        (True, True)
    """
    settings = config or MatchingConfig()
    wanted = round(log_uniform(rng, *settings.points))
    factor = log_uniform(rng, *settings.width) / photographed.true_cameras.width
    places, first, directions = _candidates(rng, photographed, wanted)
    strength = corner_strength(photographed, places, directions, first, step=CORNER_STEP / factor)
    limit = log_uniform(rng, *settings.contrast)
    detected = rng.random(len(places)) < strength / (strength + limit)
    places, first = places[detected], first[detected]
    point, camera = _observations(rng, photographed, places, first, rng.uniform(*settings.repeatability))
    noise = float(rng.uniform(*settings.noise)) / factor
    true, told = photographed.true_cameras, photographed.cameras
    points = triangulate_noisy(rng, places, point, camera, true=true, told=told, noise=noise, factor=factor)
    if len(points) > wanted:
        points = points.select(np.sort(rng.choice(len(points), wanted, replace=False)))
    matched = photographed.cameras.resized(factor)  # errors and uncertainties are of pixels of the matched photos
    return with_wrong_points(rng, points, matched, log_uniform(rng, *settings.wrong))


def _candidates(rng: np.random.Generator, photographed: PhotographedScene, wanted: int) -> tuple[Array, Array, Array]:
    """Surface points in random pixels ``(N, 3)``, the camera of each, and its viewing direction."""
    cameras = photographed.true_cameras
    each = -(-min(max(CANDIDATES_PER_POINT * wanted, 2000), MOST_CANDIDATES) // len(cameras))
    origins, directions = [], []
    for index in range(len(cameras)):
        pixels = rng.random((each, 2)) * [cameras.width, cameras.height]
        start, along = cameras.rays(index, pixels)
        origins.append(start)
        directions.append(along)
    start, along = np.concatenate(origins), np.concatenate(directions)
    distance = photographed.scene.trace(start, along)
    camera = np.repeat(np.arange(len(cameras)), each)
    hit = np.isfinite(distance)
    return (start + np.where(hit, distance, 0.0)[:, None] * along)[hit], camera[hit], along[hit]


def corner_strength(
    photographed: PhotographedScene, places: Array, directions: Array, camera: Array, *, step: float
) -> Array:
    """Square root of the smaller eigenvalue of the structure tensor at surface points: Shi and Tomasi's corners.

    Args:
        photographed: the scene; its look mutes the contrast.
        places: ``(N, 3)`` on surfaces.
        directions: ``(N, 3)`` unit viewing directions.
        camera: ``(N,)`` that sees each.
        step: between neighbouring samples, pixels of those cameras.

    Returns:
        ``(N,)`` contrast between neighbouring samples, grey levels in [0, 1], in the direction of least contrast.
    """
    scene, cameras = photographed.scene, photographed.true_cameras
    distance = np.linalg.norm(places - cameras.origins[camera], axis=1)
    length = step * distance / cameras.intrinsics[camera, 0]
    right = cameras.camera_to_world[camera, :, 0]
    right = right - (right * directions).sum(1, keepdims=True) * directions
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    down = np.cross(directions, right)
    offsets = np.array([(x, y) for x in (-1, 0, 1) for y in (-1, 0, 1)], dtype=float)
    shift = offsets[:, :1, None] * right + offsets[:, 1:, None] * down  # (9, N, 3)
    around = places + shift * length[:, None]
    _, flat = photographed.look
    grey = scene.albedo(around.reshape(-1, 3)).mean(axis=1).reshape(9, -1) * (scene.ambient + 0.3) * (1 - flat)
    return least_contrast(grey)


def least_contrast(grey: Array) -> Array:
    """Square root of the smaller eigenvalue of the structure tensor of 3 x 3 samples.

    Args:
        grey: ``(9, N)`` grey levels, samples of a row of pixels of equal x first.

    Returns:
        ``(N,)`` root mean square difference of neighbouring samples in the direction in which it is least.

    Example:
        >>> edge, corner = [0, 0, 0, 0, 0, 0, 1, 1, 1], [0, 0, 0, 0, 1, 1, 0, 1, 1]
        >>> least_contrast(np.array([edge, corner], dtype=float).T).round(2).tolist()
        [0.0, 0.5]
    """
    grid = grey.reshape(3, 3, -1)
    across = (grid[1:, :-1] + grid[1:, 1:] - grid[:-1, :-1] - grid[:-1, 1:]) / 2
    along = (grid[:-1, 1:] + grid[1:, 1:] - grid[:-1, :-1] - grid[1:, :-1]) / 2
    xx, yy, xy = ((a * b).mean(axis=(0, 1)) for a, b in ((across, across), (along, along), (across, along)))
    least = (xx + yy) / 2 - np.sqrt(((xx - yy) / 2) ** 2 + xy**2)
    strength: Array = np.sqrt(np.maximum(least, 0.0))
    return strength


def _observations(
    rng: np.random.Generator, photographed: PhotographedScene, places: Array, first: Array, repeatability: float
) -> tuple[Array, Array]:
    """Pairs (point, camera) of matched keypoints; the camera that a point was found in always observes it."""
    cameras, scene = photographed.true_cameras, photographed.scene
    normals = scene.normals(places)
    start = cameras.origins[first] - places
    reference = np.linalg.norm(start, axis=1)
    start /= reference[:, None]
    point, camera = [np.arange(len(places))], [first]
    for index in range(len(cameras)):
        pixels, depth, in_front = cameras.project(index, places)
        column, row = (np.floor(np.nan_to_num(pixels[:, axis], nan=-1.0)).astype(np.int64) for axis in (0, 1))
        inside = in_front & (column >= 0) & (column < cameras.width) & (row >= 0) & (row < cameras.height)
        shown = photographed.depth_maps[index][np.where(inside, row, 0), np.where(inside, column, 0)]
        toward = cameras.origins[index] - places
        distance = np.linalg.norm(toward, axis=1)
        toward /= np.maximum(distance, 1e-9)[:, None]
        angle = np.degrees(np.arccos(np.clip((toward * start).sum(1), -1, 1)))
        facing = (toward * normals).sum(1)
        zoom = np.abs(np.log2(np.maximum(distance, 1e-9) / reference))
        chance = repeatability * np.clip(1 - angle / MOST_ANGLE, 0, 1) * np.clip(facing / 0.3, 0, 1)
        chance *= np.clip(1.5 - zoom, 0, 1)
        matched = inside & (depth < shown * (1 + SELF_OCCLUSION)) & (rng.random(len(places)) < chance)
        matched &= first != index
        point.append(np.flatnonzero(matched))
        camera.append(np.full(int(matched.sum()), index))
    return np.concatenate(point), np.concatenate(camera)


def triangulate_noisy(
    rng: np.random.Generator,
    places: Array,
    point: Array,
    camera: Array,
    *,
    true: Cameras,
    told: Cameras,
    noise: float,
    factor: float = 1.0,
) -> SparsePoints:
    """Triangulate noisy keypoints of known places, and drop what COLMAP would.

    Args:
        rng: source of the noise.
        places: ``(P, 3)``.
        point, camera: ``(M,)`` observations.
        true: cameras that took the photos.
        told: cameras that the points are triangulated with.
        noise: standard deviation of a keypoint, pixels of these cameras.
        factor: pixels of the matched photos for one of theirs.
    """
    keypoints, directions = np.zeros((len(point), 2)), np.zeros((len(point), 3))
    for index in range(len(true)):
        mine = camera == index
        pixels, _, _ = true.project(index, places[point[mine]])
        keypoints[mine] = pixels + rng.normal(0, noise, size=pixels.shape)
        directions[mine] = told.rays(index, keypoints[mine])[1]
    origins = told.origins[camera]
    xyz, good = _nearest_to_rays(origins, directions, point, len(places))
    views = np.bincount(point, minlength=len(places))
    error = np.zeros(len(point))
    for index in range(len(told)):
        mine = camera == index
        pixels, _, in_front = told.project(index, xyz[point[mine]])
        gap = np.linalg.norm(np.nan_to_num(pixels, nan=np.inf) - keypoints[mine], axis=1)
        error[mine] = np.where(in_front, gap, np.inf) * factor
    with np.errstate(invalid="ignore"):
        mean = np.bincount(point, weights=error, minlength=len(places)) / np.maximum(views, 1)
    spread = _widest_angle(origins, xyz, point, len(places))
    good &= (views >= 3) | ((views == 2) & (rng.random(len(places)) < TWO_VIEW_SHARE))
    good &= np.isfinite(mean) & (mean <= MOST_ERROR) & (spread >= LEAST_ANGLE)
    mean = np.where(good, mean, 0.0)
    points = SparsePoints.create(np.where(good[:, None], xyz, 0.0), point=point, camera=camera, error=mean)
    kept = points.select(good)
    matched = told.resized(factor)
    return SparsePoints.create(kept.xyz, point=kept.point, camera=kept.camera, cameras=matched, error=kept.error)


def _nearest_to_rays(origins: Array, directions: Array, point: Array, count: int) -> tuple[Array, Array]:
    """Least-squares intersection of each point's rays ``(count, 3)``, and whether they determine one."""
    matrix, vector = np.zeros((count, 3, 3)), np.zeros((count, 3))
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    value = np.einsum("nij,nj->ni", across, origins)
    for row in range(3):
        vector[:, row] = np.bincount(point, weights=value[:, row], minlength=count)
        for column in range(3):
            matrix[:, row, column] = np.bincount(point, weights=across[:, row, column], minlength=count)
    good = np.linalg.eigvalsh(matrix)[:, 0] > 1e-6
    matrix[~good] = np.eye(3)
    return np.linalg.solve(matrix, vector[:, :, None])[:, :, 0], good


def _widest_angle(origins: Array, xyz: Array, point: Array, count: int) -> Array:
    """About the largest angle between the rays of each point, degrees: twice the largest from their mean."""
    toward: Array = origins - xyz[point]
    toward = toward / np.maximum(np.linalg.norm(toward, axis=1, keepdims=True), 1e-12)
    mean = np.stack([np.bincount(point, weights=toward[:, axis], minlength=count) for axis in range(3)], axis=1)
    mean = mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
    angle = np.degrees(np.arccos(np.clip((toward * mean[point]).sum(1), -1, 1)))
    widest = np.zeros(count)
    np.maximum.at(widest, point, angle)
    return 2 * widest


def with_wrong_points(rng: np.random.Generator, points: SparsePoints, cameras: Cameras, share: float) -> SparsePoints:
    """The points and some wrong ones: at a random depth on the ray of a real keypoint, as epipolar lines allow.

    Args:
        rng: source of every draw.
        points: right ones.
        cameras: of the matched photos.
        share: of wrong points among all, in [0, 1).
    """
    count = round(share / (1 - share) * len(points))
    if not count or not len(points.point):
        return points
    row = rng.integers(len(points.point), size=count)
    origin = cameras.origins[points.camera[row]]
    offset = points.xyz[points.point[row]] - origin
    xyz = origin + np.exp(rng.uniform(np.log(0.25), np.log(2.5), size=count))[:, None] * offset
    point, camera = [np.arange(count)], [points.camera[row]]
    for index in rng.permutation(len(cameras)):
        seen = cameras.sees(np.full(count, index), xyz) & (camera[0] != index)
        taken = np.bincount(np.concatenate(point), minlength=count)
        more = seen & ((taken < 2) | ((taken < 3) & (rng.random(count) < 0.02)))
        point.append(np.flatnonzero(more))
        camera.append(np.full(int(more.sum()), index))
    whose, who = np.concatenate(point), np.concatenate(camera)
    wrong = SparsePoints.create(xyz, point=whose, camera=who, cameras=cameras, error=rng.uniform(0.2, 2.0, size=count))
    wrong = wrong.select(wrong.views() >= 2)
    return SparsePoints.create(
        np.concatenate([points.xyz, wrong.xyz]),
        point=np.concatenate([points.point, wrong.point + len(points)]),
        camera=np.concatenate([points.camera, wrong.camera]),
        cameras=cameras,
        error=np.concatenate([points.error, wrong.error]),
    )
