"""Captures: posed photos as ``transforms.json`` or a COLMAP model describes them, and named sweeps of them.

OpenGL camera-to-world matrices, OPENCV or OPENCV_FISHEYE lenses, one for all photos or one for each. Needs Pillow
(``pip install unghost[eval]``), and pycolmap for COLMAP (``unghost[capture]``).
"""

from __future__ import annotations

import functools
import re
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core.cameras import Cameras
from ...core.errors import InvalidArgument, InvalidFile, MissingFile
from ...core.io import read_json
from ...core.sparse_points import SparsePoints, warn_if_not_in_view
from .colmap import find_model, has_model, image_names, read_model
from .dataparser import applied_motion, find_dataparser, into_the_trained_world, warn_if_exported
from .inria import FILE as INRIA_FILE
from .inria import cameras_as_frames
from .photos import RESIZED, find_photos, fit_frames, photo_sizes, read_photo, report_missing
from .points import PLY_KEY, has_points, points_folder, read_aligned_points, read_point_cloud, read_points
from .splits import Splits, resolve_splits
from .transforms import has_split_files, read_frames, read_lens, read_object, read_split_files

MISSING = ("error", "drop")


@dataclass(frozen=True, eq=False)
class Capture:
    """Posed photos of one scene; made by :func:`load_capture`.

    Attributes:
        folder: where the photos are.
        names: ``file_path`` of every photo, in the order of ``transforms.json`` (COLMAP: by name).
        cameras: one camera a photo, for the downscaled size, in normalised units if asked for.
        splits: name of a sweep -> positions in ``names``.
        transform: ``(4, 4)`` from the file's world to the one of ``cameras`` (``p' = f (p - c)``;
            the identity if not normalised).
        scale_factor: ``f`` above: scene units for one unit of the file.
        dropped: photos that were named but not there, and left out as asked.
        meta: what the file says beside its frames (empty for COLMAP), as it stands there.
        frames: each photo's own frame, as it stands in the file.
        upright: positions of the photos that are read turned, as their EXIF tags say.
        background: grey level in [0, 1] behind transparent pixels; None refuses them.

    Example: see :func:`load_capture`; ``capture.split("eval")`` are the numbers of the photos of a sweep,
    ``capture.images([3])`` is a photo as ``(1, H, W, 3)`` float32 in [0, 1].
    """

    folder: Path
    names: tuple[str, ...]
    cameras: Cameras
    splits: Mapping[str, NDArray[np.int64]]
    transform: NDArray[np.float64]
    scale_factor: float
    _paths: tuple[Path, ...] = field(repr=False)
    _cache: dict[int, NDArray[np.float32]] = field(default_factory=dict, repr=False)
    dropped: tuple[str, ...] = ()
    meta: Mapping[str, Any] = field(default_factory=dict, repr=False)
    frames: tuple[Mapping[str, Any], ...] = field(default=(), repr=False)
    upright: frozenset[int] = field(default=frozenset(), repr=False)
    background: float | None = 1.0

    def __len__(self) -> int:
        return len(self.names)

    @property
    def paths(self) -> tuple[Path, ...]:
        """Where each photo is."""
        return self._paths

    @functools.cached_property
    def points(self) -> SparsePoints:
        """Sparse points that came with the capture, in the frame of ``cameras``; read when first asked for.

        Those of its COLMAP model, with tracks; without such a model those of ``ply_file_path`` of ``transforms.json``,
        which have none: they support density near them and give no sight lines (``points.about`` says which they are).
        Beside a ``transforms.json`` the model is the one in ``sparse/0`` (or ``colmap/sparse/0``), moved by the file's
        ``applied_transform`` and ``applied_scale``; the points of the PLY are moved already, and are scaled alone, as
        nerfstudio does. They were adjusted with all photos, those of the evaluation too: for anything that is scored,
        triangulate from the training photos alone.

        Raises:
            FileNotFoundError: there is neither, or a model without points, or no file where ``ply_file_path`` leads.
            ValueError: a broken model or PLY file.
        """
        model = find_model(self.folder)
        if model is not None and has_points(model):
            moved = self.transform @ applied_motion(self.meta, self.folder)
            scale = self.pixel_scale(range(len(self)))
            points = read_points(model, self.names, self.cameras, transform=moved, pixel_scale=scale)
        elif self.meta.get(PLY_KEY) is not None:
            points = read_point_cloud(self.folder, self.meta, self.cameras, transform=self.transform)
        else:
            state = "no COLMAP model (sparse/0)" if model is None else f"a COLMAP model without points ({model})"
            raise MissingFile(
                f"Capture.points: {self.folder} has {state} and no {PLY_KEY} in transforms.json: run "
                f"unghost points {self.folder}"
            )
        warn_if_not_in_view(points, self.cameras, caller="Capture.points")
        return points

    def points_of(self, split: str) -> SparsePoints:
        """Sparse points triangulated from the photos of one sweep alone, as ``unghost points`` has stored them.

        Returns:
            Points in the frame of ``cameras``; their ``camera`` counts positions in ``split(split)``.

        Raises:
            FileNotFoundError: ``unghost points`` has not been run for this sweep.
            ValueError: no such sweep, a broken model, or one of other photos than the sweep's.
        """
        chosen, model = self.split(split), points_folder(self.folder, split)
        if not model.is_dir():
            raise MissingFile(
                f"Capture.points_of: {self.folder} has no points of the photos of {split!r} alone: run "
                f"unghost points {self.folder} --photos-of {split}"
            )
        names = [self.names[index] for index in chosen]
        others = sorted(set(image_names(model).values()) - set(names))
        if others:
            raise InvalidFile(f"Capture.points_of: {model} holds photos that are not in {split!r}, such as {others[0]}")
        cameras = self.cameras.select(chosen)
        scale = self.pixel_scale(chosen)
        points = read_points(model, names, cameras, transform=self.transform, pixel_scale=scale)
        warn_if_not_in_view(points, cameras, caller="Capture.points_of")
        return points

    def photo_size(self, index: int) -> tuple[int, int]:
        """Width and height of a photo as it is read: stored, or upright."""
        stored, shown, _ = photo_sizes(self._paths[index], caller="Capture.photo_size")
        return shown if index in self.upright else stored

    def pixel_scale(self, indices: ArrayLike) -> NDArray[np.float64]:
        """Pixels of the stored photos for one pixel of ``cameras``, by width: ``(n,)``, 8 at ``downscale=8``."""
        chosen = np.asarray(indices, dtype=np.int64).tolist()
        return np.array([self.photo_size(index)[0] / self.cameras.size(index)[0] for index in chosen])

    def split(self, name: str) -> NDArray[np.int64]:
        """Indices ``(n,)`` of the photos of one sweep, in its order; ``"all"`` is every photo.

        Raises:
            ValueError: no such sweep (the message lists those there are).
        """
        if name == "all" and name not in self.splits:
            return np.arange(len(self))
        if name not in self.splits:
            raise InvalidArgument(f"Capture.split: no split {name!r}; choose from {', '.join([*self.splits, 'all'])}")
        return self.splits[name].copy()

    def images(self, indices: Iterable[int] | slice | None = None) -> NDArray[np.float32]:
        """Photos as ``(n, height, width, 3)`` float32 in [0, 1] (sRGB as stored), box-filtered to the cameras' size.

        Read when first asked for, then kept. None means all of them. Photos of different sizes make no array: ask for
        one size at a time (:meth:`~unghost.core.cameras.Cameras.by_size`).

        Raises:
            ValueError: a photo cannot be decoded, or has transparent pixels and ``background`` is None; photos of
                different sizes.
            IndexError: an index outside the capture.
        """
        everything = np.arange(len(self))
        chosen = everything if indices is None else np.atleast_1d(everything[_as_index(indices)])
        sizes = sorted({self.cameras.size(index) for index in chosen.tolist()})
        if len(sizes) > 1:
            raise InvalidArgument(
                f"Capture.images: the photos differ in size ({', '.join('{} x {}'.format(*size) for size in sizes)}); "
                "ask for one size at a time: capture.images(group) for group in capture.cameras.by_size()"
            )
        for index in chosen.tolist():
            if index not in self._cache:
                self._cache[index] = read_photo(
                    self._paths[index],
                    *sizes[0],
                    upright=index in self.upright,
                    background=self.background,
                )
        if not len(chosen):
            return np.zeros((0, *self.cameras.sizes[0, ::-1], 3), "f4")
        return np.stack([self._cache[index] for index in chosen.tolist()])


def _as_index(indices: Iterable[int] | slice) -> Any:
    if isinstance(indices, (slice, int, np.integer)):
        return indices
    return np.asarray(list(indices), dtype=np.int64)


def load_capture(
    folder: str | Path,
    *,
    downscale: float = 8,
    normalize: bool | Sequence[str] = True,
    splits: Splits | None = None,
    missing: str = "error",
    photos: str | Path | None = None,
    background: float | None = 1.0,
) -> Capture:
    """Read a capture's poses, intrinsics and sweeps, and check that every photo is there; no photo is decoded.

    Args:
        folder: holds ``transforms.json`` and the photos its ``file_path`` entries name; or is a COLMAP model or has
            one in ``sparse/0``, photos in ``images`` (needs ``unghost[capture]``); or holds ``transforms_train.json``
            (``_val``, ``_test``), as the synthetic NeRF scenes do. Where there is no ``images`` but ``images_4``, say,
            the photos are those, and the lenses are scaled to them.
        downscale: how many stored pixels make one, along each axis (>= 1). The size is rounded to whole
            pixels and the intrinsics follow, so 756 / 8 becomes 94 with fy 0.5 % smaller.
        normalize: as nerfstudio with ``--orientation-method none`` (its own default turns the scene first, and the
            farthest coordinate depends on that): the mean camera origin goes to 0 and the farthest coordinate of any
            origin to +-1, over *all* photos, or over those of the sweeps named here. Unlike nerfstudio nothing is
            rotated "up".
        splits: the sweeps, ``{"sweep": ["images/a.jpg", ...], ...}`` or a JSON file of that. None: ``splits.json`` in
            the folder, else nerfstudio's lists, else what the photos' names tell, else no sweep
            (:func:`~unghost.evaluation.captures.splits.resolve_splits`).
        missing: ``"error"``, or ``"drop"`` for photos that are not there: they are left out with a warning that
            counts them, and stand in ``Capture.dropped``.
        photos: folder that the photos' names refer to, if not ``folder`` (for COLMAP: ``images`` in it); it may be
            named from ``folder`` (``images_4``). Its photos may be smaller than the cameras state: the lenses are
            scaled to them.
        background: grey level in [0, 1] behind transparent pixels: white (1.0), as scores on the synthetic NeRF
            scenes have it; None refuses such photos.

    Example:
        >>> import json, tempfile
        >>> from PIL import Image
        >>> folder = Path(tempfile.mkdtemp())
        >>> Image.new("RGB", (64, 48)).save(folder / "walk.png")
        >>> pose = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1]]
        >>> frame = {"file_path": "walk.png", "transform_matrix": pose}
        >>> lens = {"fl_x": 60, "fl_y": 60, "cx": 32, "cy": 24, "w": 64, "h": 48}
        >>> _ = (folder / "transforms.json").write_text(json.dumps({**lens, "frames": [frame]}))
        >>> capture = load_capture(folder, downscale=4, normalize=False)
        >>> capture.names, capture.cameras.width, capture.cameras.origins.tolist()
        (('walk.png',), 16, [[0.0, 0.0, 2.0]])

    Raises:
        ValueError: what is wrong with the folder, with ``transforms.json``, the model or the sweeps.
        FileNotFoundError: the folder or photos do not exist (counted, the first ones named).
    """
    source = Path(folder)
    if not source.is_dir():
        raise MissingFile(f"load_capture: no folder {source}")
    if not downscale >= 1:
        raise InvalidArgument(f"load_capture: downscale must be >= 1, got {downscale}")
    if missing not in MISSING:
        raise InvalidArgument(f"load_capture: missing must be one of {', '.join(MISSING)}, got {missing!r}")
    if background is not None and not 0 <= background <= 1:
        raise InvalidArgument(f"load_capture: background must be in [0, 1] or None, got {background}")
    meta, label, root = _source(source)
    frames, names, poses = read_frames(meta, f"{label} in {source}")
    elsewhere = None if photos is None else _photos_folder(Path(photos), source)
    found, resizable = find_photos(names, root, elsewhere=elsewhere)
    dropped = report_missing(names, found, label, elsewhere or root, missing)
    here = [number for number, path in enumerate(found) if path is not None]
    own = tuple(meta["frames"][k] for k in here)
    frames, names, poses = [frames[k] for k in here], tuple(names[k] for k in here), poses[here]
    paths = tuple(path for path in found if path is not None)
    frames, upright = fit_frames(frames, paths, names, label, [resizable[k] for k in here])
    sweeps = resolve_splits(names, meta=meta, folder=root, given=splits, dropped=dropped)
    transform = _normalisation(poses[:, :3, 3], normalize, sweeps)
    poses[:, :3, 3] = poses[:, :3, 3] * transform[0, 0] + transform[:3, 3]
    sizes = [(frame["w"], frame["h"]) for frame in frames]
    cameras = _cameras(poses, frames, names, sizes).resized(1.0 / downscale)
    return Capture(
        source,
        names,
        cameras,
        sweeps,
        transform,
        float(transform[0, 0]),
        paths,
        dropped=dropped,
        meta={key: value for key, value in meta.items() if key != "frames"},
        frames=own,
        upright=upright,
        background=background,
    )


def load_cameras(path: str | Path, *, dataparser: str | Path | bool = True, scene: str | Path | None = None) -> Cameras:
    """The cameras of a capture alone, in its own world or, with nerfstudio's transform, in the trained one.

    Reads ``transforms.json`` (and ``transforms_train.json`` and so on), a COLMAP model, or Inria's ``cameras.json``.
    No photo need be there, unless the file states no size.

    Args:
        path: the file, or a folder that holds one, or a model. It must state ``w`` and ``h``, for all frames or for
            each, or the photos must be there.
        dataparser: nerfstudio's ``dataparser_transforms.json``, which is applied to the cameras: fields of nerfstudio
            and splats of ``ns-export`` are in that world. True: the one beside ``path`` or beside ``scene``, if there
            is one; a warning where there is none and the scene is splats that nerfstudio exported. False: none.
        scene: file of the scene that the cameras are for.

    Example:
        >>> import json, tempfile
        >>> folder = Path(tempfile.mkdtemp())
        >>> pose = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1]]
        >>> lens = {"fl_x": 60, "fl_y": 60, "cx": 32, "cy": 24, "w": 64, "h": 48}
        >>> frames = [{"file_path": "a.png", "transform_matrix": pose}]
        >>> _ = (folder / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))
        >>> load_cameras(folder).origins.tolist()
        [[0.0, 0.0, 2.0]]

    Raises:
        FileNotFoundError: there is none.
        ValueError: what is wrong with the file.
    """
    return _named_cameras(Path(path), dataparser, scene)[0]


def load_points(
    path: str | Path | None,
    cameras: str | Path,
    *,
    dataparser: str | Path | bool = True,
    scene: str | Path | None = None,
) -> SparsePoints | None:
    """The sparse points of a COLMAP model, in the world of :func:`load_cameras` and with its cameras' indices.

    The model's world may be another one (scaled, turned and shifted alike): photos are found by name, and the
    similarity follows from their poses in both.

    Args:
        path: a COLMAP model with points, or a folder that holds one (``sparse/0`` and so on). None for the one beside
            ``cameras``, if there is one.
        cameras, dataparser, scene: as :func:`load_cameras` takes them.

    Returns:
        The points; None if ``path`` is None and there is no model with points.

    Raises:
        FileNotFoundError: ``path`` holds no model with points.
        ValueError: a broken model, or one whose photos are not among the cameras, or posed otherwise.
    """
    known, names, root = _named_cameras(Path(cameras), dataparser, scene)
    place = root if path is None else Path(path)
    model = place if has_model(place) else find_model(place)
    if model is None or not has_points(model):
        if path is None:
            return None
        raise MissingFile(f"load_points: {place} has no COLMAP model with points (cameras, images and points3D)")
    return read_aligned_points(model, names, known, caller="load_points")


def _named_cameras(
    place: Path, dataparser: str | Path | bool, scene: str | Path | None
) -> tuple[Cameras, Sequence[str], Path]:
    """The cameras of a capture alone, their photos' names, and its folder."""
    meta, file, root, colmap = _cameras_source(place)
    merged, names, poses = read_frames(meta, str(file))
    if dataparser is not False:
        beside = None if scene is None else Path(scene)
        moved = find_dataparser(place, beside) if dataparser is True else Path(dataparser)
        if moved is None:
            warn_if_exported(beside)
        else:
            poses = into_the_trained_world(poses, meta, moved, root, colmap=colmap)
    merged = _with_sizes(merged, names, root)
    stated: list[Any] = [(body.get("w"), body.get("h")) for body in merged]
    for name, size in zip(names, stated):
        if not all(isinstance(side, (int, float)) and 1 <= side < np.inf for side in size):
            told = f"{size[0]} x {size[1]} for {name}"
            raise InvalidFile(f"load_cameras: {file} must state one w and h in pixels for each frame, got {told}")
    cameras = _cameras(poses, merged, names, [(int(width), int(height)) for width, height in stated])
    return cameras, names, root


def _cameras(
    poses: NDArray[np.float64],
    frames: Sequence[Mapping[str, Any]],
    names: Sequence[str],
    sizes: Sequence[tuple[int, int]],
) -> Cameras:
    """The cameras of frames whose photos have these sizes (width, height)."""
    if any(frame.get("fisheye_crop_radius") for frame in frames):
        warnings.warn(
            "load_capture: fisheye_crop_radius is not read: pixels beyond it count as part of the photos", stacklevel=3
        )
    lenses = [read_lens(frame, name, *size) for frame, name, size in zip(frames, names, sizes, strict=True)]
    lens, bend, fisheye = (np.stack(values) for values in zip(*lenses))
    width, height = np.array(sizes).T
    return Cameras.create(poses, lens, width, height, bend, fisheye)


def _cameras_source(place: Path) -> tuple[dict[str, Any], Path, Path, bool]:
    """What a file or folder says of cameras, the file to name in errors, its folder, and whether it is COLMAP's."""
    if place.is_dir() and not (place / "transforms.json").is_file():
        if find_model(place) or has_split_files(place):
            meta, label, root = _source(place)
            return meta, place, root, "COLMAP" in label
        place = place / (INRIA_FILE if (place / INRIA_FILE).is_file() else "transforms.json")
    elif place.is_dir():
        place = place / "transforms.json"
    content = read_json(place, caller="load_cameras")
    if isinstance(content, list):
        return cameras_as_frames(content, str(place)), place, place.parent, False
    return read_object(place, caller="load_cameras"), place, place.parent, False


def _with_sizes(frames: Sequence[dict[str, Any]], names: Sequence[str], root: Path) -> list[dict[str, Any]]:
    """Frames that state no size, with that of their photos where these are there."""
    bare = [number for number, frame in enumerate(frames) if frame.get("w") is None or frame.get("h") is None]
    sized = list(frames)
    found, _ = find_photos([names[number] for number in bare], root)
    for number, path in zip(bare, found):
        if path is not None:
            stored, _, _ = photo_sizes(path, caller="load_cameras")
            sized[number] = {**frames[number], "w": stored[0], "h": stored[1]}
    return sized


def _photos_folder(photos: Path, capture: Path) -> Path:
    """The folder that is meant: from where the process runs, or else from the capture (``images_4``).

    Raises:
        FileNotFoundError: there is neither.
    """
    for folder in (photos, capture / photos):
        if folder.is_dir():
            return folder
    raise MissingFile(f"load_capture: no folder {photos} with photos, neither here nor in {capture}")


def _has_images(folder: Path) -> bool:
    """Whether photos lie in ``images``, or in smaller copies of it such as ``images_4``."""
    inner = folder.iterdir() if folder.is_dir() else ()
    return any((path.name == "images" or re.fullmatch(RESIZED, path.name)) and path.is_dir() for path in inner)


def _source(folder: Path) -> tuple[dict[str, Any], str, Path]:
    """What a folder says of its photos, what to call that in errors, and where the photos' names start from."""
    model = None if (folder / "transforms.json").exists() else find_model(folder)
    if model is None:
        if not (folder / "transforms.json").exists() and has_split_files(folder):
            return read_split_files(folder), "transforms_train.json (_val, _test)", folder
        return read_object(folder / "transforms.json"), "transforms.json", folder
    places = [folder, *folder.resolve().parents[:2]] if model == folder else [folder]
    root = next((place for place in places if _has_images(place)), folder)
    prefix = "images/" if _has_images(root) else ""
    return read_model(model, prefix=prefix), f"the COLMAP model {model.name}", root


def _normalisation(
    origins: NDArray[np.float64], normalize: bool | Sequence[str], sweeps: Mapping[str, NDArray[np.int64]]
) -> NDArray[np.float64]:
    """``(4, 4)``, a factor and a shift, that puts origins into [-1, 1]; one camera, or all in one place: factor 1."""
    transform = np.eye(4)
    if normalize is False:
        return transform
    chosen = np.arange(len(origins))
    if normalize is not True:
        wanted = [normalize] if isinstance(normalize, str) else list(normalize)
        unknown = [name for name in wanted if name not in sweeps]
        if unknown or not wanted:
            raise InvalidArgument(
                f"load_capture: normalize names no sweep: {unknown}; choose from {', '.join(sweeps) or 'none'}"
            )
        chosen = np.unique(np.concatenate([sweeps[name] for name in wanted]))
    center = origins[chosen].mean(axis=0)
    reach = float(np.abs(origins[chosen] - center).max())
    factor = 1.0 / reach if reach > 1e-9 else 1.0
    transform[:3] = np.concatenate([np.eye(3), -center[:, None]], axis=1) * factor
    return transform
