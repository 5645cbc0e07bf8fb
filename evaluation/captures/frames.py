"""Photos of one sweep from a video or a folder: the sharpest of each of so many equal stretches.

Needs PyAV and Pillow (``pip install unghost[capture]``).
"""

from __future__ import annotations

import importlib
import re
import shutil
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...core.errors import InvalidArgument, InvalidFile, MissingExtra, MissingFile
from .photos import (
    HEIC_ENDINGS,
    JPEG,
    PHOTO_ENDINGS,
    check_heic,
    exif_orientation,
    is_photo,
    pillow,
    stored_name,
    warn_of_unread,
)


@dataclass(frozen=True)
class Extraction:
    """What :func:`extract_frames` wrote.

    Attributes:
        paths: of the photos, in the order in which they were taken.
        sources: of each, its number in the video (from 0) or its file name in the folder.
        seen: frames or photos there were.
        size: width, height in pixels of all of them.
    """

    paths: tuple[Path, ...]
    sources: tuple[int | str, ...]
    seen: int
    size: tuple[int, int]


def sharpness(grey: NDArray[Any]) -> float:
    """Variance of the Laplacian of a grey picture ``(H, W)`` in [0, 255], both > 2: larger is sharper.

    Compares pictures of one scene and size only; noise counts as sharpness.
    """
    if grey.ndim != 2 or min(grey.shape) < 3:
        raise InvalidArgument(f"sharpness: grey must have shape (H, W), both > 2, got {grey.shape}")
    picture = grey.astype(np.float32)
    inner = picture[1:-1, 1:-1]
    around = picture[:-2, 1:-1] + picture[2:, 1:-1] + picture[1:-1, :-2] + picture[1:-1, 2:]
    return float((around - 4.0 * inner).var(dtype=np.float64))


def extract_frames(source: str | Path, folder: str | Path, *, prefix: str, count: int) -> Extraction:
    """Keep the sharpest picture of each of ``count`` equal stretches of a video, or of a folder of photos.

    A folder of at most ``count`` photos is taken whole. Its photos are copied as they are, unless they are to be shown
    turned (EXIF), as phones store them: then they are stored upright. HEIC photos and frames of a video become JPEGs,
    upright too. Dot files are no photos; a warning counts pictures in formats that are not read.

    Args:
        source: a video that FFmpeg can read, or a folder (photos by name; folders in it are not entered).
        folder: where the photos go; created.
        prefix: ``frame_`` makes ``frame_00001.jpg``, ….
        count: at most so many are kept; >= 1.

    Raises:
        FileNotFoundError: no such video or folder.
        ValueError: one that has no pictures, cannot be decoded, or has pictures of several sizes.
        ImportError: PyAV or Pillow is missing, or pi-heif for HEIC photos.
    """
    origin, target = Path(source), Path(folder)
    if count < 1:
        raise InvalidArgument(f"extract_frames: count must be >= 1, got {count}")
    if not origin.exists():
        raise MissingFile(f"extract_frames: no video or folder {origin}")
    target.mkdir(parents=True, exist_ok=True)
    take = _from_folder if origin.is_dir() else _from_video
    found = take(origin, target, prefix, count)
    sizes = Counter(size for _, _, size in found.pictures)
    if len(sizes) != 1:
        told = ", ".join(f"{n} of {width} x {height}" for (width, height), n in sizes.most_common())
        raise InvalidArgument(f"extract_frames: the pictures of {origin} must all have one size, got {told}")
    paths, sources, (size, *_) = zip(*found.pictures)
    return Extraction(paths, sources, found.seen, size)


class _Found(NamedTuple):
    pictures: list[tuple[Path, int | str, tuple[int, int]]]  # written, what it was, width and height
    seen: int


def _sharpest(pictures: Iterable[tuple[Any, NDArray[Any]]], total: int, count: int) -> Iterator[tuple[int, Any]]:
    """Of each of ``count`` equal stretches of ``total`` (picture, grey) pairs, the number and picture of the best."""
    best: tuple[float, int, Any] | None = None
    stretch = 0
    for number, (picture, grey) in enumerate(pictures):
        here = min(number * count // total, count - 1)
        if best is not None and here != stretch:
            yield best[1:]
            best = None
        clarity = sharpness(grey)
        if best is None or clarity > best[0]:
            best = clarity, number, picture
        stretch = here
    if best is not None:
        yield best[1:]


def import_libraries(*names: str) -> list[Any]:
    """Modules from outside.

    Raises:
        ImportError: one is missing (names the extra), or is there and does not load (says why).
    """
    modules = []
    for name in names:
        try:
            modules.append(importlib.import_module(name))
        except ModuleNotFoundError as error:
            raise MissingExtra(f"extract_frames: needs {error.name}: pip install unghost[capture]") from error
        except Exception as error:  # a compiled part, or a library of the system
            reason = " ".join(str(error).split())
            raise MissingExtra(f"extract_frames: {name} is installed and does not load ({reason})") from error
    return modules


def _from_video(source: Path, folder: Path, prefix: str, count: int) -> _Found:
    av, image = import_libraries("av", "PIL.Image")
    pictures: list[tuple[Path, int | str, tuple[int, int]]] = []
    seen = 0

    def decoded(container: Any) -> Iterator[tuple[Any, NDArray[Any]]]:
        nonlocal seen
        for frame in container.decode(video=0):
            seen += 1
            yield frame, frame.to_ndarray(format="gray")

    try:
        with av.open(str(source)) as container:
            if not container.streams.video:
                raise InvalidFile(f"extract_frames: {source} has no video in it")
            total = sum(1 for packet in container.demux(video=0) if packet.size)
        with av.open(str(source)) as container:
            for number, frame in _sharpest(decoded(container), max(total, 1), count):
                upright = np.rot90(frame.to_ndarray(format="rgb24"), frame.rotation // 90)
                path = folder / f"{prefix}{len(pictures) + 1:05d}.jpg"
                image.fromarray(np.ascontiguousarray(upright)).save(path, **JPEG)
                pictures.append((path, number, (upright.shape[1], upright.shape[0])))
    except av.error.FFmpegError as error:
        raise InvalidFile(f"extract_frames: cannot read {source} as a video ({error.strerror})") from None
    if not pictures:
        raise InvalidFile(f"extract_frames: {source} has no frame that can be decoded")
    return _Found(pictures, seen)


def _from_folder(source: Path, folder: Path, prefix: str, count: int) -> _Found:
    image, operations = import_libraries("PIL.Image", "PIL.ImageOps")
    files = [path for path in source.iterdir() if path.is_file()]
    photos = sorted(filter(is_photo, files), key=_natural)
    warn_of_unread(files, caller="extract_frames")
    if not photos:
        raise InvalidFile(f"extract_frames: no photos in {source} (looked for {', '.join(PHOTO_ENDINGS)})")
    check_heic(photos, caller="extract_frames")
    image = pillow(caller="extract_frames")
    pictures: list[tuple[Path, int | str, tuple[int, int]]] = []
    try:
        if len(photos) > count:
            greys = ((path, np.asarray(image.open(path).convert("L"))) for path in photos)
            chosen = [path for _, path in _sharpest(greys, len(photos), count)]
        else:
            chosen = photos
        for path in chosen:
            written = folder / stored_name(f"{prefix}{len(pictures) + 1:05d}{path.suffix.lower()}")
            heic = path.suffix.lower() in HEIC_ENDINGS  # which neither COLMAP nor nerfstudio reads
            with image.open(path) as photo:
                if exif_orientation(photo) == 1 and not heic:
                    size = photo.size
                    shutil.copyfile(path, written)
                else:
                    upright = operations.exif_transpose(photo)
                    size = upright.size
                    jpeg = heic or photo.format == "JPEG"
                    plain = upright.convert("RGB") if heic else upright
                    plain.save(written, exif=upright.getexif(), **(JPEG if jpeg else {}))
            pictures.append((written, path.name, size))
    except OSError as error:
        raise InvalidFile(f"extract_frames: cannot read a photo of {source} ({error})") from None
    return _Found(pictures, len(photos))


def _natural(path: Path) -> list[Any]:
    """photo2 before photo10."""
    return [int(part) if part.isdigit() else part for part in re.split(r"([0-9]+)", path.name.lower())]
