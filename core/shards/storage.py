"""Shards of cube pairs: 8-bit inputs, 2-bit labels, memory-mapped. ``docs/formats.md`` is normative.

A shard is a folder of ``.npy`` arrays and ``manifest.json``; the manifest is written last, so a
folder without one is unfinished and is refused.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from ..errors import InvalidArgument, InvalidFile
from ..frames import RESOLUTION
from ..io import new_folder, read_json
from .packing import FRAME_NUMBERS, VOXELS

FORMAT = "unghost-shard"
FORMAT_VERSION = 1
SURROUNDINGS_RESOLUTION = 16
SURROUNDINGS_EDGE = 3.0  # edges of the cube
MAX_VIEW_COUNT = 255
TRANSMITTANCE_RESOLUTION = 16
NO_SOURCE = -1
ShardKind = Literal["pairs", "harvest"]  # made by corruption (or of true scenes), or cut out of fitted fields
SHARD_KINDS: tuple[ShardKind, ...] = get_args(ShardKind)
Layout = dict[str, tuple[tuple[int, ...], str]]
ARRAYS: Layout = {
    "inputs": ((RESOLUTION,) * 3, "uint8"),
    "labels": ((VOXELS // 4,), "uint8"),
    "severity": ((), "float32"),
    "edge_fraction": ((), "float32"),
    "group": ((), "int32"),
}
OPTIONAL_ARRAYS: Layout = {
    "surroundings": ((SURROUNDINGS_RESOLUTION,) * 3, "uint8"),
    "view_count": ((RESOLUTION,) * 3, "uint8"),
    "transmittance": ((TRANSMITTANCE_RESOLUTION,) * 3, "uint8"),
    "support": ((RESOLUTION,) * 3, "uint8"),
    "crossings": ((RESOLUTION,) * 3, "uint8"),
    "frames": ((FRAME_NUMBERS,), "float64"),
    "source": ((), "int32"),
}


def _sha256(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as stream:
        while block := stream.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def _save(path: Path, array: NDArray[Any]) -> None:
    """As ``np.save``, whose error on a full disk does not say that the disk is full."""
    with path.open("wb") as stream:
        np.lib.format.write_array_header_1_0(stream, np.lib.format.header_data_from_array_1_0(array))
        stream.write(array.reshape(-1).view(np.uint8).data)


def stays_within(path: str) -> bool:
    """Whether a path of a source is relative and stays in its folder, on every system (so no ``\\`` and no ``:``)."""
    parts = PurePosixPath(path)
    return not ("\\" in path or ":" in path or parts.is_absolute() or ".." in parts.parts)


def _check_frames(frames: NDArray[np.float64], where: str) -> None:
    known = frames[~np.isnan(frames).all(axis=1)]
    rotations = known[:, 4:].reshape(-1, 3, 3)
    good = np.isfinite(known).all(axis=1) & (known[:, 3] > 0)
    with np.errstate(invalid="ignore", over="ignore"):
        products = rotations @ rotations.transpose(0, 2, 1)
    good &= np.isclose(products, np.eye(3), rtol=0, atol=1e-6).all(axis=(1, 2))
    if not good.all():
        raise InvalidArgument(
            f"{where}: each row of frames must be NaN throughout or a finite center, an edge_length > 0 and an "
            f"orthonormal rotation, got {known[int(np.argmin(good))].tolist()}"
        )


def _check_sources(source: NDArray[np.int32], provenance: Mapping[str, Any], where: str) -> None:
    sources = provenance.get("sources")
    if not isinstance(sources, list) or not all(isinstance(entry, dict) for entry in sources):
        raise InvalidArgument(
            f"{where}: with source, provenance must hold sources, a list of objects, got {sources!r:.80}"
        )
    if len(source) and not (source.min() >= NO_SOURCE and source.max() < len(sources)):
        raise InvalidArgument(
            f"{where}: source must lie in [{NO_SOURCE}, {len(sources)}), got {source.min()} to {source.max()}"
        )
    for entry in sources:
        if not stays_within(str(entry.get("path", ""))):
            raise InvalidArgument(
                f"{where}: the path of a source must be relative and stay in its folder, got {entry['path']!r}"
            )


def _check_values(arrays: Mapping[str, NDArray[Any]], provenance: Mapping[str, Any], where: str) -> None:
    """The rules that values must obey, for those of the arrays that are given."""
    if "labels" in arrays and (arrays["labels"] & arrays["labels"] >> 1 & 0x55).any():
        raise InvalidArgument(f"{where}: labels must be 0, 1 or 2, got 3")
    severity, fraction = arrays.get("severity", np.ones(1)), arrays.get("edge_fraction", np.ones(1))
    for name, values, good, rule in (
        ("severity", severity, (severity >= 0) & (severity <= 1), "lie in [0, 1]"),
        ("edge_fraction", fraction, (fraction > 0) & (fraction < np.inf), "be finite and > 0"),
    ):
        if not good.all():
            raise InvalidArgument(f"{where}: {name} must {rule}, got {values[~good][0]}")
    if "frames" in arrays:
        _check_frames(arrays["frames"], where)
    if "source" in arrays:
        _check_sources(arrays["source"], provenance, where)


def _check_kind(kind: object, where: str) -> ShardKind:
    if kind not in SHARD_KINDS:
        raise InvalidArgument(f"{where}: kind must be one of {', '.join(SHARD_KINDS)}, got {kind!r:.80}")
    return kind


def write_shard(
    folder: str | Path,
    arrays: Mapping[str, NDArray[Any]],
    provenance: Mapping[str, Any],
    *,
    kind: ShardKind = "pairs",
) -> None:
    """Write a whole shard or nothing.

    Args:
        folder: must not exist.
        arrays: ``inputs (N, 32, 32, 32) uint8`` (quantised signed opacity), ``labels (N, 8192) uint8``
            (packed), ``severity (N,)`` and ``edge_fraction (N,)`` float32, ``group (N,) int32``
            (the scene or mesh a cube came from; nothing of a group may straddle a split).
            Optional: ``surroundings (N, 16, 16, 16) uint8`` (quantised signed opacity, same centre and rotation,
            three times the edge), ``view_count (N, 32, 32, 32) uint8`` (training views that saw a voxel, capped
            at 255), ``transmittance (N, 16, 16, 16) uint8`` (255 times the share of light that the best training
            camera gets, see :mod:`unghost.core.visibility.transmittance`), ``support`` and ``crossings
            (N, 32, 32, 32) uint8`` (255 times :func:`unghost.core.channels.evidence_share`), ``frames (N, 13) float64``
            (:func:`pack_frame`), ``source (N,) int32`` (a row of ``provenance["sources"]``, -1 for none).
        provenance: JSON-able; kept in the manifest.
        kind: ``harvest`` for cubes of fitted fields, ``pairs`` for all others; training treats them differently.

    Raises:
        FileExistsError: the folder is there.
        ValueError: an array is missing, unknown or of the wrong dtype or shape; a frame or source breaks its rule; an
            unknown kind.
        OSError: it cannot be written (a full disk, no permission); nothing is left behind.
    """
    target = Path(folder)
    _check_kind(kind, "write_shard")
    if target.exists():
        raise FileExistsError(f"write_shard: {target} exists already")
    missing, unknown = sorted(set(ARRAYS) - set(arrays)), sorted(set(arrays) - set(ARRAYS) - set(OPTIONAL_ARRAYS))
    if missing or unknown:
        raise InvalidArgument(
            f"write_shard: arrays must hold {', '.join(ARRAYS)}; missing {missing}, unknown {unknown}"
        )
    count = len(arrays["inputs"])
    layout = {name: rule for name, rule in (ARRAYS | OPTIONAL_ARRAYS).items() if name in arrays}
    for name, (shape, dtype) in layout.items():
        array = arrays[name]
        if array.shape != (count, *shape) or array.dtype != np.dtype(dtype):
            raise InvalidArgument(
                f"write_shard: {name} must be {dtype} {(count, *shape)}, got {array.dtype} {array.shape}"
            )
    _check_values(arrays, provenance, "write_shard")
    try:
        with new_folder(target, unique=False) as partial:
            for name in layout:
                _save(partial / f"{name}.npy", np.ascontiguousarray(arrays[name]))
            manifest = {
                "format": FORMAT,
                "format_version": FORMAT_VERSION,
                "count": count,
                "kind": kind,
                "sha256": {name: _sha256(partial / f"{name}.npy") for name in layout},
                "provenance": dict(provenance),
            }
            (partial / "manifest.json").write_text(json.dumps(manifest, indent=1), encoding="utf-8")
    except OSError as error:
        raise OSError(
            error.errno, f"write_shard: cannot write {target} ({error.strerror or error}); nothing of it is left"
        ) from error


@dataclass(frozen=True)
class Shard:
    """Memory-mapped arrays of one shard; see :func:`write_shard` for shapes. Optional arrays are None when absent.

    Attributes:
        kind: ``harvest`` for cubes of fitted fields, ``pairs`` for all others.
    """

    inputs: NDArray[np.uint8]
    labels: NDArray[np.uint8]
    severity: NDArray[np.float32]
    edge_fraction: NDArray[np.float32]
    group: NDArray[np.int32]
    provenance: dict[str, Any]
    surroundings: NDArray[np.uint8] | None = None
    view_count: NDArray[np.uint8] | None = None
    transmittance: NDArray[np.uint8] | None = None
    support: NDArray[np.uint8] | None = None
    crossings: NDArray[np.uint8] | None = None
    frames: NDArray[np.float64] | None = None
    source: NDArray[np.int32] | None = None
    kind: ShardKind = "pairs"

    def __len__(self) -> int:
        return len(self.inputs)


def _read_manifest(source: Path) -> dict[str, Any]:
    """The manifest, its own entries checked."""
    try:
        manifest = read_json(source / "manifest.json", caller="read_shard")
    except FileNotFoundError:
        raise InvalidFile(f"read_shard: {source} has no manifest.json: not a shard, or unfinished") from None
    found = manifest if isinstance(manifest, dict) else {}
    if found.get("format") != FORMAT or found.get("format_version") != FORMAT_VERSION:
        raise InvalidFile(f"read_shard: {source} is not an {FORMAT} of version {FORMAT_VERSION}")
    for key, kind in (("count", int), ("sha256", dict), ("provenance", dict)):
        if not isinstance(found.get(key), kind) or isinstance(found[key], bool):
            raise InvalidFile(f"read_shard: {source}/manifest.json must hold {key}, got {found.get(key)!r:.80}")
    missing = sorted(set(ARRAYS) - set(found["sha256"]))
    unknown = sorted(set(found["sha256"]) - set(ARRAYS) - set(OPTIONAL_ARRAYS))
    unlisted = [name for name in OPTIONAL_ARRAYS if name not in found["sha256"] and (source / f"{name}.npy").exists()]
    if missing or unknown or unlisted:
        raise InvalidFile(
            f"read_shard: the arrays of {source} and the sha256 of its manifest disagree: "
            f"not named {missing + unlisted}, unknown {unknown}"
        )
    if "kind" not in found:  # written before 0.2, when the recipe in the provenance told harvests apart
        found["kind"] = "harvest" if found["provenance"].get("recipe") == "harvest" else "pairs"
    _check_kind(found["kind"], f"read_shard: {source}/manifest.json")
    return found


def _open_array(path: Path, shape: tuple[int, ...], dtype: str) -> NDArray[Any]:
    """One array, memory-mapped, exactly as long as its header says."""
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise InvalidFile(f"read_shard: cannot read {path} as one array of numbers ({type(error).__name__})") from None
    if not isinstance(array, np.memmap) or not array.flags.c_contiguous:
        raise InvalidFile(f"read_shard: cannot read {path} (it is not one array in C order)")
    if array.shape != shape or array.dtype != np.dtype(dtype):
        raise InvalidFile(f"read_shard: {path} holds {array.dtype} {array.shape}, the manifest says {dtype} {shape}")
    excess = path.stat().st_size - array.offset - array.nbytes
    if excess:
        raise InvalidFile(f"read_shard: {path} is {excess} bytes longer than its array")
    return array


def read_shard(folder: str | Path, *, verify: bool = False) -> Shard:
    """Open a shard; ``verify`` also checks every hash and every frame.

    Raises:
        ValueError: no manifest, another format, or arrays that disagree with the manifest.
    """
    source = Path(folder)
    manifest = _read_manifest(source)
    loaded: dict[str, NDArray[Any]] = {}
    for name, (shape, dtype) in (ARRAYS | OPTIONAL_ARRAYS).items():
        if name not in manifest["sha256"]:
            continue
        path = source / f"{name}.npy"
        loaded[name] = _open_array(path, (manifest["count"], *shape), dtype)
        if verify and _sha256(path) != manifest["sha256"][name]:
            raise InvalidFile(f"read_shard: {path} does not match the hash in its manifest")
    checked = {name: array for name, array in loaded.items() if verify or name == "source"}
    _check_values(checked, manifest["provenance"], f"read_shard: {source}")
    return Shard(**loaded, provenance=manifest["provenance"], kind=manifest["kind"])
