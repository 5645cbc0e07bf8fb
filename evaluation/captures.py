"""Captures: posed photos as ``transforms.json`` describes them, and named sweeps of them (``splits.json``).

The photos are those of nerfstudio's format: OpenGL camera-to-world matrices, a pinhole with OPENCV
distortion, intrinsics for all photos or for each. Needs Pillow (``pip install unghost[eval]``).
"""

from __future__ import annotations

import json
import posixpath
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.cameras import Cameras

CAMERA_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE")
DISTORTION_KEYS = ("k1", "k2", "k3", "k4", "p1", "p2")
SPLIT_KEYS = {"train_filenames": "train", "val_filenames": "val", "test_filenames": "test"}


def _pillow() -> Any:
    try:
        from PIL import Image
    except ImportError as error:
        raise ImportError("load_capture needs Pillow to read photos: pip install unghost[eval]") from error
    return Image


@dataclass(frozen=True, eq=False)
class Capture:
    """Posed photos of one scene; made by :func:`load_capture`.

    Attributes:
        folder: where the photos are.
        names: ``file_path`` of every photo, in the order of ``transforms.json``.
        cameras: one camera a photo, for the downscaled size, in normalised units if asked for.
        splits: name of a sweep -> positions in ``names``.
        transform: ``(4, 4)`` from the file's world to the one of ``cameras`` (``p' = f (p - c)``;
            the identity if not normalised).
        scale_factor: ``f`` above: scene units for one unit of the file.
    """

    folder: Path
    names: tuple[str, ...]
    cameras: Cameras
    splits: Mapping[str, NDArray[np.int64]]
    transform: NDArray[np.float64]
    scale_factor: float
    _paths: tuple[Path, ...] = field(repr=False)
    _cache: dict[int, NDArray[np.float32]] = field(default_factory=dict, repr=False)

    def __len__(self) -> int:
        return len(self.names)

    def split(self, name: str) -> NDArray[np.int64]:
        """Indices ``(n,)`` of the photos of one sweep, in its order; ``"all"`` is every photo.

        Raises:
            ValueError: no such sweep (the message lists those there are).
        """
        if name == "all" and name not in self.splits:
            return np.arange(len(self))
        if name not in self.splits:
            raise ValueError(f"Capture.split: no split {name!r}; choose from {', '.join([*self.splits, 'all'])}")
        return self.splits[name].copy()

    def images(self, indices: Iterable[int] | slice | None = None) -> NDArray[np.float32]:
        """Photos as ``(n, height, width, 3)`` float32 in [0, 1] (sRGB as stored), box-filtered to the cameras' size.

        Read when first asked for, then kept. None means all of them.

        Raises:
            ValueError: a photo cannot be decoded, or has transparent pixels.
            IndexError: an index outside the capture.
        """
        everything = np.arange(len(self))
        chosen = everything if indices is None else np.atleast_1d(everything[_as_index(indices)])
        for index in chosen.tolist():
            if index not in self._cache:
                self._cache[index] = _read_photo(self._paths[index], self.cameras.width, self.cameras.height)
        shape = (0, self.cameras.height, self.cameras.width, 3)
        return np.stack([self._cache[index] for index in chosen.tolist()]) if len(chosen) else np.zeros(shape, "f4")


def _as_index(indices: Iterable[int] | slice) -> Any:
    if isinstance(indices, (slice, int, np.integer)):
        return indices
    return np.asarray(list(indices), dtype=np.int64)


def load_capture(folder: str | Path, *, downscale: float = 8, normalize: bool = True) -> Capture:
    """Read a capture's poses, intrinsics and sweeps, and check that every photo is there; no photo is decoded.

    Args:
        folder: holds ``transforms.json`` and the photos its ``file_path`` entries name, and, if sweeps
            are named, ``splits.json`` (``{"sweep": ["images/a.jpg", ...], ...}``; a text is a note). Without it:
            nerfstudio's ``train_filenames`` / ``val_filenames`` / ``test_filenames``, else the released
            Nerfbusters naming (``frame_00001`` is train, ``frame_1_00001`` eval), else no sweep.
        downscale: how many stored pixels make one, along each axis (>= 1). The size is rounded to whole
            pixels and the intrinsics follow, so 756 / 8 becomes 94 with fy 0.5 % smaller.
        normalize: as nerfstudio with ``--orientation-method none`` (its own default turns the scene first, and the
            farthest coordinate depends on that): the mean camera origin goes to 0 and the farthest coordinate of any
            origin, over *all* frames of the file, to +-1. Unlike nerfstudio nothing is rotated "up".

    Raises:
        ValueError: what is wrong with the folder, with ``transforms.json`` or with ``splits.json``.
        FileNotFoundError: the folder or a photo does not exist (named).
    """
    source = Path(folder)
    if not source.is_dir():
        raise FileNotFoundError(f"load_capture: no folder {source}")
    if not downscale >= 1:
        raise ValueError(f"load_capture: downscale must be >= 1, got {downscale}")
    meta = _read_json(source / "transforms.json")
    frames, names, poses = _posed(meta, source / "transforms.json")
    paths = tuple(_photo_path(source, name) for name in names)
    sizes = [_check_photo(path, {**meta, **frame}, name) for path, frame, name in zip(paths, frames, names)]
    if len(set(sizes)) != 1:
        raise ValueError(f"load_capture: photos must all have one size, got {sorted(set(sizes))}")
    width, height = sizes[0]
    lenses = [_lens({**meta, **frame}, name, width, height) for frame, name in zip(frames, names)]
    splits = _splits(source, meta, names)
    center, scale_factor = _normalisation(poses[:, :3, 3]) if normalize else (np.zeros(3), 1.0)
    poses[:, :3, 3] = (poses[:, :3, 3] - center) * scale_factor
    transform = np.diag([scale_factor] * 3 + [1.0])
    transform[:3, 3] = -center * scale_factor
    cameras = Cameras.create(
        poses, np.stack([lens for lens, _ in lenses]), width, height, np.stack([bend for _, bend in lenses])
    ).resized(1.0 / downscale)
    return Capture(source, names, cameras, splits, transform, scale_factor, paths)


def load_cameras(path: str | Path) -> Cameras:
    """The cameras of a ``transforms.json`` alone, in its own world: no photo need be there, no Pillow.

    Args:
        path: the file, or a folder that holds one. It must state ``w`` and ``h`` (for all frames alike).

    Raises:
        FileNotFoundError: there is none.
        ValueError: what is wrong with the file.
    """
    file = Path(path) / "transforms.json" if Path(path).is_dir() else Path(path)
    if not file.is_file():
        raise FileNotFoundError(f"load_cameras: no file {file}")
    meta = _read_json(file)
    frames, names, poses = _posed(meta, file)
    merged = [{**meta, **frame} for frame in frames]
    sizes = {f"{body.get('w')} x {body.get('h')}" for body in merged}
    stated: list[Any] = [merged[0].get("w"), merged[0].get("h")]
    if len(sizes) > 1 or not all(isinstance(side, (int, float)) and 1 <= side < np.inf for side in stated):
        raise ValueError(f"load_cameras: {file} must state one w and h in pixels for all frames, got {sorted(sizes)}")
    width, height = (int(side) for side in stated)
    lenses = [_lens(body, name, width, height) for body, name in zip(merged, names)]
    lens, bend = (np.stack(values) for values in zip(*lenses))
    return Cameras.create(poses, lens, width, height, bend)


def _posed(meta: Mapping[str, Any], path: Path) -> tuple[list[Any], tuple[str, ...], NDArray[np.float64]]:
    """The frames, their names and poses ``(N, 3, 4)``."""
    frames = meta.get("frames")
    if not isinstance(frames, list) or not frames:
        raise ValueError(f"load_capture: {path} has no frames")
    names = tuple(_frame_name(frame, number) for number, frame in enumerate(frames))
    if len(set(names)) != len(names):
        raise ValueError(f"load_capture: {_first_twice(names)!r} stands in two frames of {path.name}")
    return frames, names, np.stack([_pose(frame, name) for frame, name in zip(frames, names)])


def _read_json(path: Path) -> dict[str, Any]:
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ValueError(f"load_capture: {path.parent} has no {path.name}: not a capture") from None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"load_capture: {path} is not JSON ({error})") from None
    if not isinstance(value, dict):
        raise ValueError(f"load_capture: {path} must hold an object, got a {type(value).__name__}")
    return value


def _first_twice(names: Sequence[str]) -> str:
    return next(name for number, name in enumerate(names) if name in names[:number])


def _clean_name(name: str) -> str:
    return posixpath.normpath(name.replace("\\", "/"))


def _frame_name(frame: Any, number: int) -> str:
    if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
        raise ValueError(f"load_capture: frame {number} of transforms.json has no file_path")
    return _clean_name(frame["file_path"])


def _pose(frame: Mapping[str, Any], name: str) -> NDArray[np.float64]:
    if "transform_matrix" not in frame:
        raise ValueError(f"load_capture: the frame of {name} has no transform_matrix")
    try:
        pose = np.array(frame["transform_matrix"], dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"load_capture: transform_matrix of {name} is not a matrix of numbers") from None
    if pose.shape not in ((4, 4), (3, 4)):
        raise ValueError(f"load_capture: transform_matrix of {name} must have shape (4, 4), got {pose.shape}")
    if not np.isfinite(pose).all():
        raise ValueError(f"load_capture: transform_matrix of {name} must be finite")
    rotation = pose[:3, :3]
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) or np.linalg.det(rotation) < 0:
        raise ValueError(f"load_capture: transform_matrix of {name} must hold a rotation, got {rotation.tolist()}")
    return pose[:3]


def _photo_path(source: Path, name: str) -> Path:
    """``file_path`` without an extension is a PNG, as in the synthetic NeRF scenes."""
    for path in (source / name, source / f"{name}.png"):
        if path.is_file():
            return path
    raise FileNotFoundError(f"load_capture: no photo {source / name}, which transforms.json names")


def _check_photo(path: Path, meta: Mapping[str, Any], name: str) -> tuple[int, int]:
    image = _pillow()
    try:
        with image.open(path) as photo:
            found = (int(photo.width), int(photo.height))
    except OSError as error:
        raise ValueError(f"load_capture: cannot read photo {path} ({error})") from None
    stated = (int(meta.get("w", found[0])), int(meta.get("h", found[1])))
    if found != stated:
        raise ValueError(f"load_capture: photo {name} is {found[0]} x {found[1]}, transforms.json says {stated[0]} x "
                         f"{stated[1]}")  # fmt: skip
    return found


def _lens(
    meta: Mapping[str, Any], name: str, width: int, height: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    model = meta.get("camera_model", "OPENCV")
    if model not in CAMERA_MODELS:
        raise ValueError(f"load_capture: camera_model {model!r} of {name} is none of {', '.join(CAMERA_MODELS)}")
    focal = meta.get("fl_x")
    if focal is None and "camera_angle_x" in meta:
        focal = 0.5 * width / np.tan(0.5 * float(meta["camera_angle_x"]))
    if focal is None:
        raise ValueError(f"load_capture: neither fl_x nor camera_angle_x is given for {name}")
    lens = np.array([focal, meta.get("fl_y", focal), meta.get("cx", width / 2), meta.get("cy", height / 2)], "f8")
    bend = np.array([meta.get(key, 0.0) for key in DISTORTION_KEYS], dtype=np.float64)
    if not (np.isfinite(lens).all() and np.isfinite(bend).all() and (lens[:2] > 0).all()):
        raise ValueError(f"load_capture: intrinsics of {name} must be finite with fl_x, fl_y > 0, got {lens.tolist()}")
    if model != "OPENCV" and bend.any():
        raise ValueError(f"load_capture: {name} has distortion {bend.tolist()} but camera_model {model}")
    return lens, bend


def _splits(source: Path, meta: Mapping[str, Any], names: Sequence[str]) -> dict[str, NDArray[np.int64]]:
    position = {name: number for number, name in enumerate(names)}
    if (source / "splits.json").exists():
        named = _read_json(source / "splits.json")
    else:
        named = {split: meta[key] for key, split in SPLIT_KEYS.items() if key in meta} or _released_splits(names)
    result: dict[str, NDArray[np.int64]] = {}
    for split, files in named.items():
        if isinstance(files, str):
            continue  # a note for people
        if not isinstance(files, list) or not all(isinstance(file, str) for file in files) or not files:
            raise ValueError(f"load_capture: split {split!r} must be a list of file names with at least one")
        cleaned = [_clean_name(file) for file in files]
        for file in cleaned:
            if file not in position:
                raise ValueError(f"load_capture: split {split!r} names {file!r}, which is in no frame")
        if len(set(cleaned)) != len(cleaned):
            raise ValueError(f"load_capture: split {split!r} lists {_first_twice(cleaned)!r} twice")
        result[split] = np.array([position[file] for file in cleaned], dtype=np.int64)
    return result


def _released_splits(names: Sequence[str]) -> dict[str, list[str]]:
    """The released Nerfbusters captures: two videos told apart by their file names alone."""
    stems = [posixpath.splitext(posixpath.basename(name))[0] for name in names]
    train = [name for name, stem in zip(names, stems) if re.fullmatch(r"frame_\d+", stem)]
    evaluation = [name for name, stem in zip(names, stems) if re.fullmatch(r"frame_1_\d+", stem)]
    return {"train": train, "eval": evaluation} if train and evaluation else {}


def _normalisation(origins: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Centre and factor that put all origins into [-1, 1]; one camera, or all in one place: factor 1."""
    center = origins.mean(axis=0)
    reach = float(np.abs(origins - center).max())
    return center, 1.0 / reach if reach > 1e-9 else 1.0


def _read_photo(path: Path, width: int, height: int) -> NDArray[np.float32]:
    image = _pillow()
    try:
        with image.open(path) as photo:
            if photo.mode in ("RGBA", "LA", "PA") and photo.getchannel("A").getextrema()[0] < 255:
                raise ValueError(f"Capture.images: {path} has transparent pixels; put it on a background first")
            small = photo.convert("RGB").resize((width, height), image.Resampling.BOX)
            return np.asarray(small, dtype=np.float32) / np.float32(255)
    except OSError as error:
        raise ValueError(f"Capture.images: cannot decode {path} ({error})") from None
