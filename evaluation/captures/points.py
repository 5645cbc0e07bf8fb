"""Sparse points of a COLMAP model, with their tracks, or of a PLY file, without, as
:class:`~unghost.core.sparse_points.SparsePoints`.

``points3D`` files are parsed here, with every length checked: pycolmap (3.12) ends the process on one that is cut
short.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core.cameras import Cameras
from ...core.errors import InvalidFile, MissingFile
from ...core.ply import read_ply_vertices
from ...core.sparse_points import SparsePoints, warn_if_not_in_view
from .alignment import align_poses
from .colmap import OWN, image_names, read_model
from .dataparser import applied_scale
from .photos import find_photos
from .transforms import clean_name

HEAD = struct.Struct("<Q3d3BdQ")  # id, xyz, rgb, error, length of the track
PLY_KEY = "ply_file_path"  # nerfstudio's, of transforms.json
TRACK_ENTRY = np.dtype([("image", "<u4"), ("keypoint", "<u4")])


@dataclass(frozen=True)
class Tracks:
    """What a ``points3D`` file holds.

    Attributes:
        xyz: ``(P, 3)`` in the model's world.
        error: ``(P,)`` mean reprojection error, pixels.
        point: ``(M,)`` index into ``xyz``.
        image: ``(M,)`` COLMAP's image id.
        number: ``(P,)`` COLMAP's point id.
    """

    xyz: NDArray[np.float64]
    error: NDArray[np.float64]
    point: NDArray[np.int64]
    image: NDArray[np.int64]
    number: NDArray[np.uint64]


def read_tracks(path: str | Path) -> Tracks:
    """Read COLMAP's ``points3D.bin`` or ``points3D.txt``.

    Raises:
        MissingFile: there is no such file.
        InvalidFile: it is cut short, has bytes left over, or holds what is no point.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp(), "points3D.txt")
        >>> _ = path.write_text("# a comment\\n7 0.5 0 2 255 0 0 0.3 1 12 4 9\\n")
        >>> tracks = read_tracks(path)
        >>> tracks.xyz.tolist(), tracks.image.tolist()
        ([[0.5, 0.0, 2.0]], [1, 4])
    """
    file = Path(path)
    if not file.is_file():
        raise MissingFile(f"read_tracks: no file {file}")
    numbers, xyz, errors, images = _binary(file) if file.suffix == ".bin" else _text(file)
    places = np.array(xyz, dtype=np.float64).reshape(-1, 3)
    if not np.isfinite(places).all():
        raise InvalidFile(f"read_tracks: {file} has points whose coordinates are not finite")
    error = np.array(errors, dtype=np.float64)
    point = np.repeat(np.arange(len(places)), [len(track) for track in images])
    image = np.concatenate([np.zeros(0, np.int64), *images]).astype(np.int64)
    known = np.where(error >= 0, error, np.nan)  # COLMAP writes -1 for unknown
    return Tracks(places, known, point, image, np.array(numbers, dtype=np.uint64))


_Columns = tuple[list[int], list[tuple[float, ...]], list[float], list[NDArray[np.int64]]]  # id, xyz, error, images


def _binary(file: Path) -> _Columns:
    data = file.read_bytes()
    numbers: list[int] = []
    xyz: list[tuple[float, ...]] = []
    errors: list[float] = []
    images: list[NDArray[np.int64]] = []
    at = 8
    if len(data) < at:
        raise InvalidFile(f"read_tracks: {file} is cut short, {len(data)} bytes")
    (count,) = struct.unpack_from("<Q", data)
    if count * HEAD.size > len(data):
        raise InvalidFile(f"read_tracks: {file} names {count} points, more than its {len(data)} bytes can hold")
    for number in range(count):
        if at + HEAD.size > len(data):
            raise InvalidFile(f"read_tracks: {file} is cut short in point {number} of {count}")
        own, x, y, z, _, _, _, error, length = HEAD.unpack_from(data, at)
        at += HEAD.size
        if length * TRACK_ENTRY.itemsize > len(data) - at:
            raise InvalidFile(f"read_tracks: {file} is cut short in the track of point {number} of {count}")
        images.append(np.frombuffer(data, TRACK_ENTRY, length, at)["image"].astype(np.int64))
        at += length * TRACK_ENTRY.itemsize
        numbers.append(own)
        xyz.append((x, y, z))
        errors.append(error)
    if at != len(data):
        raise InvalidFile(f"read_tracks: {file} has {len(data) - at} bytes after its {count} points")
    return numbers, xyz, errors, images


def _text(file: Path) -> _Columns:
    numbers, xyz, errors, images = [], [], [], []
    with file.open(encoding="utf-8-sig") as stream:
        for number, line in enumerate(stream, 1):
            words = line.split()
            if not words or words[0].startswith("#"):
                continue
            if len(words) < 8 or len(words) % 2:
                raise InvalidFile(
                    f"read_tracks: line {number} of {file} must be ID X Y Z R G B ERROR and pairs of numbers, "
                    f"got {len(words)} words"
                )
            try:
                numbers.append(int(words[0]))
                xyz.append(tuple(float(word) for word in words[1:4]))
                errors.append(float(words[7]))
                images.append(np.array([int(word) for word in words[8::2]], dtype=np.int64))
            except ValueError:
                raise InvalidFile(f"read_tracks: line {number} of {file} holds what is no number") from None
    return numbers, xyz, errors, images


def points_folder(folder: str | Path, split: str) -> Path:
    """Where ``unghost points`` stores the points of one sweep of a capture.

    Example:
        >>> points_folder("room", "train").as_posix()
        'room/sparse/unghost-train'
    """
    return Path(folder) / "sparse" / f"{OWN}-{split}"


def read_points(
    model: str | Path,
    names: Sequence[str],
    cameras: Cameras,
    *,
    transform: NDArray[np.float64] | None = None,
    pixel_scale: ArrayLike = 1.0,
) -> SparsePoints:
    """Read the sparse points of a COLMAP model and who observed them.

    Args:
        model: folder with ``cameras``, ``images`` and ``points3D``, ``.bin`` or ``.txt``.
        names: of the photos of ``cameras``, in their order; a photo is found by its name in the model, or by a name
            that ends with it (``images/a.jpg`` for ``a.jpg``). Observations by other photos of the model are left out.
        cameras: in the frame of the result.
        transform: ``(4, 4)`` similarity from the model's world to that of ``cameras`` (``Capture.transform``); None if
            they are one.
        pixel_scale: pixels of the matched photos for one pixel of ``cameras``, one number or ``(cameras,)``.

    Returns:
        All points of the model, in its order; some may be left without observations.

    Raises:
        InvalidFile: a file is broken, or a track names an image that the model does not have.
    """
    source = Path(model)
    file = source / "points3D.bin"
    tracks = read_tracks(file if file.is_file() else source / "points3D.txt")
    known = image_names(source)
    index_of = positions_of(known, names)
    unknown = sorted(set(np.unique(tracks.image).tolist()) - set(known))
    if unknown:
        raise InvalidFile(
            f"read_points: tracks of {source} name {len(unknown)} images that it lacks, first {unknown[0]}"
        )
    table = np.full(max(known, default=0) + 1, -1)
    for number, position in index_of.items():
        table[number] = position
    camera = table[tracks.image] if len(tracks.image) else np.zeros(0, dtype=np.int64)
    xyz = tracks.xyz if transform is None else tracks.xyz @ transform[:3, :3].T + transform[:3, 3]
    used = camera >= 0
    return SparsePoints.create(
        xyz,
        point=tracks.point[used],
        camera=camera[used],
        cameras=cameras,
        error=tracks.error,
        pixel_scale=pixel_scale,
    )


def read_aligned_points(model: str | Path, names: Sequence[str], cameras: Cameras, *, caller: str) -> SparsePoints:
    """Read the sparse points of a COLMAP model into the world of any cameras of the same photos.

    The model's world may be another one (scaled, turned and shifted alike): photos are found by name, and the
    similarity follows from their poses in both.

    Args:
        model: folder with ``cameras``, ``images`` and ``points3D``, ``.bin`` or ``.txt``.
        names: of the photos of ``cameras``, in their order, as :func:`read_points` takes them.
        cameras: in the frame of the result; each may be of a larger or smaller copy of its photo.
        caller: begins messages.

    Returns:
        All points of the model, with the observations by ``cameras``.

    Raises:
        InvalidFile: a broken model, or one whose photos are not among the cameras, or posed otherwise.
    """
    frames = read_model(model)["frames"]
    position = positions_of({number: frame["file_path"] for number, frame in enumerate(frames)}, names)
    if not position:
        raise InvalidFile(f"{caller}: no photo of {model} is among the {len(names)} cameras, such as {names[0]}")
    order = list(position.values())
    source = np.array([frames[number]["transform_matrix"] for number in position])[:, :3]
    motion = align_poses(source, cameras.camera_to_world[order], label=f"{caller}: {model}")
    scale = np.ones(len(cameras))
    scale[order] = [frames[number]["w"] / cameras.size(place)[0] for number, place in position.items()]
    points = read_points(model, names, cameras, transform=motion, pixel_scale=scale)
    warn_if_not_in_view(points, cameras, caller=caller)
    return points


def has_points(model: Path) -> bool:
    """Whether a COLMAP model has a file ``points3D`` with a point in it."""
    file = model / "points3D.bin"
    if file.is_file():
        return file.stat().st_size > 8
    file = file.with_suffix(".txt")
    if not file.is_file():
        return False
    with file.open("rb") as stream:
        return any(line.strip() and not line.lstrip(b"\xef\xbb\xbf \t").startswith(b"#") for line in stream)


def read_point_cloud(
    folder: str | Path,
    meta: Mapping[str, Any],
    cameras: Cameras,
    *,
    transform: NDArray[np.float64] | None = None,
) -> SparsePoints:
    """Read the points that ``ply_file_path`` of a ``transforms.json`` names: places alone, without tracks.

    Args:
        folder: of the file, where the path starts from.
        meta: what the file says.
        cameras: in the frame of the result.
        transform: ``(4, 4)`` from the file's world to that of ``cameras``, a similarity without rotation
            (``Capture.transform``); None if they are one.

    Returns:
        Points that support and cross nothing: no observations, and an uncertainty that is not determined (inf).

    Raises:
        MissingFile: the path leads to no file.
        InvalidFile: it is no path, or the file cannot be read, has no points, or points that are not finite.
    """
    value, where = meta[PLY_KEY], Path(folder)
    if not isinstance(value, str) or not value:
        raise InvalidFile(f"Capture.points: {PLY_KEY} of transforms.json in {where} must be a path, got {value!r}")
    (path,), _ = find_photos([clean_name(value)], where)
    if path is None:
        raise MissingFile(
            f"Capture.points: {PLY_KEY} of transforms.json names {value!r}, which must be a PLY file in {where}: "
            "there is none; put it there, or remove the key"
        )
    # nerfstudio 1.1.5 (nerfstudio_dataparser.py, process_data/colmap_utils.py) writes the PLY with applied_transform
    # made, as the poses have it, and multiplies what it reads by applied_scale. Rotation and shift are not made again.
    xyz = read_ply_vertices(path, "x", "y", "z", caller="Capture.points") * applied_scale(meta, where)
    if not len(xyz):
        raise InvalidFile(f"Capture.points: {path} ({PLY_KEY}) has no points")
    bad = int((~np.isfinite(xyz)).any(axis=1).sum())
    if bad:
        raise InvalidFile(f"Capture.points: {path} ({PLY_KEY}) has {bad} of {len(xyz)} points that are not finite")
    return SparsePoints.create(
        xyz if transform is None else xyz @ transform[:3, :3].T + transform[:3, 3], cameras=cameras
    )


def positions_of(known: dict[int, str], names: Sequence[str]) -> dict[int, int]:
    """Which of ``names`` each image is: image id to position; images that are none of them are left out."""
    whole = {name: position for position, name in enumerate(names)}
    tails: dict[str, int] = {}
    for position, name in enumerate(names):
        for depth in range(1, name.count("/") + 1):
            tail = name.split("/", depth)[-1]
            tails[tail] = -1 if tail in tails else position  # two photos of one name in two folders: neither
    found = {number: whole.get(name, tails.get(name, -1)) for number, name in known.items()}
    return {number: position for number, position in found.items() if position >= 0}
