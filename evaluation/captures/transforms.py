"""``transforms.json``, the file of poses and lenses that nerfstudio and instant-ngp read."""

from __future__ import annotations

import posixpath
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.cameras import Cameras
from ...core.errors import InvalidArgument, InvalidFile
from ...core.io import read_json, write_json

DISTORTION_KEYS = ("k1", "k2", "k3", "k4", "p1", "p2")
LENS_KEYS = ("fl_x", "fl_y", "cx", "cy")
BENDS = {  # camera model -> what may differ from 0 in it
    "OPENCV": DISTORTION_KEYS,
    "PINHOLE": (),
    "SIMPLE_PINHOLE": (),
    "SIMPLE_RADIAL": ("k1",),
    "RADIAL": ("k1", "k2"),
    "FULL_OPENCV": ("k1", "k2", "k3", "p1", "p2"),  # without its k4, k5, k6, which divide
}
FISHEYES = {  # the equidistant models, OPENCV_FISHEYE with fewer parameters, by the same names
    "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"),
    "RADIAL_FISHEYE": ("k1", "k2"),
    "SIMPLE_RADIAL_FISHEYE": ("k1",),
}
UNREAD = {  # what instant-ngp and others say of lenses that are not read here
    "ftheta_p0": "an f-theta lens",
    "ftheta_p1": "an f-theta lens",
    "latlong": "a panorama",
    "is_latlong": "a panorama",
    "equirectangular": "a panorama",
    "is_equirectangular": "a panorama",
    "orthographic": "no perspective",
    "rolling_shutter": "a pose for each row",
    "k5": "a lens with more distortion than k1 to k4",
    "k6": "a lens with more distortion than k1 to k4",
}


def read_object(path: Path, *, caller: str = "load_capture") -> dict[str, Any]:
    """The object in a JSON file; ``caller`` begins the message of an error.

    Raises:
        ValueError: there is no such file, or it is something else.
    """
    try:
        value = read_json(path, caller=caller)
    except FileNotFoundError:
        raise InvalidFile(f"{caller}: {path.parent} has no {path.name}: not a capture") from None
    if not isinstance(value, dict):
        raise InvalidFile(f"{caller}: {path} must hold an object, got a {type(value).__name__}")
    return value


def at_size(frame: Mapping[str, Any], stated: tuple[int, int], size: tuple[int, int]) -> dict[str, Any]:
    """A frame of :func:`read_frames` whose lens is stated for pictures of one size (w, h), for copies of another.

    Example:
        >>> at_size({"fl_x": 80.0, "cx": 32.0}, (64, 48), (32, 24))
        {'fl_x': 40.0, 'cx': 16.0, 'w': 32, 'h': 24}
    """
    across, down = size[0] / stated[0], size[1] / stated[1]
    fitted = {**frame, "w": size[0], "h": size[1]}
    if size == stated:
        return fitted
    if "fl_y" not in frame and "fl_x" in frame and across != down:
        fitted["fl_y"] = frame["fl_x"]
    for key, factor in (("fl_x", across), ("cx", across), ("fl_y", down), ("cy", down)):
        if key in fitted:
            fitted[key] = fitted[key] * factor
    return fitted


def clean_name(name: str) -> str:
    """A ``file_path`` without ``./`` and backslashes: two spellings of one photo become equal."""
    return posixpath.normpath(name.replace("\\", "/"))


def first_twice(names: Sequence[str]) -> str:
    """The first name that stood before; there must be one."""
    seen: set[str] = set()
    return next(name for name in names if name in seen or seen.add(name))  # type: ignore[func-returns-value]


def read_frames(meta: Mapping[str, Any], label: str) -> tuple[list[dict[str, Any]], tuple[str, ...], NDArray[Any]]:
    """The frames of a file, each with what it shares with the others, their names, and their poses.

    Args:
        meta: the file's object.
        label: what to call it in an error.

    Returns:
        frames, names, OpenGL camera-to-world ``(N, 3, 4)``.

    Raises:
        ValueError: no frames, one without name or pose, a pose that is no rigid motion, a name twice.
    """
    frames = meta.get("frames")
    if not isinstance(frames, list) or not frames:
        raise InvalidFile(f"load_capture: {label} has no frames")
    names = tuple(_frame_name(frame, number) for number, frame in enumerate(frames))
    if len(set(names)) != len(names):
        raise InvalidFile(f"load_capture: {first_twice(names)!r} stands in two frames of {label}")
    poses = np.stack([_pose(frame, name) for frame, name in zip(frames, names)])
    shared = {key: value for key, value in meta.items() if key != "frames"}
    return [{**shared, **frame} for frame in frames], names, poses


SPLIT_FILES = {sweep: f"transforms_{sweep}.json" for sweep in ("train", "val", "test")}


def has_split_files(folder: Path) -> bool:
    """Whether a folder is laid out as the synthetic NeRF scenes are: a ``transforms_train.json`` or its siblings."""
    return any((folder / file).is_file() for file in SPLIT_FILES.values())


def read_split_files(folder: Path) -> dict[str, Any]:
    """``transforms_train.json``, ``_val`` and ``_test`` of the synthetic NeRF scenes as one ``transforms.json``.

    Each file is a sweep, and what it states for all of its frames stands with each of them. A photo in two files with
    one pose is one frame.

    Raises:
        ValueError: what is wrong with a file; a photo in two files with two poses.
    """
    frames: dict[str, dict[str, Any]] = {}
    lists: dict[str, list[str]] = {}
    for sweep, file in SPLIT_FILES.items():
        if not (folder / file).is_file():
            continue
        merged, names, _ = read_frames(read_object(folder / file), f"{file} in {folder}")
        for frame, name in zip(merged, names):
            if name in frames and frames[name]["transform_matrix"] != frame["transform_matrix"]:
                raise InvalidFile(f"load_capture: {name!r} stands in two files of {folder} with two poses")
            frames[name] = frame
        lists[f"{sweep}_filenames"] = list(names)
    return {**lists, "frames": list(frames.values())}


def _frame_name(frame: Any, number: int) -> str:
    if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
        raise InvalidFile(f"load_capture: frame {number} of transforms.json has no file_path")
    return clean_name(frame["file_path"])


def _pose(frame: Mapping[str, Any], name: str) -> NDArray[np.float64]:
    if "transform_matrix" not in frame:
        raise InvalidFile(f"load_capture: the frame of {name} has no transform_matrix")
    try:
        pose = np.array(frame["transform_matrix"], dtype=np.float64)
    except (TypeError, ValueError):
        raise InvalidFile(f"load_capture: transform_matrix of {name} is not a matrix of numbers") from None
    if pose.shape not in ((4, 4), (3, 4)):
        raise InvalidFile(f"load_capture: transform_matrix of {name} must have shape (4, 4), got {pose.shape}")
    if not np.isfinite(pose).all():
        raise InvalidFile(f"load_capture: transform_matrix of {name} must be finite")
    rotation = pose[:3, :3]
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) or np.linalg.det(rotation) < 0:
        raise InvalidFile(f"load_capture: transform_matrix of {name} must hold a rotation, got {rotation.tolist()}")
    return pose[:3]


def read_lens(
    frame: Mapping[str, Any], name: str, width: int, height: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], bool]:
    """The lens of one frame of :func:`read_frames`.

    ``camera_model`` is nerfstudio's, ``is_fisheye`` instant-ngp's; ``distortion_params`` is nerfstudio's other way to
    say k1, k2, k3, k4, p1, p2. Without ``fl_x`` the field of view is taken: ``camera_angle_x`` in radians, ``x_fov`` in
    degrees.

    Returns:
        intrinsics ``(4,)`` in pixels, distortion ``(6,)``, and whether the lens is OPENCV_FISHEYE instead of OPENCV.

    Raises:
        ValueError: a camera model that is not understood, or numbers that make no lens.
    """
    fisheye = _is_fisheye(frame, name)
    model = frame.get("camera_model") or ("OPENCV_FISHEYE" if fisheye else "OPENCV")
    focal_x = _focal(frame, name, "x", width, fisheye)
    if focal_x is None:
        told = "no fl_x" if fisheye else "neither fl_x nor camera_angle_x nor x_fov"
        raise InvalidFile(f"load_capture: {told} is given for {name}")
    focal_y = _focal(frame, name, "y", height, fisheye)
    center = frame.get("cx", width / 2), frame.get("cy", height / 2)
    lens = np.array([focal_x, focal_x if focal_y is None else focal_y, *center], "f8")
    bend = np.array(_distortion(frame, name), dtype=np.float64)
    if not (np.isfinite(lens).all() and np.isfinite(bend).all() and (lens[:2] > 0).all()):
        raise InvalidFile(f"load_capture: intrinsics of {name} must be finite with fl_x, fl_y > 0, got {lens.tolist()}")
    if any(value and key not in {**BENDS, **FISHEYES}[model] for key, value in zip(DISTORTION_KEYS, bend)):
        raise InvalidFile(f"load_capture: {name} has distortion {bend.tolist()} but camera_model {model}")
    return lens, bend, fisheye


def _is_fisheye(frame: Mapping[str, Any], name: str) -> bool:
    """Whether a frame's lens is an OPENCV_FISHEYE; what is no lens that is read is refused by its name."""
    model, flag = frame.get("camera_model"), frame.get("is_fisheye")
    if model and not (isinstance(model, str) and (model in BENDS or model in FISHEYES)):
        raise InvalidFile(
            f"load_capture: camera_model {model!r} of {name} is none of {', '.join([*BENDS, *FISHEYES])}; "
            "undistort the photos first"
        )
    for key, kind in UNREAD.items():
        value = frame.get(key)
        if any(value) if isinstance(value, list) else value:
            raise InvalidFile(
                f"load_capture: {name} has {key} {frame[key]!r}, {kind}, which is not read; undistort the photos first"
            )
    if flag is not None and not isinstance(flag, (bool, int)):
        raise InvalidFile(f"load_capture: is_fisheye of {name} must be true or false, got {flag!r}")
    if model and flag is not None and bool(flag) != (model in FISHEYES):
        raise InvalidFile(f"load_capture: {name} has is_fisheye {bool(flag)} but camera_model {model}: which is it?")
    return bool(flag) or model in FISHEYES


def _focal(frame: Mapping[str, Any], name: str, axis: str, side: int, fisheye: bool) -> float | None:
    """Focal length along an axis in pixels; None if nothing tells it."""
    if frame.get(f"fl_{axis}") is not None:
        return float(frame[f"fl_{axis}"])
    angles = {f"{axis}_fov": np.pi / 180, f"camera_angle_{axis}": 1.0}
    key = next((key for key in angles if frame.get(key) is not None), None)
    if key is None:
        return None
    if fisheye:
        raise InvalidFile(f"load_capture: {name} is a fisheye and needs fl_{axis} in pixels; {key} is a pinhole's")
    return float(0.5 * side / np.tan(0.5 * float(frame[key]) * angles[key]))


def _distortion(frame: Mapping[str, Any], name: str) -> list[Any]:
    """k1, k2, k3, k4, p1, p2, each 0 unless given."""
    values = frame.get("distortion_params")
    if values is None:
        return [frame.get(key, 0.0) for key in DISTORTION_KEYS]
    if not isinstance(values, list) or len(values) != len(DISTORTION_KEYS):
        raise InvalidFile(f"load_capture: distortion_params of {name} must be k1, k2, k3, k4, p1, p2, got {values!r}")
    return values


def write_transforms(
    path: str | Path,
    cameras: Cameras,
    names: Sequence[str],
    lists: Mapping[str, Sequence[str]],
    frame_keys: Sequence[Mapping[str, Any]] | None = None,
    /,
    **extra: Any,
) -> None:
    """Write the file that stock nerfstudio (1.1.5) reads, whole or not at all.

    Lenses that are all the same stand once: nerfstudio lets a shared value win over a frame's own. Others stand with
    each frame, and then none is shared; likewise the sizes.

    Args:
        path: of the file.
        cameras: in the world and at the size of the stored photos.
        names: of the photos, relative to the file's folder.
        lists: ``train_filenames`` and so on; nerfstudio wants train, val and test, or none of them.
        frame_keys: per photo, further keys of its frame.
        **extra: further keys of the file.

    Raises:
        ValueError: some of the cameras are fisheyes and others are not: such a file has one camera model.
    """
    keys = (*LENS_KEYS, *DISTORTION_KEYS)
    if cameras.fisheye.any() and not cameras.fisheye.all():
        raise InvalidArgument(
            f"write_transforms: {int(cameras.fisheye.sum())} of the {len(cameras)} cameras are fisheyes and the others "
            "are not, but nerfstudio reads one camera_model a file; write each kind alone, or undistort the fisheyes"
        )
    lenses = np.concatenate([cameras.intrinsics, cameras.distortion], axis=1)
    alike = bool((lenses == lenses[:1]).all())
    frames: list[dict[str, Any]] = []
    more = [{}] * len(names) if frame_keys is None else frame_keys
    rows = zip(names, cameras.camera_to_world, lenses, cameras.sizes.tolist(), more, strict=True)
    for name, pose, lens, size, further in rows:
        own = {**further, **({} if cameras.same_size else dict(zip("wh", size)))}
        own |= {} if alike else dict(zip(keys, lens.tolist()))
        frames.append({"file_path": name, **own, "transform_matrix": [*pose.tolist(), [0.0, 0.0, 0.0, 1.0]]})
    shared = dict(zip(keys, lenses[0].tolist())) if alike else {}
    content = {
        "camera_model": "OPENCV_FISHEYE" if cameras.fisheye.any() else "OPENCV",
        **({"w": cameras.width, "h": cameras.height} if cameras.same_size else {}),
        **shared,
        **extra,
        **{key: list(files) for key, files in lists.items()},
        "frames": frames,
    }
    write_json(path, content, parents=False)
