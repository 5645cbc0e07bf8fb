"""Sparse points of a scene's training photos alone, kept on disk.

Of a capture: those that ``unghost points`` has stored for the training sweep, else triangulated here from its photos.
Of a synthetic scene: its training sweep is rendered again at ``MATCH_WIDTH`` pixels, from where the photos were really
taken and with the camera's look (but without pixel noise and exposure, to which matching is blind), and triangulated
with the poses that a field is told, whose errors the points thus have. Photos of the evaluation sweep are never read.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock
from numpy.typing import NDArray
from PIL import Image

import unghost.core.sparse_points
import unghost.evaluation.captures.points
import unghost.evaluation.captures.posing
import unghost.evaluation.captures.triangulation
import unghost.scenes
from unghost.core.cameras import Cameras
from unghost.core.errors import InvalidArgument
from unghost.core.sparse_points import SparsePoints
from unghost.evaluation.captures.loading import load_capture
from unghost.evaluation.captures.points import points_folder
from unghost.evaluation.captures.triangulation import triangulate
from unghost.scenes.generator import PhotographedScene, photograph_larger

from ..fit_cache import FitCache, code_hash, file_hash
from ..progress import say
from .scenes import TrajectoryScene

MATCH_WIDTH = 384
MATCH_SIDE = 1600  # of a capture's photos
FEWEST_POINTS = 30  # fewer say nothing of a scene: its rows with points would test nothing
FIELDS = ("xyz", "point", "camera", "error", "uncertainty")
MODULES = (
    unghost.evaluation.captures.triangulation,
    unghost.evaluation.captures.posing,
    unghost.evaluation.captures.points,
    unghost.core.sparse_points,
)


def with_points(
    scene: TrajectoryScene,
    cache: FitCache,
    *,
    match_width: int = MATCH_WIDTH,
    match_side: int = MATCH_SIDE,
    fewest: int = FEWEST_POINTS,
) -> TrajectoryScene:
    """The scene with the points of its training photos; triangulated once, then read from the cache.

    Raises:
        ImportError: pycolmap is missing.
        ValueError: so few points come out that rows with points would test nothing.
    """
    key = points_key(scene, match_width=match_width, match_side=match_side)

    def make() -> dict[str, NDArray[Any]]:
        return _arrays(found_points(scene, match_width=match_width, match_side=match_side))

    with FileLock(cache.folder / "points.lock"):
        found = cache.views(f"points-{scene.name.replace(' ', '_').replace(':', '-')}", key, make)
    points = SparsePoints(*(found[name] for name in FIELDS))
    if len(points) < fewest:
        raise InvalidArgument(
            f"two_trajectory: {len(points)} points come out of the {len(scene.train.cameras)} training photos of "
            f"{scene.name}, fewer than {fewest}: leave the scene out"
        )
    if len(points.camera) and points.camera.max() >= len(scene.train.cameras):
        raise RuntimeError(f"two_trajectory: points of {scene.name} refer to photos that are not trained on")
    say(f"    {scene.name}: {len(points)} points, {len(points.point)} observations, {len(scene.train.cameras)} photos")
    return dataclasses.replace(scene, points=points)


def points_key(scene: TrajectoryScene, *, match_width: int, match_side: int) -> dict[str, Any]:
    """All that the points depend on: training photos, cameras, sizes, code; nothing of the evaluation sweep."""
    code = hashlib.sha256("".join(file_hash(str(module.__file__)) for module in MODULES).encode()).hexdigest()[:16]
    key: dict[str, Any] = {"photos": scene.train.digest(), "code": code}
    if scene.photographed is not None:
        return {**key, "width": match_width, "scenes": code_hash(unghost.scenes)}
    return {**key, "side": match_side, "stored": _stored_hash(scene)}


def found_points(scene: TrajectoryScene, *, match_width: int, match_side: int) -> SparsePoints:
    """Points in the frame of ``scene.train.cameras``; none if nothing matches."""
    try:
        if scene.photographed is not None:
            return synthetic_points(scene.photographed, width=match_width)
        if scene.capture is None or scene.taught is None:
            raise InvalidArgument(f"two_trajectory: {scene.name} has neither a capture nor known geometry")
        if _stored_hash(scene) is not None:
            return scene.capture.points_of(scene.split)
        return triangulate(scene.capture, scene.taught, longest_side=match_side)
    except InvalidArgument as error:
        if "nothing matches" not in str(error):
            raise
        return SparsePoints.create(np.zeros((0, 3)))


def synthetic_points(first: PhotographedScene, *, width: int) -> SparsePoints:
    """Points of a synthetic sweep by SIFT on larger photos of it, with the poses that a field is told."""
    (photos, _), told = photograph_larger(first, width=width), first.cameras.resized(width / first.cameras.width)
    with tempfile.TemporaryDirectory() as scratch:
        write_capture(Path(scratch), photos, told)
        capture = load_capture(scratch, downscale=1, normalize=False)
        return triangulate(capture, np.arange(len(photos)), longest_side=max(told.width, told.height))


def write_capture(folder: Path, photos: NDArray[np.float32], cameras: Cameras) -> None:
    """Photos ``(n, H, W, 3)`` and a ``transforms.json`` of their undistorted cameras."""
    frames = []
    for index, photo in enumerate(photos):
        name = f"{index:04d}.png"
        Image.fromarray((np.clip(photo, 0, 1) * 255).round().astype(np.uint8)).save(folder / name)
        fx, fy, cx, cy = cameras.intrinsics[index].tolist()
        width, height = cameras.size(index)
        pose = [*cameras.camera_to_world[index].tolist(), [0.0, 0.0, 0.0, 1.0]]
        lens = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": width, "h": height}
        frames.append({"file_path": name, "transform_matrix": pose, **lens})
    (folder / "transforms.json").write_text(json.dumps({"camera_model": "OPENCV", "frames": frames}), encoding="utf-8")


def digest(points: SparsePoints) -> str:
    """Eight digits of a hash of points and observations, by which rows with other points are told apart."""
    arrays = (points.xyz, points.point, points.camera)
    return hashlib.sha256(b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)).hexdigest()[:8]


def _arrays(points: SparsePoints) -> dict[str, NDArray[Any]]:
    return {name: getattr(points, name) for name in FIELDS}


def _stored_hash(scene: TrajectoryScene) -> str | None:
    """Of the model that ``unghost points`` stored for the whole training sweep; None if there is none."""
    if scene.capture is None or not scene.split:
        return None
    folder = points_folder(scene.capture.folder, scene.split)
    files = sorted(folder.glob("points3D.*"))
    return file_hash(files[0]) if files else None
