"""Triangulate sparse points from chosen photos of a capture alone, with the poses that the capture has (pycolmap)."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core.errors import InvalidArgument
from ...core.io import new_folder
from ...core.sparse_points import LEAST_ANGLE, MOST_ERROR, FilteredPoints, SparsePoints, check_thresholds
from .colmap import quiet_pycolmap
from .photos import read_photo
from .points import read_points, read_tracks
from .posing import MATCHING, OVERLAP, Progress, check_pycolmap, match_pairs

if TYPE_CHECKING:
    from .loading import Capture

PLAIN = (".jpg", ".jpeg", ".png")  # COLMAP reads these from disk; others are decoded first
LONGEST_SIDE = 1600
PEAK_THRESHOLD = 0.002  # of SIFT's contrast; COLMAP's own is .0067
MOST_FEATURES = 16_384  # a photo
TO_COLMAP = np.diag([1.0, -1.0, -1.0])  # OpenGL's camera axes to COLMAP's


def triangulate(
    capture: Capture,
    indices: ArrayLike,
    *,
    out: str | Path | None = None,
    matching: str = "exhaustive",
    overlap: int = OVERLAP,
    most_error: float = MOST_ERROR,
    least_angle: float = LEAST_ANGLE,
    longest_side: int = LONGEST_SIDE,
    seed: int = 0,
    threads: int = 0,
    progress: Progress | None = None,
    log: Callable[[str], None] | None = None,
) -> SparsePoints:
    """Triangulate points from the pixels of some photos alone, with known poses and lenses: SIFT features, matched.

    No other photo, keypoint or pose is read, so points for training hold nothing of an evaluation sweep (its photos may
    have helped to find the poses: that is part of the protocol). Points that their own observations contradict, or do
    not determine, are dropped (:meth:`~unghost.core.sparse_points.SparsePoints.filtered`).

    Args:
        capture: from ``load_capture``, at any ``downscale``: photos are read at their own size.
        indices: ``(n,)`` unique positions of at least two photos, such as ``capture.split("train")``.
        out: new folder for the COLMAP model, in the world of the capture's file; None for none.
        matching: ``"exhaustive"``, every pair; ``"sequential"``, for many photos that stand in the order in which they
            were taken: each with its next ``overlap`` ones, and with those 2, 4, 8, … further on.
        overlap: of sequential matching, photos, >= 1.
        most_error: mean reprojection error of a point, pixels of the photos as they are stored.
        least_angle: triangulation angle of a point, degrees. COLMAP itself drops points beyond 4 pixels and below 1.5
            degrees.
        longest_side: features are looked for in photos shrunk to this many pixels. Smaller is faster.
        seed: of COLMAP's random choices.
        threads: 0 for one per core.
        progress: called with a stage (``features``, ``pairs``, ``points``), how much is done, and how much there is.
        log: called with one line that counts the dropped points.

    Returns:
        Points in the frame of ``capture.cameras``; ``camera`` counts positions in ``indices``.

    Raises:
        ImportError: pycolmap is missing, does not load, or is too old.
        ValueError: fewer than two photos, an index twice or out of range, an option out of range, ``out`` is there
            already, nothing matches, no point is left.
    """
    chosen = _checked_indices(indices, len(capture))
    _check_options(matching, overlap, longest_side, seed, threads)
    check_thresholds(most_error, least_angle, caller="triangulate")
    if out is not None and Path(out).exists() and (not Path(out).is_dir() or any(Path(out).iterdir())):
        raise InvalidArgument(f"triangulate: {out} is there already: remove it, or choose another out")
    tell = progress or (lambda stage, done, total: None)
    with quiet_pycolmap("triangulate") as pycolmap, tempfile.TemporaryDirectory() as scratch:
        check_pycolmap(pycolmap, caller="triangulate")
        folder, database = Path(scratch), Path(scratch, "database.db")
        names = _stored_photos(capture, chosen, folder / "photos")
        groups = _write_known(capture, chosen, names, folder / "known")
        _extract(pycolmap, database, folder / "photos", names, groups, longest_side, threads, tell)
        steps = overlap if matching == "sequential" else None
        match_pairs(pycolmap, database, names, seed=seed, threads=threads, tell=tell, overlap=steps)
        tell("points", 0, 1)
        model = _triangulated(pycolmap, database, folder, names)
        if not model.num_points3D():
            raise InvalidArgument(
                f"triangulate: nothing matches in the {len(names)} photos: they show different things"
            )
        originals = dict(zip(names, (capture.names[index] for index in chosen)))
        for image in model.images.values():
            image.name = originals[image.name]
        result = _filter(capture, chosen, model, folder, most_error, least_angle)
        tell("points", 1, 1)
        if log is not None:
            log(result.about)
        if not len(result.points):
            raise InvalidArgument(f"triangulate: no point is left: {result.about}")
        if out is not None:
            with new_folder(out) as partial:
                for path in (folder / "model").iterdir():
                    shutil.copyfile(path, partial / path.name)
    return result.points


def _checked_indices(indices: ArrayLike, count: int) -> NDArray[np.int64]:
    chosen = np.asarray(indices, dtype=np.int64)
    if chosen.ndim != 1 or len(chosen) < 2 or len(set(chosen.tolist())) < len(chosen):
        raise InvalidArgument(f"triangulate: indices must name two different photos or more, got {chosen.tolist()}")
    if chosen.min() < 0 or chosen.max() >= count:
        raise InvalidArgument(f"triangulate: indices must lie in [0, {count}), got {chosen.tolist()}")
    return chosen


def _check_options(matching: str, overlap: int, longest_side: int, seed: int, threads: int) -> None:
    if matching not in MATCHING:
        raise InvalidArgument(f"triangulate: matching must be one of {', '.join(MATCHING)}, got {matching!r}")
    if overlap < 1:
        raise InvalidArgument(f"triangulate: overlap must be >= 1 photo, got {overlap}")
    if longest_side < 64:
        raise InvalidArgument(f"triangulate: longest_side must be >= 64 pixels, got {longest_side}")
    if seed < 0 or threads < 0:
        raise InvalidArgument(f"triangulate: seed and threads must be >= 0, got {seed} and {threads}")


def _extract(
    pycolmap: Any,
    database: Path,
    photos: Path,
    names: Sequence[str],
    groups: Sequence[tuple[str, str, list[int]]],
    longest_side: int,
    threads: int,
    tell: Progress,
) -> None:
    """Features of all photos, with the lenses that :func:`_write_known` gives, numbered from 1."""
    options = pycolmap.FeatureExtractionOptions(use_gpu=False, num_threads=threads or -1, max_image_size=longest_side)
    options.sift.peak_threshold, options.sift.max_num_features = PEAK_THRESHOLD, MOST_FEATURES
    done = 0
    for number, (model, parameters, members) in enumerate(groups, 1):
        for position in members:  # one at a time, so that a bar moves
            tell("features", done, len(names))
            reader = pycolmap.ImageReaderOptions(camera_model=model, camera_params=parameters)
            if position != members[0]:
                reader.existing_camera_id = number
            pycolmap.extract_features(
                database,
                photos,
                image_names=[names[position]],
                camera_mode=pycolmap.CameraMode.SINGLE,
                reader_options=reader,
                extraction_options=options,
                device=pycolmap.Device.cpu,
            )
            done += 1
    tell("features", done, len(names))


def _filter(
    capture: Capture, chosen: NDArray[np.int64], model: Any, folder: Path, most_error: float, least_angle: float
) -> FilteredPoints:
    """Drop wrong points, from the COLMAP model too, which is written to ``folder / "model"``."""
    (folder / "all").mkdir()
    model.write_binary(folder / "all")
    names, cameras = [capture.names[index] for index in chosen], capture.cameras.select(chosen)
    scale = capture.pixel_scale(chosen)
    points = read_points(folder / "all", names, cameras, transform=capture.transform, pixel_scale=scale)
    result = points.filtered(cameras, most_error=most_error, least_angle=least_angle)
    for number in read_tracks(folder / "all" / "points3D.bin").number[~result.kept].tolist():
        model.delete_point3D(number)
    (folder / "model").mkdir()
    model.write_binary(folder / "model")
    return result


def _stored_photos(capture: Capture, chosen: NDArray[np.int64], folder: Path) -> list[str]:
    """Put the photos where COLMAP finds them, under names without spaces that say their order."""
    from PIL import Image

    folder.mkdir()
    names = []
    for position, index in enumerate(chosen.tolist()):
        source, plain = capture.paths[index], index not in capture.upright
        ending = source.suffix.lower()
        if plain and ending in PLAIN:
            names.append(f"{position:06d}{ending}")
            (folder / names[-1]).symlink_to(source.resolve())
            continue
        names.append(f"{position:06d}.png")
        width, height = capture.photo_size(index)
        pixels = read_photo(source, width, height, upright=not plain, background=capture.background)
        Image.fromarray((pixels * 255).round().astype(np.uint8)).save(folder / names[-1])
    return names


def _write_known(
    capture: Capture, chosen: NDArray[np.int64], names: Sequence[str], folder: Path
) -> list[tuple[str, str, list[int]]]:
    """A text model of the known poses; photos of one lens: COLMAP's camera model, its parameters, their positions."""
    folder.mkdir()
    lenses: dict[tuple[Any, ...], list[int]] = {}
    for position, index in enumerate(chosen.tolist()):
        lenses.setdefault(_lens(capture, index), []).append(position)
    camera_of = {position: number for number, members in enumerate(lenses.values(), 1) for position in members}
    cameras, images = [], []
    for number, (model, width, height, *parameters) in enumerate(lenses, 1):
        cameras.append(f"{number} {model} {width} {height} {' '.join(map(repr, parameters))}\n")
    order = [position for members in lenses.values() for position in members]  # as the database numbers them
    for number, position in enumerate(order, 1):
        pose = capture.cameras.camera_to_world[chosen[position]]
        rotation = TO_COLMAP @ pose[:, :3].T  # world to camera
        origin = (pose[:, 3] - capture.transform[:3, 3]) / capture.transform[0, 0]
        values = [*_quaternion(rotation), *(-rotation @ origin)]
        images.append(
            f"{number} {' '.join(repr(float(v)) for v in values)} {camera_of[position]} {names[position]}\n\n"
        )
    (folder / "cameras.txt").write_text("".join(cameras), encoding="utf-8")
    (folder / "images.txt").write_text("".join(images), encoding="utf-8")
    (folder / "points3D.txt").write_text("", encoding="utf-8")
    return [(lens[0], ",".join(map(repr, lens[3:])), members) for lens, members in lenses.items()]


def _lens(capture: Capture, index: int) -> tuple[Any, ...]:
    """COLMAP's camera model, width, height and parameters of a photo at its own size."""
    width, height = capture.photo_size(index)
    seen = capture.cameras.size(index)
    scale = np.array([width / seen[0], height / seen[1]] * 2)
    fx, fy, cx, cy = (capture.cameras.intrinsics[index] * scale).tolist()
    k1, k2, k3, k4, p1, p2 = capture.cameras.distortion[index].tolist()
    if capture.cameras.fisheye[index]:
        return ("OPENCV_FISHEYE", width, height, fx, fy, cx, cy, k1, k2, k3, k4)
    if k4:
        raise InvalidArgument(
            f"triangulate: COLMAP has no lens with k4 = {k4} in the numerator (photo {capture.names[index]}): "
            "undistort the photos first"
        )
    if k3:
        return ("FULL_OPENCV", width, height, fx, fy, cx, cy, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0)
    return ("OPENCV", width, height, fx, fy, cx, cy, k1, k2, p1, p2)


def _quaternion(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """``(w, x, y, z)`` of a rotation matrix, from the eigenvector of its symmetric 4 x 4 form (Bar-Itzhack 2000)."""
    m = rotation
    form = np.array(
        [
            [m[0, 0] + m[1, 1] + m[2, 2], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
            [m[2, 1] - m[1, 2], m[0, 0] - m[1, 1] - m[2, 2], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0]],
            [m[0, 2] - m[2, 0], m[0, 1] + m[1, 0], m[1, 1] - m[0, 0] - m[2, 2], m[1, 2] + m[2, 1]],
            [m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], m[2, 2] - m[0, 0] - m[1, 1]],
        ]
    )
    vector: NDArray[np.float64] = np.linalg.eigh(form)[1][:, -1]
    return vector if vector[0] >= 0 else -vector


def _triangulated(pycolmap: Any, database: Path, folder: Path, names: Sequence[str]) -> Any:
    """The known model with points; its ids are those of the database, which is checked."""
    known = pycolmap.Reconstruction(folder / "known")
    with pycolmap.Database.open(database) as opened:
        stored = {image.name: (image.image_id, image.camera_id) for image in opened.read_all_images()}
    for image in known.images.values():
        if stored.get(image.name) != (image.image_id, image.camera_id):
            raise RuntimeError(f"triangulate: the database numbers {image.name} otherwise: {stored.get(image.name)}")
    (folder / "triangulated").mkdir()
    options = pycolmap.IncrementalPipelineOptions()
    options.triangulation.ignore_two_view_tracks = len(names) > 2  # COLMAP's default; of two photos nothing would stay
    return pycolmap.triangulate_points(known, database, folder / "photos", folder / "triangulated", options=options)
