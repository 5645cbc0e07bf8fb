"""Captures: posed photos as ``transforms.json`` or a COLMAP model describes them, and named sweeps of them.

OpenGL camera-to-world matrices, OPENCV or OPENCV_FISHEYE lenses, one for all photos or one for each. Needs Pillow
(``pip install unghost[eval]``), and pycolmap for COLMAP (``unghost[capture]``).
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.cameras import Cameras
from ...core.errors import InvalidArgument, InvalidFile, MissingExtra, MissingFile
from .colmap import find_model, read_model
from .splits import Splits, resolve_splits
from .transforms import read_frames, read_lens, read_object

MISSING = ("error", "drop")


def _pillow() -> Any:
    try:
        from PIL import Image
    except ImportError as error:
        raise MissingExtra("load_capture needs Pillow to read photos: pip install unghost[eval]") from error
    return Image


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

    def __len__(self) -> int:
        return len(self.names)

    @property
    def paths(self) -> tuple[Path, ...]:
        """Where each photo is."""
        return self._paths

    def photo_size(self, index: int) -> tuple[int, int]:
        """Width and height of a photo as it is stored."""
        with _pillow().open(self._paths[index]) as photo:
            return int(photo.width), int(photo.height)

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
            ValueError: a photo cannot be decoded, or has transparent pixels; photos of different sizes.
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
                self._cache[index] = _read_photo(self._paths[index], *sizes[0])
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
) -> Capture:
    """Read a capture's poses, intrinsics and sweeps, and check that every photo is there; no photo is decoded.

    Args:
        folder: holds ``transforms.json`` and the photos its ``file_path`` entries name; or is a COLMAP model or has
            one in ``sparse/0``, photos in ``images`` (needs ``unghost[capture]``).
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
        photos: folder that the photos' names refer to, if not ``folder`` (for COLMAP: ``images`` in it).

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
    meta, label, root = _source(source)
    frames, names, poses = read_frames(meta, f"{label} in {source}")
    found = [_photo_path(Path(photos or root), name) for name in names]
    dropped = _dropped(names, found, label, Path(photos or root), missing)
    here = [number for number, path in enumerate(found) if path is not None]
    frames, names, poses = [frames[k] for k in here], tuple(names[k] for k in here), poses[here]
    paths = tuple(path for path in found if path is not None)
    sizes = [_check_photo(path, frame, name, label) for path, frame, name in zip(paths, frames, names)]
    sweeps = resolve_splits(names, meta=meta, folder=root, given=splits, dropped=dropped)
    transform = _normalisation(poses[:, :3, 3], normalize, sweeps)
    poses[:, :3, 3] = poses[:, :3, 3] * transform[0, 0] + transform[:3, 3]
    cameras = _cameras(poses, frames, names, sizes).resized(1.0 / downscale)
    return Capture(source, names, cameras, sweeps, transform, float(transform[0, 0]), paths, dropped=dropped)


def load_cameras(path: str | Path) -> Cameras:
    """The cameras of a ``transforms.json`` or a COLMAP model alone, in its own world: no photo need be there.

    Args:
        path: the file, or a folder that holds one, or a model. It must state ``w`` and ``h``, for all
            frames or for each.

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
    file = Path(path) / "transforms.json" if Path(path).is_dir() else Path(path)
    if not file.is_file() and not (Path(path).is_dir() and find_model(Path(path))):
        raise MissingFile(f"load_cameras: no file {file}")
    meta = read_object(file) if file.is_file() else _source(Path(path))[0]
    merged, names, poses = read_frames(meta, str(file))
    stated: list[Any] = [(body.get("w"), body.get("h")) for body in merged]
    for name, size in zip(names, stated):
        if not all(isinstance(side, (int, float)) and 1 <= side < np.inf for side in size):
            told = f"{size[0]} x {size[1]} for {name}"
            raise InvalidFile(f"load_cameras: {file} must state one w and h in pixels for each frame, got {told}")
    return _cameras(poses, merged, names, [(int(width), int(height)) for width, height in stated])


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


def _source(folder: Path) -> tuple[dict[str, Any], str, Path]:
    """What a folder says of its photos, what to call that in errors, and where the photos' names start from."""
    model = None if (folder / "transforms.json").exists() else find_model(folder)
    if model is None:
        return read_object(folder / "transforms.json"), "transforms.json", folder
    places = [folder, *folder.resolve().parents[:2]] if model == folder else [folder]
    root = next((place for place in places if (place / "images").is_dir()), folder)
    prefix = "images/" if (root / "images").is_dir() else ""
    return read_model(model, prefix=prefix), f"the COLMAP model {model.name}", root


def _photo_path(folder: Path, name: str) -> Path | None:
    """``file_path`` without an extension is a PNG, as in the synthetic NeRF scenes."""
    return next((path for path in (folder / name, folder / f"{name}.png") if path.is_file()), None)


def _dropped(
    names: Sequence[str], found: Sequence[Path | None], label: str, folder: Path, missing: str
) -> tuple[str, ...]:
    """The photos that are not there, after saying so."""
    absent = tuple(name for name, path in zip(names, found) if path is None)
    if not absent:
        return ()
    shown = ", ".join(absent[:5]) + (", …" if len(absent) > 5 else "")
    told = f"load_capture: {len(absent)} of the {len(names)} photos that {label} names are not in {folder}: {shown}"
    if missing == "error" or len(absent) == len(names):
        raise MissingFile(told if len(absent) == len(names) else f"{told} (missing='drop' leaves them out)")
    warnings.warn(f"{told}; left out", stacklevel=3)
    return absent


def _check_photo(path: Path, frame: Mapping[str, Any], name: str, label: str) -> tuple[int, int]:
    image = _pillow()
    try:
        with image.open(path) as photo:
            found = (int(photo.width), int(photo.height))
    except OSError as error:
        raise InvalidFile(f"load_capture: cannot read photo {path} ({error})") from None
    stated = (int(frame.get("w", found[0])), int(frame.get("h", found[1])))
    if found != stated:
        raise InvalidFile(
            f"load_capture: photo {name} is {found[0]} x {found[1]}, {label} says {stated[0]} x {stated[1]}"
        )
    return found


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


def _read_photo(path: Path, width: int, height: int) -> NDArray[np.float32]:
    image = _pillow()
    try:
        with image.open(path) as photo:
            if photo.mode in ("RGBA", "LA", "PA") and photo.getchannel("A").getextrema()[0] < 255:
                raise InvalidFile(f"Capture.images: {path} has transparent pixels; put it on a background first")
            small = photo.convert("RGB").resize((width, height), image.Resampling.BOX)
            return np.asarray(small, dtype=np.float32) / np.float32(255)
    except OSError as error:
        raise InvalidFile(f"Capture.images: cannot decode {path} ({error})") from None
