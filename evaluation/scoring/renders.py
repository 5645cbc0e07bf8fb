"""Folders of pictures: anyone's renders and what they are scored against. Needs Pillow (``pip install unghost[eval]``).

A folder of renders holds a colour image a view, and beside them what else was rendered (all optional)::

    renders/frame_1_00001.png …           8-bit colour, PNG or JPEG
    renders/depth/frame_1_00001.npy …     (H, W) a view; so, too, accumulation, uncertainty or confidence, and normals
    renders/maps.npz                      or all views at once: "names" (n,) and "depth" (n, H, W) and so on

What ``ns-render dataset`` writes is read, too: pictures in ``rgb``, maps of shape (H, W, 1) in ``raw-depth/….npy.gz``.
Pictures belong together by their path within the folder, without its ending; or, where that does not work out for
all of them, by their file names alone. Whatever does not match is reported together, before any picture is read.
"""

from __future__ import annotations

import gzip
import warnings
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.errors import InvalidArgument, InvalidFile, MissingFile
from ..captures.photos import PHOTO_ENDINGS, check_heic, exif_orientation, flatten, is_photo, pillow, warn_of_unread
from ..metrics.checks import Mask
from .views import Renders, pad_views

Shape = tuple[int, int]  # height and width

PICTURES = PHOTO_ENDINGS
EIGHT_BITS = ("RGB", "L", "P", "RGBA", "LA", "PA", "1")
KNOBS = ("confidence", "uncertainty")
MAPS = ("depth", "accumulation", "normals", *KNOBS)
ARCHIVE = "maps.npz"
COLORS, RAW, PACKED = "rgb", "raw-", ".npy.gz"  # nerfstudio's
BESIDE = {"depth": np.inf, "accumulation": 0.0}  # a view that is smaller than the others; NaN for the other maps
NAMED = 3  # of those that do not match, in a message


@dataclass(frozen=True, eq=False)
class Method:
    """What one method rendered of the evaluation views.

    Attributes:
        name: of the method.
        renders: colours and maps.
        confidence: ``(n, H, W)``, larger is surer, no NaN where a pixel counts: a method that says how sure it is has a
            knob, and is a curve of score over coverage instead of a point. None: it has none.
    """

    name: str
    renders: Renders
    confidence: NDArray[Any] | None = None


def read_method(name: str, folder: str | Path, views: Sequence[str], shape: Shape | Sequence[Shape]) -> Method:
    """Read a folder of renders (see the module).

    Args:
        name: of the method.
        folder: its renders.
        views: what the views are called; an ending (``images/a.jpg``) is left aside.
        shape: ``(height, width)`` that all must have, or one a view. Views that differ in size are padded at the right
            and below (:func:`~unghost.evaluation.scoring.views.pad_views`).

    Raises:
        FileNotFoundError: no such folder.
        ValueError: renders that are missing, too many, of another size or no 8-bit colours; maps that do not fit, or
            hold values that cannot be: NaN depth (counted).
    """
    source = Path(folder)
    found = _pictures(source / COLORS if (source / COLORS).is_dir() else source, skip=MAPS)
    paths = [found[key] for key in match_names("renders", list(found), views, where=str(source))]
    maps = {key: read_map(source, key, views, shape) for key in MAPS}
    colours = _stack(paths, shape)
    both = [key for key in KNOBS if maps[key] is not None]
    if len(both) > 1:
        raise InvalidFile(f"read_method: {source} has both confidence and uncertainty maps; keep one")
    confidence = None
    if both:
        values = maps[both[0]]
        confidence = values if both[0] == "confidence" else -values
    try:
        renders = Renders(colours, maps["depth"], maps["accumulation"], maps["normals"])
    except ValueError as error:
        raise InvalidFile(f"{error} (in {source})") from None
    return Method(name, renders, confidence)


def read_photos(
    folder: str | Path, views: Sequence[str] | None = None, *, downscale: float = 1.0
) -> tuple[tuple[str, ...], NDArray[np.float32]]:
    """Photos of a folder, in the order of their names or of ``views``.

    Args:
        folder: PNG, JPEG, HEIC and others, in folders below it too; dot files are left out. Transparent pixels stand
            before white. Photos are read as they are stored, whatever their EXIF tags say of turning, as COLMAP and
            nerfstudio read them; a warning counts those that have such a tag.
        views: only these; None: all there are.
        downscale: stored pixels to one of the result, along each axis, >= 1; the size is rounded to whole pixels.

    Returns:
        The names ``(n,)`` and ``(n, H, W, 3)`` float32 sRGB in [0, 1], box-filtered.

    Raises:
        FileNotFoundError: no such folder.
        ValueError: no photo, photos of ``views`` that are missing, of two sizes (:func:`read_sized_photos` takes them),
            transparent or undecodable.
    """
    names, photos, sizes = read_sized_photos(folder, views, downscale=downscale)
    if (sizes != sizes[:1]).any():
        listed = _listed({_times(size) for size in map(tuple, sizes.tolist())})
        raise InvalidFile(f"read_photos: the photos of {folder} must have one size, got {listed}")
    return names, photos


def read_sized_photos(
    folder: str | Path, views: Sequence[str] | None = None, *, downscale: float = 1.0
) -> tuple[tuple[str, ...], NDArray[np.float32], NDArray[np.int64]]:
    """:func:`read_photos` that may differ in size: padded at the right and below, with each one's width and height.

    Returns:
        names ``(n,)``, photos ``(n, H, W, 3)``, sizes ``(n, 2)``.

    Raises:
        FileNotFoundError, ValueError: as :func:`read_photos`, but for sizes.
    """
    if not downscale >= 1:
        raise InvalidArgument(f"read_photos: downscale must be >= 1, got {downscale}")
    source = Path(folder)
    found = _pictures(source)
    names = tuple(found) if views is None else tuple(views)
    keys = names if views is None else match_names("photos", list(found), names, where=str(source), whole=False)
    paths = [found[key] for key in keys]
    turned = sum(_turned(path) for path in paths)
    if turned:
        warnings.warn(
            f"read_photos: the EXIF tags of {turned} photos in {source} turn them; they are read as they are stored, "
            "as COLMAP and nerfstudio read them",
            stacklevel=2,
        )
    stored = [_size(path) for path in paths]
    shapes = [(max(1, round(height / downscale)), max(1, round(width / downscale))) for width, height in stored]
    sizes = np.array([shape[::-1] for shape in shapes], dtype=np.int64)
    return names, _stack(paths, shapes, resize=True, background=1.0), sizes


def read_masks(folder: str | Path, views: Sequence[str], shape: Shape | Sequence[Shape]) -> Mask:
    """White-on-black mask pictures, a view each: ``(n, H, W)`` bool, from half of white on a pixel counts.

    ``images_a.png.mask.png``, as ``unghost masks`` names them, belongs to view ``images/a.png``, or, of a folder of
    photos, to ``a``.

    Raises:
        ValueError: masks that are missing, or two of one view.
    """
    source = Path(folder)
    flat = {_stem(view).replace("/", "_"): _stem(view) for view in views}
    found: dict[str, Path] = {}
    for key, path in _pictures(source).items():
        stem = _stem(key.removesuffix(".mask"))
        ends = [each for each in flat if stem == each or stem.endswith(f"_{each}")]
        view = flat[max(ends, key=len)] if ends and stem not in flat.values() else stem
        if view in found:
            raise InvalidFile(f"{source} has two masks of {view}: {found[view].name} and {path.name}")
        found[view] = path
    keys = match_names("masks", list(found), views, where=str(source), whole=False)
    return np.asarray(_stack([found[key] for key in keys], shape).mean(axis=-1) >= 0.5, dtype=np.bool_)


def read_map(folder: str | Path, key: str, views: Sequence[str], shape: Shape | Sequence[Shape]) -> Any:
    """One kind of map of the views, without their pictures: ``(n, H, W)`` (normals: ``(n, H, W, 3)``), or None.

    Args:
        folder: of the renders.
        key: one of ``MAPS``.
        views, shape: as in :func:`read_method`.

    Raises:
        ValueError: maps of views that are missing, of another shape, or not floating point.
    """
    below, archive = Path(folder) / key, Path(folder) / ARCHIVE
    shapes = _shapes(shape, len(views))
    canvas, deep = _canvas(shapes), (3,) if key == "normals" else ()
    if archive.is_file():
        names, values = _archive(archive, key)
        if values is not None:
            chosen = match_names(f"{key} maps", names, views, where=str(archive), whole=False)
            position = {name: index for index, name in enumerate(names)}
            chosen_maps = values[[position[name] for name in chosen]]
            stacked = _checked(f"{key} in {archive}", chosen_maps, (*canvas, *deep))
            if all(each == canvas for each in shapes):
                return stacked
            return pad_views(
                [each[: s[0], : s[1]] for each, s in zip(stacked, shapes)], canvas, BESIDE.get(key, np.nan)
            )
    below = below if below.is_dir() else below.with_name(RAW + key)
    if not below.is_dir():
        return None
    files = sorted(path for path in below.rglob("*.npy*") if path.name.endswith((".npy", PACKED)))
    found = {path.relative_to(below).as_posix().removesuffix(".gz").removesuffix(".npy"): path for path in files}
    if not found:
        return None  # pictures for people
    chosen = match_names(f"{key} maps", list(found), views, where=str(below), whole=False)
    maps = [
        _checked(str(found[name]), _load(found[name])[None], (*each, *deep))[0] for name, each in zip(chosen, shapes)
    ]
    return pad_views(maps, canvas, BESIDE.get(key, np.nan))


def match_names(
    what: str, given: Sequence[str], views: Sequence[str], *, where: str, whole: bool = True
) -> tuple[str, ...]:
    """Which of the given names belongs to each view: by path without ending, else by file name alone.

    Args:
        what: for the message.
        given: names without endings.
        views: names with or without endings.
        where: for the message.
        whole: more names than views are a mistake, too.

    Raises:
        ValueError: views without a name, or names without a view: counted, the first few of each named.
    """
    best: tuple[list[str], list[str]] | None = None
    for key in (_stem, lambda name: PurePosixPath(_stem(name)).name):
        there, wanted = {key(name): name for name in reversed(given)}, [key(view) for view in views]
        if len(there) != len(given) or len(set(wanted)) != len(wanted):
            continue  # two in different folders share a file name
        missing = [view for view, each in zip(views, wanted) if each not in there]
        surplus = [name for each, name in there.items() if each not in set(wanted)][::-1] if whole else []
        if not missing and not surplus:
            return tuple(there[each] for each in wanted)
        if best is None or len(missing) + len(surplus) < len(best[0]) + len(best[1]):
            best = missing, surplus
    missing, surplus = best or ([], [])
    said = [f"{len(missing)} of {len(views)} views have none ({_listed(missing)})"] if missing else []
    said += [f"{len(surplus)} belong to no view ({_listed(surplus)})"] if surplus else []
    raise InvalidFile(f"match_names: {what} in {where} do not match the views: {'; '.join(said) or 'names repeat'}")


def _stem(name: str) -> str:
    path = PurePosixPath(name)
    return path.with_suffix("").as_posix() if path.suffix.lower() in (*PICTURES, ".npy") else path.as_posix()


def _listed(names: Any) -> str:
    listed = sorted(map(str, names))
    return ", ".join(listed[:NAMED]) + (", …" if len(listed) > NAMED else "")


def _pictures(folder: Path, skip: Sequence[str] = ()) -> dict[str, Path]:
    """Name without ending -> path, in the order of names; folders in ``skip`` are left out."""
    if not folder.is_dir():
        raise MissingFile(f"no folder {folder}")
    found: dict[str, Path] = {}
    files = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    inside = {path: path.relative_to(folder) for path in files}
    files = [path for path in files if inside[path].parts[0] not in skip]
    warn_of_unread(files, caller="evaluate")
    for path in files:
        inner = inside[path]
        if not is_photo(path):
            continue
        name = inner.with_suffix("").as_posix()
        if name in found:
            raise InvalidFile(f"{folder} has {name} twice: {found[name].name} and {path.name}")
        found[name] = path
    if not found:
        raise InvalidFile(f"{folder} holds no pictures ({', '.join(PICTURES)})")
    check_heic(found.values(), caller="evaluate")
    return found


def _archive(path: Path, key: str) -> tuple[list[str], Any]:
    loaded: Mapping[str, Any] = _load(path)
    foreign = set(loaded) - {"names", *MAPS}
    if foreign:
        raise InvalidFile(f"{path} holds {_listed(foreign)}; it may hold names, {', '.join(MAPS)}")
    if key not in loaded:
        return [], None
    names, values = loaded.get("names"), loaded[key]
    if names is None or names.dtype.kind != "U" or names.ndim != 1 or len(names) != len(values):
        raise InvalidFile(f"{path} must hold names, one text for each of the {len(values)} maps of {key}")
    return [str(name) for name in names], values


def _load(path: Path) -> Any:
    try:
        if path.name.endswith(PACKED):
            with gzip.open(path) as stream:
                values = np.load(stream, allow_pickle=False)
            return values[..., 0] if values.ndim == 3 and values.shape[-1] == 1 else values
        loaded = np.load(path, allow_pickle=False)
        return loaded if isinstance(loaded, np.ndarray) else {name: loaded[name] for name in loaded.files}
    except (OSError, EOFError, ValueError, zlib.error, zipfile.BadZipFile) as error:
        raise InvalidFile(f"{path} is no .npy or .npz of numbers and text ({type(error).__name__})") from None


def _checked(where: str, values: NDArray[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    if values.shape[1:] != shape or not np.issubdtype(values.dtype, np.floating):
        raise InvalidFile(
            f"{where} must be floating point of shape {shape} a view, got {values.dtype} {values.shape[1:]}"
        )
    return values


def _shapes(shape: Shape | Sequence[Shape], count: int) -> list[Shape]:
    """Height and width of each view."""
    return [(int(height), int(width)) for height, width in np.broadcast_to(np.array(shape), (count, 2))]


def _canvas(shapes: Sequence[Shape]) -> Shape:
    return max(each[0] for each in shapes), max(each[1] for each in shapes)


def _times(size: tuple[int, int]) -> str:
    return f"{size[0]} x {size[1]}"


def _turned(path: Path) -> bool:
    image = _pillow()
    try:
        with image.open(path) as picture:
            return exif_orientation(picture) != 1
    except (OSError, SyntaxError, image.DecompressionBombError) as error:
        raise InvalidFile(f"cannot read {path} ({error})") from None


def _size(path: Path) -> tuple[int, int]:
    image = _pillow()
    try:
        with image.open(path) as picture:
            return int(picture.width), int(picture.height)
    except (OSError, image.DecompressionBombError) as error:
        raise InvalidFile(f"cannot read {path} ({error})") from None


def _stack(
    paths: Sequence[Path],
    shape: Shape | Sequence[Shape],
    *,
    resize: bool = False,
    background: float | None = None,
) -> NDArray[np.float32]:
    """``(n, H, W, 3)`` float32 in [0, 1]; pictures of another size are refused together unless resized."""
    shapes = _shapes(shape, len(paths))
    sizes = [(width, height) for height, width in shapes]
    other = [(path, _size(path), size) for path, size in zip(paths, sizes) if not resize and _size(path) != size]
    if other:
        wanted = other[0][2]
        factor = wanted[0] / other[0][1][0]
        hint = f"; the photos are {factor:.4g} times as wide (see downscale)" if factor > 1 else ""
        raise InvalidFile(
            f"{len(other)} of {len(paths)} pictures in {other[0][0].parent} are not {_times(wanted)} as the photos "
            f"are: {_listed(f'{path.name} is {_times(size)}' for path, size, _ in other)}{hint}"
        )
    return pad_views([_read(path, size, background) for path, size in zip(paths, sizes)], _canvas(shapes), 0.0)


def _read(path: Path, size: tuple[int, int], background: float | None) -> NDArray[np.float32]:
    image = _pillow()
    try:
        with image.open(path) as picture:
            if picture.mode not in EIGHT_BITS:
                raise InvalidFile(f"{path} has pixels of kind {picture.mode}, not 8-bit colours")
            plain = flatten(picture, path, background)
            small = plain if plain.size == size else plain.resize(size, image.Resampling.BOX)
            return np.asarray(small, dtype=np.float32) / np.float32(255)
    except (OSError, image.DecompressionBombError) as error:
        raise InvalidFile(f"cannot decode {path} ({error})") from None


def _pillow() -> Any:
    return pillow(caller="evaluate")
