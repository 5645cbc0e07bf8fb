"""Pseudo ground truth of the evaluation views: depth, normals and visibility, made once, stored, and reused.

The depth comes from the caller: rendered by a field trained on both trajectories, or exact for a synthetic scene.
"""

from __future__ import annotations

import hashlib
import json
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.cameras import Cameras
from ...core.errors import InvalidArgument, InvalidFile
from ...core.io import write_npz
from ..metrics.checks import Mask
from ..metrics.geometry import normals_from_depth
from .conventions import SceneExtent
from .protocol import view_counts
from .views import Truth, check_depth, check_normals, pad_views

FORMAT = "unghost-pseudo-gt"
FORMAT_VERSION = 1
LENS_VERSION = 2  # of a file with fisheyes, or with cameras that differ in size: an older reader must not take it
MAPS = {"depth": "<f4", "normals": "<f4", "seen_frustum": "<u2", "seen_open": "<u2"}
LENSES = {"camera_to_world": (3, 4), "intrinsics": (4,), "distortion": (6,)}
SAME_CAMERA = 1e-6  # relative: cameras that went through a text file are still the same


@dataclass(frozen=True, eq=False)
class PseudoTruth:
    """Maps of ``n`` evaluation views of one scene.

    Attributes:
        eval_cameras, train_cameras: of the two trajectories; ``n`` and ``m`` of them.
        depth: ``(n, H, W)`` float32 along the unit ray, scene units, > 0, inf for no surface.
        normals: ``(n, H, W, 3)`` float32 unit, world axes, NaN where there is none.
        seen_frustum: ``(n, H, W)`` uint16, training cameras whose frustum holds the point: the paper's count.
        seen_open: the same, of those from which nothing hides it; None if no training depth was given.
        tolerance: relative depth tolerance of ``seen_open``; None without it.
        names: of the views.
        details: JSON-able provenance: which field or scene, its settings, its commit.
    """

    eval_cameras: Cameras
    train_cameras: Cameras
    depth: NDArray[np.float32]
    normals: NDArray[np.float32]
    seen_frustum: NDArray[np.uint16]
    seen_open: NDArray[np.uint16] | None
    tolerance: float | None
    names: tuple[str, ...]
    details: Mapping[str, Any] = field(default_factory=dict)

    @property
    def extent(self) -> SceneExtent:
        """The scene's lengths; ``extent.limit`` is twice the largest distance between two cameras."""
        return SceneExtent.of(self.train_cameras, self.eval_cameras)

    def visible(self, *, occlusion: bool, minimum_views: int = 1) -> Mask:
        """``(n, H, W)`` bool: pixels that at least ``minimum_views`` training cameras see.

        Args:
            occlusion: count only cameras from which nothing hides the point. False is the paper's test.
            minimum_views: >= 1.

        Raises:
            ValueError: ``minimum_views < 1``, or occlusion asked of maps that were made without training depth.
        """
        if minimum_views < 1:
            raise InvalidArgument(f"PseudoTruth.visible: minimum_views must be >= 1, got {minimum_views}")
        if occlusion and self.seen_open is None:
            raise InvalidArgument("PseudoTruth.visible: occlusion needs maps made with train_depth; these were not")
        counts = self.seen_open if occlusion and self.seen_open is not None else self.seen_frustum
        return np.asarray(counts >= minimum_views, dtype=np.bool_)

    def truth(self, photos: NDArray[Any], *, occlusion: bool, minimum_views: int = 1) -> Truth:
        """What renders are scored against: the photos ``(n, H, W, 3)`` and these maps."""
        visible = self.visible(occlusion=occlusion, minimum_views=minimum_views)
        return Truth(photos, visible, self.depth, self.normals, self.eval_cameras, self.names)

    def save(self, path: str | Path) -> None:
        """Write ``.npz`` without pickles, whole or not at all (``docs/formats.md``)."""
        arrays = {name: getattr(self, name) for name in MAPS if getattr(self, name) is not None}
        for side, cameras in (("eval", self.eval_cameras), ("train", self.train_cameras)):
            arrays |= {f"{side}_{name}": getattr(cameras, name) for name in LENSES}
        arrays = {name: np.ascontiguousarray(values, dtype=_dtype(name)) for name, values in arrays.items()}
        rigs = {"eval": self.eval_cameras, "train": self.train_cameras}
        plain = all(cameras.same_size and not cameras.fisheye.any() for cameras in rigs.values())
        fisheyes = {f"{side}_fisheye": cameras.fisheye.tolist() for side, cameras in rigs.items()}
        manifest = {
            "format": FORMAT,
            "format_version": FORMAT_VERSION if plain else LENS_VERSION,
            "names": list(self.names),
            **{f"{side}_size": _stored_size(cameras) for side, cameras in rigs.items()},
            **({} if plain else fisheyes),
            "depth_limit": self.extent.limit,
            "tolerance": self.tolerance,
            "sha256": {name: _digest(values) for name, values in arrays.items()},
            "details": dict(self.details),
        }
        text = np.frombuffer(json.dumps(manifest, allow_nan=False).encode(), dtype=np.uint8)
        write_npz(path, parents=False, manifest=text, **arrays)


def make_pseudo_truth(
    eval_cameras: Cameras,
    train_cameras: Cameras,
    depth: NDArray[Any],
    *,
    normals: NDArray[Any] | None = None,
    train_depth: NDArray[Any] | None = None,
    tolerance: float = 0.05,
    names: Sequence[str] = (),
    details: Mapping[str, Any] | None = None,
) -> PseudoTruth:
    """Normals and visibility of the evaluation views from their depth.

    Args:
        eval_cameras: ``n`` cameras; ``train_cameras``: ``m``. Together at least two distinct origins.
        train_cameras: see above.
        depth: ``(n, H, W)`` along the unit ray, scene units, > 0, inf for no surface. Of views that differ in size,
            each in the upper left corner (:attr:`~unghost.core.cameras.Cameras.canvas`) and inf beside it.
        normals: ``(n, H, W, 3)`` unit, world axes, NaN for none; None: from the depth.
        train_depth: ``(m, h, w)`` of the training views, for occlusion-aware visibility.
        tolerance: relative depth tolerance of that.
        names: of the views; ``0``, ``1``, … unless given.
        details: JSON-able provenance, stored.

    Raises:
        ValueError: shapes, depth that is NaN or not > 0 (counted), normals that are not unit vectors, names that are
            not ``n`` different ones, details that are not JSON.
    """
    frustum = view_counts(eval_cameras, depth, train_cameras)
    hidden = None
    if train_depth is not None:
        hidden = view_counts(eval_cameras, depth, train_cameras, train_depth=train_depth, tolerance=tolerance)
    single = np.asarray(depth, dtype=np.float32)
    if normals is None:
        exact = np.asarray(depth, dtype=np.float64)
        windows = [(index, eval_cameras.window(index)) for index in range(len(eval_cameras))]
        views = [normals_from_depth(exact[index][window], eval_cameras, index) for index, window in windows]
        normals = pad_views(views, eval_cameras.canvas, np.nan)
    labels = tuple(names) or tuple(str(index) for index in range(len(eval_cameras)))
    try:
        json.dumps(dict(details or {}), allow_nan=False)
    except (TypeError, ValueError) as error:
        raise InvalidArgument(f"make_pseudo_truth: details must be JSON without NaN ({error})") from None
    result = PseudoTruth(
        eval_cameras,
        train_cameras,
        single,
        np.asarray(normals, dtype=np.float32),
        _counts(frustum),
        None if hidden is None else _counts(hidden),
        None if hidden is None else float(tolerance),
        labels,
        dict(details or {}),
    )
    _check("make_pseudo_truth", result)
    return result


def load_pseudo_truth(
    path: str | Path, *, eval_cameras: Cameras | None = None, train_cameras: Cameras | None = None
) -> PseudoTruth:
    """Read what :meth:`PseudoTruth.save` wrote.

    Args:
        path: of the file.
        eval_cameras, train_cameras: if given, the file must be of these cameras: size, kind of lens, poses, intrinsics
            and distortion equal to a millionth.

    Raises:
        FileNotFoundError: no such file.
        ValueError: a foreign, truncated, altered or inconsistent file, or one of other cameras; the message names it.
    """
    source = Path(path)
    manifest, arrays = _read(source)
    try:
        lenses = {side: _cameras(side, manifest, arrays) for side in ("eval", "train")}
        result = PseudoTruth(
            lenses["eval"],
            lenses["train"],
            arrays["depth"],
            arrays["normals"],
            arrays["seen_frustum"],
            arrays.get("seen_open"),
            manifest["tolerance"],
            tuple(manifest["names"]),
            dict(manifest["details"]),
        )
        _check("load_pseudo_truth", result)
        stated = float(manifest["depth_limit"])
    except (KeyError, TypeError, ValueError) as error:
        raise InvalidFile(f"load_pseudo_truth: {source} is inconsistent: {error}") from None
    if not np.isclose(stated, result.extent.limit, rtol=1e-9):
        raise InvalidFile(
            f"load_pseudo_truth: {source} is inconsistent: depth_limit {stated} for cameras of {result.extent.limit}"
        )
    check_cameras(source, result, eval_cameras=eval_cameras, train_cameras=train_cameras)
    return result


def check_cameras(
    source: Path, stored: PseudoTruth, *, eval_cameras: Cameras | None = None, train_cameras: Cameras | None = None
) -> None:
    """Refuse maps that are of other cameras than those given: size, poses, intrinsics, distortion to a millionth."""
    pairs = (("eval", stored.eval_cameras, eval_cameras), ("train", stored.train_cameras, train_cameras))
    for side, there, wanted in pairs:
        if wanted is not None:
            _check_cameras(source, side, there, wanted)


def _read(source: Path) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    caller = "load_pseudo_truth"
    try:
        with source.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
            manifest = json.loads(arrays.pop("manifest").tobytes().decode())
    except FileNotFoundError:
        raise
    except (
        OSError,
        ValueError,
        KeyError,
        EOFError,
        TypeError,
        AttributeError,
        zipfile.BadZipFile,
        zlib.error,
    ) as error:
        fault = type(error).__name__  # not numpy's text, which may advise to unpickle
        raise InvalidFile(f"{caller}: {source} is not pseudo ground truth, or is truncated ({fault})") from None
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise InvalidFile(f"{caller}: {source} is not pseudo ground truth (format must be {FORMAT!r})")
    if manifest.get("format_version") not in (FORMAT_VERSION, LENS_VERSION):
        raise InvalidFile(
            f"{caller}: {source} has version {manifest.get('format_version')!r}, this release reads {FORMAT_VERSION} "
            f"and {LENS_VERSION}"
        )
    hashes = manifest.get("sha256")
    if not isinstance(hashes, dict) or set(hashes) != set(arrays):
        raise InvalidFile(f"{caller}: {source}: sha256 must name exactly the arrays {sorted(arrays)}")
    for name, values in arrays.items():
        if values.dtype != _dtype(name) or _digest(values) != hashes[name]:
            raise InvalidFile(f"{caller}: {source} was altered: {name} does not match its hash or is no {_dtype(name)}")
    return manifest, arrays


def _cameras(side: str, manifest: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> Cameras:
    poses, intrinsics, distortion = (arrays[f"{side}_{name}"] for name in LENSES)
    size = np.array(manifest[f"{side}_size"], dtype=np.int64)
    fisheye = np.array(manifest.get(f"{side}_fisheye", False), dtype=bool)
    return Cameras.create(poses, intrinsics, size[..., 0], size[..., 1], distortion, fisheye)


def _stored_size(cameras: Cameras) -> list[Any]:
    """Width and height, or those of each camera where they differ."""
    sizes: list[Any] = [cameras.width, cameras.height] if cameras.same_size else cameras.sizes.tolist()
    return sizes


def _check(caller: str, maps: PseudoTruth) -> None:
    shape = (len(maps.eval_cameras), *maps.eval_cameras.canvas)
    wanted = {"depth": shape, "normals": (*shape, 3), "seen_frustum": shape, "seen_open": shape}
    for name, each in wanted.items():
        values = getattr(maps, name)
        if values is not None and values.shape != each:
            raise InvalidArgument(f"{caller}: {name} must have shape {each}, got {values.shape}")
    check_depth(caller, "depth", maps.depth)
    check_normals(caller, "normals", maps.normals)
    if len(maps.names) != shape[0] or len(set(maps.names)) != shape[0]:
        raise InvalidArgument(f"{caller}: names must be {shape[0]} different ones, got {list(maps.names)}")
    if (maps.tolerance is None) != (maps.seen_open is None):
        raise InvalidArgument(f"{caller}: tolerance must be there if and only if seen_open is, got {maps.tolerance}")


def _check_cameras(source: Path, side: str, stored: Cameras, wanted: Cameras) -> None:
    here, there = ((len(each), *each.canvas[::-1]) for each in (wanted, stored))
    if here != there:
        raise InvalidFile(
            f"load_pseudo_truth: {source} is of {there[0]} {side} cameras of {there[1]} x {there[2]}, not of {here[0]} "
            f"of {here[1]} x {here[2]}"
        )
    for name, differ in (
        ("size", (stored.sizes != wanted.sizes).any(axis=1)),
        ("lens (fisheye or not)", stored.fisheye != wanted.fisheye),
    ):
        if differ.any():
            raise InvalidFile(
                f"load_pseudo_truth: {source} is of other {side} cameras: camera {int(differ.argmax())} has another "
                f"{name}"
            )
    for name in LENSES:
        first, second = getattr(stored, name), getattr(wanted, name)
        size = max(float(np.abs(second).max(initial=0.0)), 1.0)
        apart = np.abs(first - second).reshape(len(first), -1).max(axis=1, initial=0.0) / size
        if (apart > SAME_CAMERA).any():
            worst = int(apart.argmax())
            raise InvalidFile(
                f"load_pseudo_truth: {source} is of other {side} cameras: {name} of camera {worst} is off by "
                f"{apart[worst] * size:.3g}"
            )


def _dtype(name: str) -> np.dtype[Any]:
    return np.dtype(MAPS.get(name, "<f8"))


def _counts(counts: NDArray[np.int64]) -> NDArray[np.uint16]:
    return np.minimum(counts, np.iinfo(np.uint16).max).astype(np.uint16)


def _digest(values: NDArray[Any]) -> str:
    """SHA-256 of the shape (as text, ``2x3``) and of the little-endian bytes in C order."""
    head = "x".join(map(str, values.shape)).encode()
    return hashlib.sha256(head + b":" + np.ascontiguousarray(values, dtype=_dtype_of(values)).tobytes()).hexdigest()


def _dtype_of(values: NDArray[Any]) -> np.dtype[Any]:
    return values.dtype.newbyteorder("<")
