"""What kind of file a path names, by its content: the suffix is not asked, nothing of the file is run or unpickled.

Magic bytes and layouts: PLY (Turk 1994); npz and torch checkpoints (zip archives); SPZ (Niantic, ``NGSP``, gzip around
it up to version 3); ``.splat`` (antimatter15: 32 bytes a splat, no header); ``.ksplat`` (mkkellogg: header of 4096
bytes, 1024 a section); SOG (PlayCanvas: ``meta.json`` and WebP textures); git-lfs pointers.
"""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .errors import InvalidFile, MissingFile

START = 1 << 16  # bytes of a file that are looked at
_TO_PLY = "convert it to a 3DGS .ply, with SuperSplat (superspl.at/editor) or splat-transform"
_FIELD = "lay its density out on a grid (.npz with density and aabb), or pass the field to unghost.clean"
_WHOLE = "copy or download it again"


@dataclass(frozen=True)
class FileKind:
    """A kind of file.

    Attributes:
        name: what it is, with its article.
        advice: what to do with it where it cannot be read.
    """

    name: str
    advice: str


SPLATS = FileKind("a .ply of 3D Gaussians", "unghost clean and read_splat_ply read it")
GRID = FileKind("an .npz archive", "unghost clean and load_grid read it, if it holds density and aabb")
KEEP_MASK = FileKind("a keep mask", "name the file that was cleaned, and this one with --mask")
COMPRESSED_PLY = FileKind("a compressed splat file (.compressed.ply)", _TO_PLY)
SPZ = FileKind("a compressed splat file (.spz)", _TO_PLY)
SPLAT = FileKind("a compressed splat file (.splat)", _TO_PLY)
KSPLAT = FileKind("a compressed splat file (.ksplat)", _TO_PLY)
SOG = FileKind("a compressed splat file (SOG)", _TO_PLY)
ASCII_PLY = FileKind(
    "an ASCII .ply of 3D Gaussians", "write it as binary_little_endian (plyfile: PlyData.text = False)"
)
BIG_ENDIAN_PLY = FileKind(
    "a big-endian .ply of 3D Gaussians", 'write it as binary_little_endian (plyfile: PlyData.byte_order = "<")'
)
MESH_PLY = FileKind("a .ply of a mesh, without the properties of splats", "train 3D Gaussians, or give their .ply")
POINTS_PLY = FileKind(
    "a .ply of points, without the properties of splats",
    "give the .ply of the trained Gaussians",
)
BROKEN_PLY = FileKind("a .ply whose header has no end", _WHOLE)
LFS_POINTER = FileKind("a git-lfs pointer, not the file itself", "fetch that with git lfs pull")
FOLDER = FileKind("a folder", "name a file in it, such as point_cloud/iteration_30000/point_cloud.ply")
NPY = FileKind("a single .npy array", "save it with its box: np.savez(path, density=density, aabb=aabb)")
SNAPSHOT = FileKind(
    "an instant-ngp snapshot",
    "save density and aabb of load_instant_ngp(path).cascade(0) as .npz (unghost.fields.adapters)",
)
CHECKPOINT = FileKind("a checkpoint of a framework (torch)", _FIELD)
BROKEN_ZIP = FileKind("an .npz or .sog archive without its end (truncated?)", _WHOLE)
ARCHIVE = FileKind("an archive", "unpack it, and name the .ply or .npz in it")
GLTF = FileKind("a glTF file (.glb)", "convert splats in it to a 3DGS .ply; a mesh is no radiance field")
EMPTY = FileKind("an empty file", _WHOLE)
UNKNOWN = FileKind("of no known format", "3D Gaussians are read from a binary .ply, density grids from an .npz")


def file_kind(path: str | Path, *, caller: str = "file_kind") -> FileKind:
    """Decide what kind of file ``path`` names, from its first 64 KiB (of a zip archive: from its list of names).

    Args:
        path: a file or folder; its suffix plays no part.
        caller: begins the message of an error.

    Raises:
        FileNotFoundError: there is no such file.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "scene.PLY"
        >>> _ = path.write_bytes(b"version https://git-lfs.github.com/spec/v1")
        >>> file_kind(path).name
        'a git-lfs pointer, not the file itself'
    """
    source = Path(path)
    if source.is_dir():
        return SOG if (source / "meta.json").is_file() and any(source.glob("*.webp")) else FOLDER
    if not source.exists():
        raise MissingFile(f"{caller}: no file {source}")
    with source.open("rb") as stream:
        start = stream.read(START)
    size = source.stat().st_size
    if start.startswith((b"PK\x03\x04", b"PK\x05\x06")):
        return _zip_kind(source)
    if start[:4] in (b"ply\n", b"ply\r"):
        return _ply_kind(start)
    if start.startswith((b"\x1f\x8b", b"\x78\x01", b"\x78\x5e", b"\x78\x9c", b"\x78\xda")):
        return _packed_kind(start)
    return next((kind for holds, kind in _TABLE if holds(start, size)), UNKNOWN)


def not_readable(path: str | Path, kind: FileKind, *, caller: str) -> InvalidFile:
    """The error that names what a file is, and what to do with it.

    Example:
        >>> str(not_readable("scene.spz", SPZ, caller="clean")).partition(":")[2].partition(":")[0]
        ' scene.spz is a compressed splat file (.spz)'
    """
    return InvalidFile(f"{caller}: {path} is {kind.name}: {kind.advice}")


def _zip_kind(source: Path) -> FileKind:
    try:
        with zipfile.ZipFile(source) as archive:
            names = [Path(name).name for name in archive.namelist()]
    except (zipfile.BadZipFile, OSError, ValueError):
        return BROKEN_ZIP
    if "meta.json" in names and any(name.endswith(".webp") for name in names):
        return SOG
    if "data.pkl" in names:
        return CHECKPOINT
    if set(names) == {"manifest.npy", "cells.npy"}:
        return KEEP_MASK
    return GRID if all(name.endswith(".npy") for name in names) else ARCHIVE


def _packed_kind(start: bytes) -> FileKind:
    """What is inside gzip or zlib."""
    try:
        inside = zlib.decompressobj(wbits=47).decompress(start, START)
    except zlib.error:
        return UNKNOWN
    if inside.startswith(b"NGSP"):
        return SPZ
    return SNAPSHOT if _is_snapshot(inside, len(inside)) else ARCHIVE


def _ply_kind(start: bytes) -> FileKind:
    head, end, _ = start.partition(b"end_header")
    if not end:
        return BROKEN_PLY
    form, element, faces = "", "", False
    vertex: set[str] = set()
    for words in (line.split() for line in head.decode("latin-1").splitlines()):
        if words[:1] == ["format"] and len(words) > 1:
            form = words[1]
        elif words[:1] == ["element"] and len(words) > 2:
            element = words[1]
            faces |= element in ("face", "tristrips") and words[2] != "0"
        elif words[:1] == ["property"] and element == "vertex":
            vertex.add(words[-1])
    if "packed_position" in vertex:
        return COMPRESSED_PLY
    if {"opacity", "scale_0", "rot_0"} & vertex:
        return {"ascii": ASCII_PLY, "binary_big_endian": BIG_ENDIAN_PLY}.get(form, SPLATS)
    return MESH_PLY if faces else POINTS_PLY


def _is_ksplat(start: bytes, size: int) -> bool:
    """Version 0.1 and later; the numbers of sections and of splats fit each other and the size."""
    if size < 4096 + 1024 or len(start) < 24 or start[0] != 0 or not 1 <= start[1] < 10:
        return False
    most_sections, sections, most_splats, splats = np.frombuffer(start, "<u4", 4, 4).tolist()
    level = int(np.frombuffer(start, "<u2", 1, 20)[0])
    return (
        0 < sections <= most_sections
        and splats <= most_splats
        and level in (0, 1, 2)
        and size >= 4096 + 1024 * most_sections
    )


def _is_splat(start: bytes, size: int) -> bool:
    """Rows of 32 bytes: finite places, extents above 0, colours, a quaternion of length 1 in four bytes."""
    if size == 0 or size % 32:
        return False
    rows = np.frombuffer(start[: len(start) // 32 * 32], np.dtype([("a", "<f4", 6), ("b", "u1", 8)]))
    with np.errstate(invalid="ignore", over="ignore"):
        length = np.linalg.norm((rows["b"][:, 4:].astype(np.float64) - 128) / 128, axis=1)
        good = np.isfinite(rows["a"]).all(axis=1) & (rows["a"][:, 3:] >= 0).all(axis=1)
        good &= (np.abs(rows["a"]) < 1e8).all(axis=1) & (np.abs(length - 1) < 0.05)
    return bool(good.mean() > 0.9)


def _is_snapshot(start: bytes, _size: int) -> bool:
    """A map of MessagePack with one of the keys that instant-ngp writes."""
    return (start[:1] in (b"\xde", b"\xdf") or 0x80 <= (start or b"\0")[0] <= 0x8F) and any(
        key in start for key in (b"snapshot", b"encoding", b"otype")
    )


def _is_sog_json(start: bytes, _size: int) -> bool:
    return start.lstrip().startswith(b"{") and b".webp" in start


def _starts(*magic: bytes) -> Callable[[bytes, int], bool]:
    return lambda start, _size: start.startswith(magic)


_TABLE: tuple[tuple[Callable[[bytes, int], bool], FileKind], ...] = (  # the first that holds
    (lambda start, size: size == 0, EMPTY),
    (_starts(b"version https://git-lfs.github.com/spec/"), LFS_POINTER),
    (_starts(b"\x93NUMPY"), NPY),
    (_starts(b"NGSP"), SPZ),
    (_starts(b"glTF"), GLTF),
    (_starts(*(bytes([0x80, version]) for version in range(2, 6))), CHECKPOINT),  # a bare pickle
    (_is_sog_json, SOG),
    (_is_snapshot, SNAPSHOT),
    (_is_ksplat, KSPLAT),
    (_is_splat, SPLAT),
)
