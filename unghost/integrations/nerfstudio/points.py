"""Sparse points of a COLMAP model in the world that nerfstudio trains in. Imports neither nerfstudio nor torch.

nerfstudio 1.1.5 carries points in its metadata, in the trained world, but not what sight lines need: its COLMAP
dataparser gives COLMAP's image ids without their names, and only if ``max_2D_matches_per_3D_point`` is set; its
default dataparser reads a PLY, which has no tracks. So the model is read from its own files. Photos are matched by
name, and its world is aligned to the training cameras, whatever a dataparser has turned, shifted and scaled.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ...core.cameras import Cameras
from ...core.errors import InvalidFile, MissingFile, UnghostError
from ...core.sparse_points import LEAST_VIEWS, SparsePoints
from ...evaluation.captures.colmap import OWN, find_model, has_model, image_names
from ...evaluation.captures.photos import RESIZED
from ...evaluation.captures.points import has_points, positions_of, read_aligned_points

LEVELS = 3  # folders above those of the photos that may hold a model: images/left/a.jpg lies two below its capture
ENOUGH = 0.5  # of the training photos must be in a model that is preferred for holding no other


@dataclass(frozen=True)
class TrainingPoints:
    """Points that training cameras observed, and where they come from; made by :func:`load_training_points`.

    Attributes:
        points: None if there are none.
        about: one line: what they are and whether evaluation photos had a part in them, or why there are none.
    """

    points: SparsePoints | None
    about: str


@dataclass(frozen=True)
class _Candidate:
    """A model, and how many of its photos are and are not among the training photos."""

    model: Path
    names: tuple[str, ...]
    shared: int
    others: int


def load_training_points(
    photos: Sequence[str | Path], cameras: Cameras, *, model: str | Path | None = None
) -> TrainingPoints:
    """Load the sparse points that the training cameras observed, in the world of those cameras.

    Args:
        photos: file of each training photo (nerfstudio's ``image_filenames``), or of a smaller copy in ``images_4``.
        cameras: of these photos, in their order.
        model: a COLMAP model with points, or a folder that holds one. None: one in ``sparse`` or ``colmap/sparse``
            beside the photos, if there is one. Of several, one of training photos alone, as ``unghost points`` makes
            them (``sparse/unghost-train``), comes before one that holds other photos too.

    Returns:
        Points with at least two observations by training cameras. Without ``model``, a model that cannot be used is
        no error: ``about`` says what is wrong with it.

    Raises:
        FileNotFoundError: ``model`` holds no model with points.
        ValueError: ``model`` is broken, or its photos are not among the training photos, or are posed otherwise.
        ImportError: ``model`` is given and pycolmap is missing.

    Example:
        >>> import numpy as np
        >>> cameras = Cameras.create([np.eye(4)[:3]], [8.0, 8.0, 4.0, 4.0], width=8, height=8)
        >>> load_training_points(["/nowhere/images/a.jpg"], cameras).about.split(":")[0]
        'no COLMAP model with points beside the photos'
    """
    if model is not None:
        return _read(_best([Path(model)], photos, model), cameras)
    try:
        return _read(_best(_places(photos), photos, None), cameras)
    except UnghostError as error:
        return TrainingPoints(None, str(error))


def _best(places: Sequence[Path], photos: Sequence[str | Path], given: str | Path | None) -> _Candidate:
    """The model to use, of those at and below some folders.

    Raises:
        FileNotFoundError: there is none with points.
    """
    models = dict.fromkeys(each for place in places for each in _models_in(place))
    if not models:
        if given is not None:
            raise MissingFile(f"unghost_points: {given} has no COLMAP model with points (cameras, images and points3D)")
        raise MissingFile(
            "no COLMAP model with points beside the photos: unghost points makes one "
            "(the points of a ply_file_path have no tracks, and give no sight lines)"
        )
    names = [_names(photos), _names([os.path.realpath(photo) for photo in photos])]
    candidates = [_candidate(each, names) for each in models]
    least = ENOUGH * len(photos)
    return max(candidates, key=lambda each: (each.others == 0 and each.shared >= least, each.shared))


def _models_in(place: Path) -> list[Path]:
    """Models with points: the folder itself, or else those of ``unghost points`` in it and its own."""
    if has_model(place):
        return [place] if has_points(place) else []
    own = [each for each in sorted(place.glob(f"sparse/{OWN}-*")) if has_model(each)]
    beside = find_model(place)
    return [each for each in (*own, *([] if beside is None else [beside])) if has_points(each)]


def _places(photos: Sequence[str | Path]) -> list[Path]:
    """Folders in which a model may lie: those above the photos, and above the files that links lead to."""
    found = dict[Path, None]()
    for files in ([os.path.abspath(photo) for photo in photos], [os.path.realpath(photo) for photo in photos]):
        if files:
            common = Path(os.path.commonpath([os.path.dirname(file) for file in files]))
            found.update(dict.fromkeys([common, *common.parents][: 1 + LEVELS]))
    return list(found)


def _names(photos: Sequence[str | Path]) -> tuple[str, ...]:
    """Paths of the photos, those in ``images_4`` as if they were in ``images``."""
    return tuple(
        "/".join("images" if re.fullmatch(RESIZED, part) else part for part in Path(photo).as_posix().split("/"))
        for photo in photos
    )


def _candidate(model: Path, names: Sequence[tuple[str, ...]]) -> _Candidate:
    known = image_names(model)
    chosen = max(names, key=lambda each: len(positions_of(known, each)))
    shared = len(positions_of(known, chosen))
    return _Candidate(model, chosen, shared, len(known) - shared)


def _read(found: _Candidate, cameras: Cameras) -> TrainingPoints:
    points = read_aligned_points(found.model, found.names, cameras, caller="unghost_points")
    points = points.select(points.views() >= LEAST_VIEWS)
    if not len(points):
        raise InvalidFile(f"unghost_points: no point of {found.model} was observed by two training cameras")
    about = f"{points.about}, of {found.model}"
    if found.others:
        about += (
            f"; {found.others} of its photos are not trained on and had a part in them: scores on such photos are not "
            "leak-free, unless unghost points makes the points of the training photos alone"
        )
    return TrainingPoints(points, about)
