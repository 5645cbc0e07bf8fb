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
PLACES = ("", "sparse", "colmap/sparse")  # where a model may be below the folder of a capture


@contextmanager
def quiet_pycolmap(caller: str) -> Iterator[Any]:
    """pycolmap without its chatter, which comes back afterwards.

    Raises:
        ImportError: it is missing (names the extra).
    """
    try:
        import pycolmap
    except ImportError as error:
        raise MissingExtra(f"{caller}: COLMAP needs pycolmap: pip install unghost[capture]") from error
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


def find_model(folder: Path) -> Path | None:
    """The model that a folder is, or that lies in ``sparse`` or ``colmap/sparse``; None if there is none.

    Of several (``sparse/0``, ``sparse/1``, …: parts that COLMAP could not join) the one with the most photos, with a
    warning.
    """
    for place in PLACES:
        if _ending(folder / place):
            return folder / place
        parts = [path for path in sorted((folder / place).glob("*")) if place and _ending(path)]
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
    ending = _ending(source)
    if ending is None:
        raise InvalidFile(f"read_model: {source} has no cameras and images, .bin or .txt: not a COLMAP model")
    with quiet_pycolmap("read_model") as pycolmap, tempfile.TemporaryDirectory() as scratch:
        for name in ("cameras", "images"):
            shutil.copyfile(source / f"{name}{ending}", Path(scratch, f"{name}{ending}"))
        # No points: they are not needed, and a file of them that is cut short would take the process down.
        Path(scratch, f"points3D{ending}").write_bytes(bytes(8) if ending == ".bin" else b"")
        try:
            model = pycolmap.Reconstruction(scratch)
        except Exception as error:  # whatever the library makes of bad bytes
            reason = str(error).replace(scratch, str(source)).splitlines()[0]
            raise InvalidFile(f"read_model: {source} is no COLMAP model that can be read ({reason})") from None
    photos = sorted((each for each in model.images.values() if each.has_pose), key=lambda each: each.name)
    if not photos:
        raise InvalidFile(f"read_model: {source} has no photo with a pose")
    used = {photo.camera_id for photo in photos}
    lenses = {number: lens_of(camera, source) for number, camera in model.cameras.items() if number in used}
    frames = []
    for photo in photos:
        pose = photo.cam_from_world().inverse().matrix() * np.array([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": prefix + photo.name, **lenses[photo.camera_id], "transform_matrix": pose.tolist()})
    return {"frames": frames}


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
