"""COLMAP's sparse models (.bin or .txt), read through pycolmap (``pip install unghost[capture]``)."""

from __future__ import annotations

import shutil
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ...core.errors import InvalidFile, MissingExtra

LENSES = {  # COLMAP's camera models -> their parameters in order, by the names of transforms.json
    "SIMPLE_PINHOLE": ("fl_x", "cx", "cy"),
    "PINHOLE": ("fl_x", "fl_y", "cx", "cy"),
    "SIMPLE_RADIAL": ("fl_x", "cx", "cy", "k1"),
    "RADIAL": ("fl_x", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),  # the last three 0
    "SIMPLE_RADIAL_FISHEYE": ("fl_x", "cx", "cy", "k1"),
    "RADIAL_FISHEYE": ("fl_x", "cx", "cy", "k1", "k2"),
    "OPENCV_FISHEYE": ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "k3", "k4"),
}
OWN = "unghost"  # begins the names of models that hold triangulated points only (``unghost points``)
PLACES = ("", "sparse", "colmap/sparse")  # where a model may be below the folder of a capture


def import_pycolmap(caller: str) -> Any:
    """pycolmap, from whichever of its distributions (``pycolmap``, ``pycolmap-cuda12``) is installed.

    Raises:
        ImportError: it is missing (names the extra), or it is there and does not load (says why).
    """
    try:
        import pycolmap
    except ModuleNotFoundError as error:
        if error.name != "pycolmap":
            raise MissingExtra(f"{caller}: pycolmap is installed and needs {error.name}, which is missing") from error
        raise MissingExtra(f"{caller}: COLMAP needs pycolmap: pip install unghost[capture]") from error
    except Exception as error:  # its own compiled part, or a library of the system that this wants
        reasons = [str(each) for each in (error.__cause__, error.__context__, error) if each is not None]
        reason = " ".join(reasons[0].split()) or type(error).__name__
        raise MissingExtra(
            f"{caller}: pycolmap is installed and does not load ({reason}); pip install --force-reinstall pycolmap "
            "is the build for the CPU"
        ) from error
    return pycolmap


@contextmanager
def quiet_pycolmap(caller: str) -> Iterator[Any]:
    """pycolmap without its chatter, which comes back afterwards.

    Raises:
        ImportError: it is missing (names the extra), or it is there and does not load (says why).
    """
    pycolmap = import_pycolmap(caller)
    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    try:
        yield pycolmap
    finally:
        pycolmap.logging.minloglevel = before


def _ending(folder: Path) -> str | None:
    """``.bin`` or ``.txt`` if the folder itself is a model."""
    for ending in (".bin", ".txt"):
        if all((folder / f"{name}{ending}").is_file() for name in ("cameras", "images")):
            return ending
    return None


def has_model(folder: Path) -> bool:
    """Whether a folder itself is a sparse model: ``cameras`` and ``images``, ``.bin`` or ``.txt``."""
    return folder.is_dir() and _ending(folder) is not None


def find_model(folder: Path) -> Path | None:
    """The model that a folder is, or that lies in ``sparse`` or ``colmap/sparse``; None if there is none.

    Of several (``sparse/0``, ``sparse/1``, …: parts that COLMAP could not join) the one with the most photos, with a
    warning.
    """
    for place in PLACES:
        if _ending(folder / place):
            return folder / place
        within = sorted((folder / place).glob("*")) if place else []
        parts = [path for path in within if _ending(path) and not path.name.startswith(OWN)]
        if len(parts) > 1:
            counts = [len(read_model(part)["frames"]) for part in parts]
            told = ", ".join(f"{part.name}: {count} photos" for part, count in zip(parts, counts))
            warnings.warn(
                f"{folder / place} has parts that COLMAP did not join ({told}): the largest is read", stacklevel=3
            )
            return parts[counts.index(max(counts))]
        if parts:
            return parts[0]
    return None


def read_model(folder: str | Path, *, prefix: str = "") -> dict[str, Any]:
    """A sparse model as the object of a ``transforms.json``: a frame for each photo that has a pose, by name.

    COLMAP's cameras (+Y down, looking along +Z, world to camera) become OpenGL camera-to-world; its world stays as it
    is. Every frame has its own lens. Pixel centres are at +0.5 in both.

    Args:
        folder: holds ``cameras`` and ``images``, ``.bin`` or ``.txt``. What other files say is not read.
        prefix: put before the photos' names, such as ``images/``.

    Raises:
        ImportError: pycolmap is missing.
        ValueError: no model, a broken one, one without posed photos, or a camera model other than SIMPLE_PINHOLE,
            PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV, FULL_OPENCV with k4 = k5 = k6 = 0, SIMPLE_RADIAL_FISHEYE,
            RADIAL_FISHEYE or OPENCV_FISHEYE.
    """
    source = Path(folder)
    model, photos = _opened(source)
    photos = sorted((pair for pair in photos if pair[1].has_pose), key=lambda pair: pair[0])
    if not photos:
        raise InvalidFile(f"read_model: {source} has no photo with a pose")
    used = {photo.camera_id for _, photo in photos}
    lenses = {number: lens_of(camera, source) for number, camera in model.cameras.items() if number in used}
    frames = []
    for name, photo in photos:
        pose = photo.cam_from_world().inverse().matrix() * np.array([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": prefix + name, **lenses[photo.camera_id], "transform_matrix": pose.tolist()})
    return {"frames": frames}


def image_names(folder: str | Path) -> dict[int, str]:
    """Photo name of every image id of a sparse model.

    Raises:
        ImportError: pycolmap is missing.
        ValueError: no model, or a broken one.
    """
    return {int(image.image_id): str(name) for name, image in _opened(Path(folder))[1]}


def _opened(source: Path) -> tuple[Any, list[tuple[str, Any]]]:
    """A ``pycolmap.Reconstruction`` without points, and its images with their names."""
    ending = _ending(source)
    if ending is None:
        raise InvalidFile(f"read_model: {source} has no cameras and images, .bin or .txt: not a COLMAP model")
    with quiet_pycolmap("read_model") as pycolmap, tempfile.TemporaryDirectory() as scratch:
        shutil.copyfile(source / f"cameras{ending}", Path(scratch, f"cameras{ending}"))
        names: dict[str, str] | None = None
        if ending == ".txt":
            names = _rename(source / "images.txt", Path(scratch, "images.txt"))
        else:
            shutil.copyfile(source / "images.bin", Path(scratch, "images.bin"))
        # No points: they are not needed, and a file of them that is cut short would take the process down.
        Path(scratch, f"points3D{ending}").write_bytes(bytes(8) if ending == ".bin" else b"")
        try:
            model = pycolmap.Reconstruction(scratch)
        except Exception as error:  # whatever the library makes of bad bytes
            reason = str(error).replace(scratch, str(source)).splitlines()[0]
            raise InvalidFile(f"read_model: {source} is no COLMAP model that can be read ({reason})") from None
    return model, [(each.name if names is None else names[each.name], each) for each in model.images.values()]


def _rename(source: Path, target: Path) -> dict[str, str]:
    """Copy ``images.txt`` with names that have no spaces: COLMAP's reader ends a name at the first.

    A photo is a line ``ID QW QX QY QZ TX TY TZ CAMERA_ID NAME``, with the name up to its end, and a line of points
    (which are left out). Comments and blank lines may stand before a photo.

    Returns:
        The new names -> those of the file.
    """
    lines = iter(source.read_text(encoding="utf-8-sig", errors="surrogateescape").split("\n"))
    names: dict[str, str] = {}
    written = []
    for line in lines:
        words = line.strip().split(None, 9)
        if not words or words[0].startswith("#"):
            continue
        if len(words) < 10:
            raise InvalidFile(f"read_model: {source} has a line that is no photo: {line.strip()[:60]!r}")
        key = f"{len(names):09d}"
        names[key] = words[9]
        written += [" ".join([*words[:9], key]), ""]
        next(lines, None)
    target.write_text("\n".join(written) + "\n", encoding="utf-8")
    return names


def lens_of(camera: Any, source: Path) -> dict[str, Any]:
    """One ``pycolmap.Camera``'s part of a frame.

    Raises:
        ValueError: its model is not read.
    """
    model = camera.model.name
    if model not in LENSES:
        raise InvalidFile(
            f"read_model: camera {camera.camera_id} of {source} is a {model}, none of {', '.join(LENSES)}; "
            "undistort the photos first (colmap image_undistorter)"
        )
    values = dict(zip(LENSES[model], (float(value) for value in camera.params), strict=True))
    if model == "FULL_OPENCV" and any(values[key] for key in ("k4", "k5", "k6")):
        raise InvalidFile(
            f"read_model: camera {camera.camera_id} of {source} is a FULL_OPENCV with k4, k5, k6 other than 0; "
            "undistort the photos first (colmap image_undistorter)"
        )
    return {"camera_model": model, "w": int(camera.width), "h": int(camera.height), "fl_y": values["fl_x"], **values}
