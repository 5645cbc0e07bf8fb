"""``dataparser_transforms.json``: how nerfstudio moved and scaled a capture before it trained on it.

Fields, and splats of ``ns-export gaussian-splat``, are in the moved world; ``transforms.json`` is not.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.errors import InvalidArgument, InvalidFile
from .transforms import read_object

FILE = "dataparser_transforms.json"
EARLIER = [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]]  # applied_transform where a file with COLMAP beside states none


def find_dataparser(*places: Path | None) -> Path | None:
    """The one ``dataparser_transforms.json`` that lies in the given folders, or beside the given files.

    Raises:
        ValueError: there are two that differ.
    """
    folders = [place if place.is_dir() else place.parent for place in places if place is not None]
    found = {path.resolve(): path for folder in folders for path in [folder / FILE] if path.is_file()}
    files = list(found.values())
    if len(files) > 1 and len({path.read_bytes() for path in files}) > 1:
        raise InvalidArgument(
            f"load_cameras: {' and '.join(map(str, files))} differ: remove the one that is not of this scene"
        )
    return files[0] if files else None


def read_dataparser(path: str | Path) -> tuple[NDArray[np.float64], float]:
    """The ``(4, 4)`` rigid motion and the factor of a ``dataparser_transforms.json``: ``p' = s (R p + t)``.

    Raises:
        FileNotFoundError, ValueError: there is no such file, or its content is something else.
    """
    content = read_object(Path(path), caller="load_cameras")
    try:
        motion = np.eye(4)
        motion[:3] = np.array(content["transform"], dtype=np.float64)[:3]
        factor = float(content["scale"])
    except (KeyError, TypeError, ValueError, IndexError):
        raise InvalidFile(f"load_cameras: {path} must hold a transform of 3 x 4 numbers and a scale") from None
    return _rigid(motion, "transform", path), _positive(factor, "scale", path)


def into_the_trained_world(
    poses: NDArray[np.float64], meta: Mapping[str, Any], dataparser: Path, folder: Path, *, colmap: bool
) -> NDArray[np.float64]:
    """Poses ``(N, 3, 4)`` of a capture, moved to where nerfstudio trained.

    nerfstudio states the motion from COLMAP's world. The poses of a ``transforms.json`` have made its
    ``applied_transform`` and ``applied_scale`` already, so these are undone.

    Args:
        poses: OpenGL camera-to-world.
        meta: the object of ``transforms.json``; that of a COLMAP model if ``colmap``.
        dataparser: the file.
        folder: of the capture.
        colmap: the poses are COLMAP's own.
    """
    motion, factor = read_dataparser(dataparser)
    applied, scaled = meta.get("applied_transform"), meta.get("applied_scale", 1.0)
    if applied is None and not colmap and (folder / "colmap" / "sparse" / "0").exists():
        applied = EARLIER
    if applied is not None:
        before = np.eye(4)
        try:
            before[:3] = np.array(applied, dtype=np.float64)[:3]
        except (TypeError, ValueError):
            raise InvalidFile(f"load_cameras: applied_transform in {folder} must hold 3 x 4 numbers") from None
        motion = motion @ np.linalg.inv(_rigid(before, "applied_transform", folder))
    moved = motion[:3] @ np.concatenate([poses, np.tile([[[0.0, 0.0, 0.0, 1.0]]], (len(poses), 1, 1))], axis=1)
    moved[:, :, 3] *= factor / _positive(scaled, "applied_scale", folder)
    return np.asarray(moved)


def _rigid(motion: NDArray[np.float64], key: str, where: str | Path) -> NDArray[np.float64]:
    rotation = motion[:3, :3]
    if not np.isfinite(motion).all() or not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3):
        raise InvalidFile(f"load_cameras: {key} in {where} must hold a rotation, got {rotation.tolist()}")
    return motion


def _positive(value: Any, key: str, where: str | Path) -> float:
    if not isinstance(value, (int, float)) or not 0 < value < np.inf:
        raise InvalidFile(f"load_cameras: {key} in {where} must be > 0, got {value!r}")
    return float(value)
