"""Ground truth of evaluation views from disk: photos, masks, cameras and the scene's lengths."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...core.cameras import Cameras
from ...core.errors import InvalidArgument, InvalidFile
from ..captures.colmap import find_model
from ..captures.loading import load_capture
from ..captures.splits import EVAL_NAMES, TRAIN_NAMES, choose_split
from ..captures.transforms import has_split_files
from .conventions import SceneExtent
from .pseudo_truth import PseudoTruth, check_cameras, load_pseudo_truth
from .renders import match_names, read_masks, read_sized_photos
from .views import Truth, pad_views


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """What renders are scored against.

    Attributes:
        name: of the folder, for the page.
        truth: photos, masks, depth and cameras, as far as they are known.
        extent: lengths of the scene; None where the cameras of both sweeps are not known.
        facts: where the masks come from, for the results file.
        notes: sentences for the user.
    """

    name: str
    truth: Truth
    extent: SceneExtent | None = None
    facts: Mapping[str, str | int | bool | None] = field(default_factory=lambda: {"masks": None})
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class _Photos:
    """Photos of some views, and the cameras of both sweeps where a capture tells them."""

    names: tuple[str, ...]
    photos: NDArray[np.float32]
    sizes: NDArray[np.int64]
    cameras: Cameras | None = None
    train_cameras: Cameras | None = None

    @property
    def shapes(self) -> list[tuple[int, int]]:
        """Height and width of each."""
        return [(height, width) for width, height in self.sizes.tolist()]


def read_ground_truth(
    folder: Path,
    *,
    masks: Path | None = None,
    downscale: float = 1.0,
    eval_split: str | None = None,
    train_split: str | None = None,
    normalize: bool = True,
    occlusion: bool | None = None,
    min_views: int = 1,
) -> GroundTruth:
    """Read a folder of photos or a capture, and masks.

    Args:
        folder: photos, or a capture (``transforms.json`` or a COLMAP model).
        masks: ``masks.npz`` of ``unghost masks``, a folder of mask pictures, or None.
        downscale, eval_split, train_split, normalize, occlusion, min_views: as
            :func:`unghost.evaluation.evaluate` takes them.

    Raises:
        FileNotFoundError: no such folder or file.
        ValueError: photos, masks and cameras that do not belong together; an option without the file that it is for.
    """
    stored = None if masks is None or masks.is_dir() else load_pseudo_truth(masks)
    views = None if stored is None else stored.names
    described = (folder / "transforms.json").is_file() or has_split_files(folder)
    if eval_split is not None or described or find_model(folder) is not None:
        found = _read_capture(folder, views, downscale, eval_split, train_split, normalize)
    else:
        found = _Photos(*read_sized_photos(folder, views, downscale=downscale))
    name = folder.resolve().name
    if stored is not None and masks is not None:
        return _with_stored_masks(name, found, stored, masks, downscale, occlusion, min_views)
    for option, given in (("occlusion", occlusion is not None), ("min_views", min_views != 1)):
        if given:
            held = "no masks" if masks is None else f"the pictures in {masks}"
            raise InvalidFile(f"evaluate: {option} needs masks.npz (of unghost masks) as masks, got {held}")
    visible = None if masks is None else read_masks(masks, found.names, found.shapes)
    extent, notes = _extent(found)
    truth = Truth(found.photos, visible, cameras=found.cameras, names=found.names, sizes=found.sizes)
    return GroundTruth(name, truth, extent, {"masks": None if masks is None else masks.name}, notes)


def _with_stored_masks(
    name: str,
    found: _Photos,
    stored: PseudoTruth,
    masks: Path,
    downscale: float,
    occlusion: bool | None,
    min_views: int,
) -> GroundTruth:
    sizes = stored.eval_cameras.sizes
    differ = (found.sizes != sizes).any(axis=1)
    if differ.any():
        (width, height), (wide, high) = found.sizes[differ][0].tolist(), sizes[differ][0].tolist()
        raise InvalidArgument(
            f"evaluate: the photos are {width} x {height}, {masks} is of {wide} x {high}; see downscale "
            f"(now {downscale:g})"
        )
    check_cameras(masks, stored, eval_cameras=found.cameras, train_cameras=found.train_cameras)
    aware = stored.seen_open is not None if occlusion is None else occlusion
    truth = stored.truth(found.photos, occlusion=aware, minimum_views=min_views)
    facts: dict[str, str | int | bool | None] = {"masks": masks.name, "occlusion": aware, "min_views": min_views}
    return GroundTruth(name, truth, stored.extent, facts)


def _extent(found: _Photos) -> tuple[SceneExtent | None, tuple[str, ...]]:
    """Lengths of the scene, or None and why they are not known."""
    if found.cameras is None:
        return None, ()
    if found.train_cameras is None:
        return None, ("No depth limit is known: the capture has no sweep called train (see train_split).",)
    try:
        return SceneExtent.of(found.train_cameras, found.cameras), ()
    except ValueError as error:
        return None, (f"No depth limit is known ({error}).",)


def _read_capture(
    folder: Path,
    views: Sequence[str] | None,
    downscale: float,
    eval_split: str | None,
    train_split: str | None,
    normalize: bool,
) -> _Photos:
    capture = load_capture(folder, downscale=downscale, normalize=normalize)
    split = choose_split(capture.splits, eval_split, EVAL_NAMES, "evaluate: eval_split", whole=True)
    indices = capture.split(split)
    names = tuple(capture.names[index] for index in indices)
    if views is not None:
        position = dict(zip(names, indices))
        names = match_names(f"photos of split {split!r}", names, views, where=str(folder), whole=False)
        indices = np.array([position[name] for name in names])
    train_cameras = None
    if train_split is not None or any(name in capture.splits for name in TRAIN_NAMES):
        named = choose_split(capture.splits, train_split, TRAIN_NAMES, "evaluate: train_split")
        train_cameras = capture.cameras.select(capture.split(named))
    cameras = capture.cameras.select(indices)
    if cameras.same_size:
        photos = capture.images(indices)
    else:
        photos = pad_views([capture.images([index])[0] for index in indices], cameras.canvas, 0.0)
    return _Photos(names, photos, cameras.sizes, cameras, train_cameras)
