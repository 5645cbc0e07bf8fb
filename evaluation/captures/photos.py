"""Stored photos: which files are photos, where those of a capture are, how large they are, and their pixels.

Needs Pillow (``pip install unghost[eval]``); HEIC needs pi-heif, too (``unghost[capture]``).

A photo whose EXIF tag says that it is to be shown turned is read as it is stored, unless only the turned size is the
one that its camera states. COLMAP (pycolmap 4.2) and nerfstudio 1.1.5 ignore the tag: poses from them belong to the
stored pixels.
"""

from __future__ import annotations

import importlib
import posixpath
import re
import shutil
import unicodedata
import warnings
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.errors import InvalidFile, MissingExtra, MissingFile
from .transforms import at_size

HEIC_ENDINGS = (".heic", ".heif")
PHOTO_ENDINGS = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp", *HEIC_ENDINGS)
UNREAD_ENDINGS = (".arw", ".avif", ".cr2", ".cr3", ".dng", ".gif", ".jp2", ".jxl", ".nef", ".orf", ".raf", ".rw2")
JPEG = {"quality": 95, "subsampling": 0}
EXIF_ORIENTATION = 0x0112
RESIZED = r"images_(\d+)"  # folders of smaller copies, as mip-NeRF 360 and nerfstudio call them


def pillow(*, caller: str) -> Any:
    """``PIL.Image``, which can open HEIC where pi-heif is installed.

    Raises:
        ImportError: Pillow is missing (names the extra).
    """
    try:
        from PIL import Image
    except ImportError as error:
        raise MissingExtra(f"{caller} needs Pillow to read photos: pip install unghost[eval]") from error
    with suppress(ImportError):
        importlib.import_module("pi_heif").register_heif_opener()
    return Image


def check_heic(paths: Iterable[Path], *, caller: str) -> None:
    """Refuse HEIC photos where pi-heif is missing.

    Raises:
        ImportError: counts them and names the first and the extra.
    """
    found = [path for path in paths if path.suffix.lower() in HEIC_ENDINGS]
    if not found:
        return
    try:
        importlib.import_module("pi_heif")
    except ImportError as error:
        raise MissingExtra(
            f"{caller}: {len(found)} HEIC photos ({found[0].name}{', …' if len(found) > 1 else ''}) need pi-heif: "
            "pip install unghost[capture]"
        ) from error


def is_hidden(path: Path) -> bool:
    """Whether a file is a dot file, such as the ``._a.jpg`` that macOS leaves beside ``a.jpg`` on foreign disks."""
    return path.name.startswith(".")


def is_photo(path: Path) -> bool:
    """Whether a file's name is one of a photo that can be read; dot files are none."""
    return path.suffix.lower() in PHOTO_ENDINGS and not is_hidden(path)


def warn_of_unread(paths: Iterable[Path], *, caller: str) -> None:
    """Warn of pictures in formats that are not read: their number by ending."""
    endings = Counter(path.suffix.lower() for path in paths if not is_hidden(path))
    left = {ending: count for ending, count in sorted(endings.items()) if ending in UNREAD_ENDINGS}
    if left:
        listed = ", ".join(f"{count} {ending}" for ending, count in left.items())
        warnings.warn(f"{caller}: pictures in formats that are not read are left out: {listed}", stacklevel=3)


def find_photos(
    names: Sequence[str], folder: Path, *, elsewhere: Path | None = None
) -> tuple[list[Path | None], list[bool]]:
    """The file of each photo of a capture.

    A name is looked up below ``folder``; then, where there is no ``images``, in ``images_2``, ``images_4`` and so on;
    and, if it is an absolute path or starts with ``..``, by as many of its last parts as lead to a file, in ``images``
    too. Below ``elsewhere`` a name may also lack its ``images/``, or be found by its last parts. An ending may differ
    in case, and a name without one is a PNG, as in the synthetic NeRF scenes.

    Args:
        names: cleaned ``file_path`` entries.
        folder: of the capture.
        elsewhere: folder to look in instead.

    Returns:
        Per photo, the file or None, and whether it may be smaller than its camera states (``elsewhere``, ``images_N``).
    """
    base = folder if elsewhere is None else elsewhere
    resized: list[Path] = []
    if elsewhere is None and base.is_dir() and not (base / "images").is_dir():
        numbered = ((re.fullmatch(RESIZED, path.name), path) for path in base.iterdir() if path.is_dir())
        resized = [path for _, path in sorted((int(match[1]), path) for match, path in numbered if match)]
    exact = [_file(base / name) for name in names]
    loose = [
        None if path is not None else _loose(name, base, resized, elsewhere is not None)
        for path, name in zip(exact, names)
    ]
    taken = Counter(path for path in (*exact, *loose) if path is not None)
    found = [path or (other if other is not None and taken[other] == 1 else None) for path, other in zip(exact, loose)]
    return found, [
        path is not None and (elsewhere is not None or any(each in path.parents for each in resized)) for path in found
    ]


def _loose(name: str, base: Path, resized: Sequence[Path], given: bool) -> Path | None:
    """A file for a name that does not lead to one."""
    inner = name.removeprefix("images/")
    for folder in resized:
        found = _file(folder / inner) or _other_ending(folder / inner)
        if found is not None:
            return found
    absolute = name.startswith("/") or re.match(r"[A-Za-z]:/", name) is not None
    if not (given or absolute or name.startswith("../")):
        return None
    parts = [part for part in name.split("/") if part not in ("", "..")]
    for start in range(len(parts)):
        found = _file(base.joinpath(*parts[start:]))
        if found is not None:
            return found
    for folder in (base / "images", *resized):
        found = _file(folder / parts[-1])
        if found is not None:
            return found
    return _other_ending(base / inner) if given else None


def _file(path: Path) -> Path | None:
    """The file of that name, with ``.png`` after it, or with its ending or its accents written in another way."""
    for each in (path, path.with_name(f"{path.name}.png")):
        if each.is_file():
            return each
    spelled = [path.with_suffix(path.suffix.lower()), path.with_suffix(path.suffix.upper())] if path.suffix else []
    spelled += [path.with_name(unicodedata.normalize(form, path.name)) for form in ("NFC", "NFD")]
    return next((each for each in spelled if each.is_file()), None)


def _other_ending(path: Path) -> Path | None:
    """The same photo in another format: smaller copies are often PNGs."""
    return next((each for ending in PHOTO_ENDINGS for each in [path.with_suffix(ending)] if each.is_file()), None)


def report_missing(
    names: Sequence[str], found: Sequence[Path | None], label: str, folder: Path, missing: str
) -> tuple[str, ...]:
    """The names of photos that are not there, after an error or a warning that counts them.

    Raises:
        FileNotFoundError: there are some and ``missing`` is ``"error"``, or there is none but these.
    """
    absent = tuple(name for name, path in zip(names, found) if path is None)
    if not absent:
        return ()
    shown = ", ".join(absent[:5]) + (", …" if len(absent) > 5 else "")
    told = f"load_capture: {len(absent)} of the {len(names)} photos that {label} names are not in {folder}: {shown}"
    if missing == "error" or len(absent) == len(names):
        raise MissingFile(told if len(absent) == len(names) else f"{told} (missing='drop' leaves them out)")
    warnings.warn(f"{told}; left out", stacklevel=3)
    return absent


def photo_sizes(path: Path, *, caller: str = "load_capture") -> tuple[tuple[int, int], tuple[int, int], int]:
    """Width and height of a photo as it is stored and as it is to be shown, and its EXIF orientation (1: as stored).

    Raises:
        ValueError: the file cannot be read as a picture.
    """
    check_heic([path], caller=caller)
    image = pillow(caller=caller)
    try:
        with image.open(path) as photo:
            stored = (int(photo.width), int(photo.height))
            orientation = exif_orientation(photo)
    except (OSError, SyntaxError, image.DecompressionBombError) as error:
        raise InvalidFile(f"{caller}: cannot read photo {path} ({error})") from None
    return stored, stored[::-1] if orientation in (5, 6, 7, 8) else stored, orientation


def exif_orientation(photo: Any) -> int:
    """The EXIF orientation of an open picture, without decoding it: 1 as stored, 5 to 8 turned by 90 degrees."""
    if photo.format == "PNG" and "exif" not in photo.info:
        return 1  # Pillow would decode the picture to look behind it
    value = photo.getexif().get(EXIF_ORIENTATION, 1)
    return int(value) if value in range(1, 9) else 1


def fit_frames(
    frames: Sequence[Mapping[str, Any]],
    paths: Sequence[Path],
    names: Sequence[str],
    label: str,
    may_be_resized: Sequence[bool],
) -> tuple[list[dict[str, Any]], frozenset[int]]:
    """Bring the lenses of frames to the sizes of their photos.

    A photo must have the size that its frame states, or that size when it is turned as its EXIF tag says, or, where
    that is allowed, the stated proportions: then the lens is scaled. A frame that states no size has that of the photo.

    Returns:
        The frames, with ``w`` and ``h`` of their photos, and the positions of those photos that are to be turned.

    Raises:
        ValueError: a photo that cannot be read or is of another size.
    """
    fitted, upright, kept = [], set(), 0
    for number, (frame, path, name, resizable) in enumerate(zip(frames, paths, names, may_be_resized, strict=True)):
        stored, shown, orientation = photo_sizes(path)
        stated = (int(frame.get("w", stored[0])), int(frame.get("h", stored[1])))
        size = next((each for each in (stored, shown) if each == stated), None)
        if size is None and resizable:
            size = next((each for each in (stored, shown) if _alike(each, stated)), None)
        if size is None:
            raise InvalidFile(
                f"load_capture: photo {name} is {stored[0]} x {stored[1]}, {label} says {stated[0]} x {stated[1]}"
            )
        if size != stored:
            upright.add(number)
        elif orientation != 1 and shown == stored:
            kept += 1
        fitted.append(at_size(frame, stated, size))
    if kept:
        warnings.warn(
            f"load_capture: the EXIF tags of {kept} photos turn them without a change of size; they are read as they "
            "are stored, as COLMAP and nerfstudio read them",
            stacklevel=3,
        )
    return fitted, frozenset(upright)


def _alike(size: tuple[int, int], stated: tuple[int, int]) -> bool:
    """Whether one size is the other by one factor, to a pixel of rounding."""
    factor = max(size) / max(stated)
    return all(abs(side - factor * other) <= 1.0 for side, other in zip(size, stated))


def read_photo(
    path: Path, width: int, height: int, *, upright: bool = False, background: float | None = None
) -> NDArray[np.float32]:
    """A photo as ``(height, width, 3)`` float32 in [0, 1] (sRGB as stored), box-filtered to that size.

    Args:
        path: of the photo.
        width, height: of the result, pixels.
        upright: turn it as its EXIF tag says.
        background: grey level in [0, 1] behind transparent pixels (composited before the photo is scaled); None
            refuses them.

    Raises:
        ValueError: it cannot be decoded, or has transparent pixels.
    """
    image = pillow(caller="Capture.images")
    try:
        with image.open(path) as photo:
            picture = importlib.import_module("PIL.ImageOps").exif_transpose(photo) if upright else photo
            small = flatten(picture, path, background).resize((width, height), image.Resampling.BOX)
            return np.asarray(small, dtype=np.float32) / np.float32(255)
    except (OSError, SyntaxError) as error:
        raise InvalidFile(f"Capture.images: cannot decode {path} ({error})") from None


def flatten(picture: Any, path: Path, background: float | None) -> Any:
    """A Pillow picture as RGB: transparent pixels in front of a grey level in [0, 1], or refused if that is None."""
    if not picture.has_transparency_data:
        return picture.convert("RGB")
    layers = picture.convert("RGBA")
    if layers.getchannel("A").getextrema()[0] == 255:
        return layers.convert("RGB")
    if background is None:
        raise InvalidFile(f"{path} has transparent pixels; put it on a background first")
    image = pillow(caller="Capture.images")
    behind = image.new("RGBA", layers.size, (round(255 * background),) * 3 + (255,))
    return image.alpha_composite(behind, layers).convert("RGB")


def store_photo(source: Path, target: Path, *, upright: bool) -> None:
    """Copy a photo, or write it anew where others could not read it as it was read here.

    Those to be turned are stored upright, HEIC becomes JPEG (``target`` says so: see :func:`stored_name`).
    """
    if not upright and source.suffix.lower() not in HEIC_ENDINGS:
        shutil.copyfile(source, target)
        return
    image = pillow(caller="write_nerfstudio")
    with image.open(source) as photo:
        picture = importlib.import_module("PIL.ImageOps").exif_transpose(photo) if upright else photo
        jpeg = target.suffix.lower() in (".jpg", ".jpeg")
        plain = picture.convert("RGB") if jpeg else picture
        plain.save(target, exif=plain.getexif(), **(JPEG if jpeg else {}))


def stored_name(file: str) -> str:
    """The name under which :func:`store_photo` writes a photo: a HEIC becomes a ``.jpg``."""
    stem, ending = posixpath.splitext(file)
    return f"{stem}.jpg" if ending.lower() in HEIC_ENDINGS else file
