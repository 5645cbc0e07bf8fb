"""Shards of cube pairs: 8-bit inputs, 2-bit labels, memory-mapped. ``docs/formats.md`` is normative.

A shard is a folder of ``.npy`` arrays and ``manifest.json``; the manifest is written last, so a
folder without one is unfinished and is refused.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .frames import RESOLUTION
from .occupancy import IGNORE_LABEL

FORMAT = "unghost-shard"
FORMAT_VERSION = 1
VOXELS = RESOLUTION**3
ARRAYS: dict[str, tuple[tuple[int, ...], str]] = {
    "inputs": ((RESOLUTION,) * 3, "uint8"),
    "labels": ((VOXELS // 4,), "uint8"),
    "severity": ((), "float32"),
    "edge_fraction": ((), "float32"),
    "group": ((), "int32"),
}


def pack_labels(labels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """``(N, R, R, R)`` labels 0, 1, 2 to ``(N, R^3 / 4)`` bytes; the first voxel is in the lowest two bits."""
    if labels.size and labels.max() > IGNORE_LABEL:
        raise ValueError(f"pack_labels: labels must be 0, 1 or 2, got {labels.max()}")
    quads = labels.reshape(len(labels), -1, 4).astype(np.uint8)
    return (quads * np.array([1, 4, 16, 64], dtype=np.uint8)).sum(axis=-1, dtype=np.uint8)


def unpack_labels(packed: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Inverse of :func:`pack_labels`."""
    quads = np.stack([packed & 3, packed >> 2 & 3, packed >> 4 & 3, packed >> 6], axis=-1)
    return quads.reshape(-1, RESOLUTION, RESOLUTION, RESOLUTION)


def quantize_signed(signed: NDArray[np.floating]) -> NDArray[np.uint8]:
    """[-1, 1] to 0..255, rounded; -1 and +1 are exact."""
    return np.rint((signed + 1.0) * 127.5).astype(np.uint8)


def dequantize_signed(stored: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Inverse of :func:`quantize_signed`, to within 1/255."""
    return stored.astype(np.float32) / np.float32(127.5) - np.float32(1.0)


def _sha256(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as stream:
        while block := stream.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def write_shard(folder: str | Path, arrays: Mapping[str, NDArray[Any]], provenance: Mapping[str, Any]) -> None:
    """Write a whole shard or nothing.

    Args:
        folder: must not exist.
        arrays: ``inputs (N, 32, 32, 32) uint8`` (quantised signed opacity), ``labels (N, 8192) uint8``
            (packed), ``severity (N,)`` and ``edge_fraction (N,)`` float32, ``group (N,) int32``
            (the scene or mesh a cube came from; nothing of a group may straddle a split).
        provenance: JSON-able; kept in the manifest.
    """
    target = Path(folder)
    if target.exists():
        raise FileExistsError(f"write_shard: {target} exists already")
    count = len(arrays["inputs"])
    for name, (shape, dtype) in ARRAYS.items():
        array = arrays[name]
        if array.shape != (count, *shape) or array.dtype != np.dtype(dtype):
            raise ValueError(f"write_shard: {name} must be {dtype} {(count, *shape)}, got {array.dtype} {array.shape}")
    partial = target.with_name(target.name + ".partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    for name in ARRAYS:
        np.save(partial / f"{name}.npy", np.ascontiguousarray(arrays[name]))
    manifest = {
        "format": FORMAT, "format_version": FORMAT_VERSION, "count": count,
        "sha256": {name: _sha256(partial / f"{name}.npy") for name in ARRAYS}, "provenance": dict(provenance),
    }  # fmt: skip
    (partial / "manifest.json").write_text(json.dumps(manifest, indent=1), encoding="utf-8")
    os.replace(partial, target)


@dataclass(frozen=True)
class Shard:
    """Memory-mapped arrays of one shard; see :func:`write_shard` for shapes."""

    inputs: NDArray[np.uint8]
    labels: NDArray[np.uint8]
    severity: NDArray[np.float32]
    edge_fraction: NDArray[np.float32]
    group: NDArray[np.int32]
    provenance: dict[str, Any]

    def __len__(self) -> int:
        return len(self.inputs)


def read_shard(folder: str | Path, *, verify: bool = False) -> Shard:
    """Open a shard; ``verify`` also checks every hash.

    Raises:
        ValueError: no manifest, another format, or arrays that disagree with the manifest.
    """
    source = Path(folder)
    try:
        manifest = json.loads((source / "manifest.json").read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ValueError(f"read_shard: {source} has no manifest.json: not a shard, or unfinished") from None
    except json.JSONDecodeError as error:
        raise ValueError(f"read_shard: {source}/manifest.json is not JSON ({error})") from None
    if manifest.get("format") != FORMAT or manifest.get("format_version") != FORMAT_VERSION:
        raise ValueError(f"read_shard: {source} is not an {FORMAT} of version {FORMAT_VERSION}")
    loaded: dict[str, NDArray[Any]] = {}
    for name, (shape, dtype) in ARRAYS.items():
        path = source / f"{name}.npy"
        try:
            array = np.load(path, mmap_mode="r", allow_pickle=False)
        except (OSError, ValueError) as error:
            raise ValueError(f"read_shard: cannot read {path} ({error})") from None
        if array.shape != (manifest["count"], *shape) or array.dtype != np.dtype(dtype):
            raise ValueError(
                f"read_shard: {path} holds {array.dtype} {array.shape}, "
                f"the manifest says {dtype} {(manifest['count'], *shape)}"
            )
        if verify and _sha256(path) != manifest["sha256"][name]:
            raise ValueError(f"read_shard: {path} does not match the hash in its manifest")
        loaded[name] = array
    return Shard(**loaded, provenance=manifest["provenance"])
