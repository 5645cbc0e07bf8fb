"""Mesh files: any that trimesh reads, at unit size; what is not sound is refused, never guessed at.

A file ends in one of three ways: *loaded* (:func:`read_mesh_file` returns), *empty* (:class:`MeshEmpty`: sound, but
without a triangle) or *rejected with a reason* (:class:`MeshRejected`). ``docs/hostile_meshes.md`` says which
kinds of oddity end in which. OBJ, OFF, PLY, STL and COLLADA (also zipped) are read here, to the letter; glTF and GLB
are checked and counted here and read by trimesh; every other format that the installed trimesh knows is read by it
alone.

Reading is in this process. A file that may be malicious is read by :mod:`.guard`, in another, with a time and a
memory limit.
"""

from __future__ import annotations

import hashlib
import io
import os
import stat
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import unquote

import numpy as np

from ...core.errors import MissingExtra, MissingFile
from .collada import check_xml, read_dae, read_zae
from .gltf import read_glb, read_gltf
from .ply import read_ply
from .reading import MOST_TRIANGLES, Array, MeshEmpty, MeshRejected, trimesh_triangles
from .text import read_obj, read_off, read_stl

if TYPE_CHECKING:
    from .library import Mesh

Side = Callable[[str], bytes]

MOST_BYTES = 1 << 29
SMALLEST_AREA = 1e-14  # of a triangle, the longest side of the mesh being 1
FEWEST_STEPS = 1000  # that single precision must have along the longest side, where the file has no more than that

_ALONE = {"obj": read_obj, "off": read_off, "ply": read_ply, "stl": read_stl, "dae": read_dae, "zae": read_zae}
_WITH_SIDES = {"gltf": read_gltf, "glb": read_glb}
_ZIPPED = frozenset({"3mf", "zae", "3dxml"})
_LFS = b"version https://git-lfs"


@dataclass(frozen=True)
class MeshFile:
    """The triangles of a file, centred and scaled to a longest side of 1.

    Attributes:
        triangles: ``(F, 3, 3)`` float64 in [-1/2, 1/2]; every one has an area. Vertices that no face uses have no
            part in the scale.
        center: ``(3,)``, the middle of the bounds, in the file's unit.
        extent: the longest side of the bounds, in the file's unit.
        dropped: how many triangles without area were left out.
        sha256: of the file's bytes.
        side_files: ``(name, sha256)`` of each file it refers to and that was read, in the order of first use.
    """

    triangles: Array
    center: Array
    extent: float
    dropped: int
    sha256: str
    side_files: tuple[tuple[str, str], ...] = ()


def mesh_suffixes() -> tuple[str, ...]:
    """Suffixes, without the dot, of the mesh formats that could be read if all of their libraries were there."""
    return tuple(sorted({*_ALONE, *_WITH_SIDES, *_ZIPPED, "xaml"}))


def known_formats() -> tuple[str, ...]:
    """Suffixes, without the dot, that can be read with what is installed.

    Raises:
        ImportError: trimesh is not installed.
    """
    _require_trimesh("known_formats")
    from trimesh.exchange.load import mesh_formats

    return tuple(sorted({*_ALONE, *_WITH_SIDES, *(mesh_formats() - {"stl_ascii"})}))


def read_mesh_file(path: str | Path, *, root: str | Path | None = None) -> MeshFile:
    """Read one mesh file, with the transforms of scene nodes applied, normalised to longest side 1.

    Args:
        path: the file; its suffix names the format.
        root: the folder that neither the file nor the files it refers to may leave, through links either; the
            file's own folder unless given.

    Raises:
        FileNotFoundError: no such file.
        ImportError: trimesh, or what it needs for this format, is not installed.
        MeshEmpty: a sound file without a triangle.
        MeshRejected: not sound; the message is the reason.
    """
    _require_trimesh("read_mesh_file")
    source = Path(path)
    if not source.exists():
        raise MissingFile(f"read_mesh_file: {source} is not a file")
    if root is None:  # a link that the caller names is the caller's own
        source = source.resolve()
        folder = source.parent
    else:
        folder = Path(root).resolve()
    suffix = Path(path).suffix.lower().lstrip(".")
    data = _contents(source, folder)
    if data.startswith(_LFS):
        raise MeshRejected("a git-lfs pointer in the place of the file")
    sides: dict[str, bytes] = {}

    def side(name: str) -> bytes:
        if name not in sides:
            sides[name] = _side(name, source, folder)
        return sides[name]

    triangles, center, extent, dropped = normalise(_triangles(data, suffix, side))
    hashes = tuple((name, hashlib.sha256(content).hexdigest()) for name, content in sides.items())
    return MeshFile(triangles, center, extent, dropped, hashlib.sha256(data).hexdigest(), hashes)


def load_mesh(path: str | Path) -> Mesh:
    """Read a mesh file for cutting cubes of it: :func:`read_mesh_file` as a :class:`~.library.Mesh`.

    Raises:
        FileNotFoundError: no such file.
        ImportError: trimesh is not installed.
        ValueError: empty or rejected; the message names the file and the reason.
    """
    from .library import Mesh

    source = Path(path)
    if not source.is_file():
        raise MissingFile(f"load_mesh: {source} is not a file")
    _require_trimesh("load_mesh")
    try:
        return Mesh.from_triangles(read_mesh_file(source).triangles)
    except (MeshEmpty, MeshRejected) as error:
        raise type(error)(f"load_mesh: {source}: {error}") from error


def normalise(triangles: Array) -> tuple[Array, Array, float, int]:
    """Centre triangles and scale them to a longest side of 1, in float64; those without area are dropped.

    Args:
        triangles: ``(F, 3, 3)``, in any unit and anywhere.

    Returns:
        Triangles ``(G, 3, 3)``, the centre ``(3,)`` and longest side of what came, and ``F - G``.

    Raises:
        MeshEmpty: F is 0.
        MeshRejected: too many triangles, corners that are not finite, no extent, no area, or coordinates so far
            from the origin that single precision cannot tell the corners apart.
    """
    if len(triangles) == 0:
        raise MeshEmpty("no triangles")
    if len(triangles) > MOST_TRIANGLES:
        raise MeshRejected(f"{len(triangles)} triangles, more than {MOST_TRIANGLES}")
    soup = np.asarray(triangles, dtype=np.float64)
    if not np.isfinite(soup).all():
        raise MeshRejected(f"{int((~np.isfinite(soup)).sum())} coordinates of corners are not finite")
    low, high = soup.min(axis=(0, 1)), soup.max(axis=(0, 1))
    with np.errstate(over="ignore"):
        extent = float((high - low).max())
    if not (np.isfinite(extent) and extent > 0):
        raise MeshRejected(f"the longest side is {extent}: it must be finite and > 0")
    _check_precision(soup, extent)
    center = low + (high - low) / 2
    soup = (soup - center) / extent
    areas = np.linalg.norm(np.cross(soup[:, 1] - soup[:, 0], soup[:, 2] - soup[:, 0]), axis=1) / 2
    kept = areas > SMALLEST_AREA
    if not kept.any():
        raise MeshRejected(f"none of the {len(soup)} triangles has an area")
    return soup[kept], center, extent, int(len(soup) - kept.sum())


def _check_precision(soup: Array, extent: float) -> None:
    """Refuse what was stored in single precision, far from the origin."""
    furthest = float(np.abs(soup).max())
    if furthest >= float(np.finfo(np.float32).max):
        return
    step = float(np.spacing(np.float32(furthest)))
    if extent / step < FEWEST_STEPS and bool((soup == soup.astype(np.float32)).all()):
        raise MeshRejected(
            f"single precision has {extent / step:.0f} steps along the longest side, {furthest:.3g} from the origin"
        )


def _triangles(data: bytes, suffix: str, side: Side) -> Array:
    """Triangles ``(F, 3, 3)`` as the file has them."""
    try:
        if suffix in _ZIPPED:
            _check_zip(data)
        if suffix in _ALONE:
            return _ALONE[suffix](data)
        if suffix in _WITH_SIDES:
            return _WITH_SIDES[suffix](data, side)
        if suffix not in known_formats():
            raise MeshRejected(f"the format {suffix[:20]!r} is not read; known: {', '.join(known_formats())}")
        if suffix not in _ZIPPED and data.lstrip()[:1] == b"<":
            check_xml(data)
        return trimesh_triangles(data, suffix)
    except RecursionError:
        raise MeshRejected("nested too deep") from None


def _check_zip(data: bytes) -> None:
    """Check a zipped format: what it unpacks to, the names in it, and its XML."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = archive.infolist()
            if sum(member.file_size for member in members) > MOST_BYTES or len(members) > 10_000:
                raise MeshRejected(f"the archive unpacks to more than {MOST_BYTES} bytes or 10000 files")
            for member in members:
                if member.filename.startswith("/") or ".." in Path(member.filename).parts:
                    raise MeshRejected(f"the archive holds the path {member.filename[:60]!r}")
                if member.filename.lower().endswith((".xml", ".model", ".dae", ".rels", ".3dxml")):
                    check_xml(archive.read(member))
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError, EOFError, OSError) as error:
        raise MeshRejected(f"no whole zip archive ({str(error)[:100]})") from error


def _contents(path: Path, root: Path) -> bytes:
    """The bytes of a regular file within ``root``."""
    resolved = path.resolve()
    if not resolved.is_relative_to(root):
        raise MeshRejected("the path leads outside the folder")
    try:
        handle = os.open(resolved, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    except OSError as error:
        raise MeshRejected(f"cannot be opened ({error.strerror})") from error
    status = os.fstat(handle)
    if not stat.S_ISREG(status.st_mode) or status.st_size > MOST_BYTES:
        os.close(handle)
        regular = stat.S_ISREG(status.st_mode)
        raise MeshRejected(f"{status.st_size} bytes, more than {MOST_BYTES}" if regular else "no regular file")
    with os.fdopen(handle, "rb") as stream:
        data = stream.read(status.st_size)
    if not data:
        raise MeshRejected("no bytes")
    return data


def _side(uri: str, source: Path, root: Path) -> bytes:
    """The bytes of a file that a mesh file refers to, relative to it and within ``root``."""
    name = unquote(uri)
    if not name or "\0" in name or ":" in name or "\\" in name or name.startswith(("/", "~")):
        raise MeshRejected(f"it refers to {uri[:60]!r}, which is no relative path")
    target = source.parent / name
    if not target.resolve().is_relative_to(root):
        raise MeshRejected(f"it refers to {uri[:60]!r}, outside the folder")
    if not target.exists():
        raise MeshRejected(f"it refers to {uri[:60]!r}, which is not there")
    return _contents(target, root)


def _require_trimesh(caller: str) -> None:
    """One rule for all formats, so that no folder is read by halves."""
    try:
        import trimesh  # noqa: F401
    except ImportError as error:
        raise MissingExtra(f"{caller}: reading meshes needs trimesh: pip install unghost[recipes]") from error
