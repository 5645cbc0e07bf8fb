"""What the readers of mesh files share: the two ways of failing, text, polygons, and trimesh behind a check.

A reader takes a file's bytes and gives the triangles it describes, ``(F, 3, 3)`` float64 in the file's own unit,
with the transforms of scene nodes applied; ``(0, 3, 3)`` where a sound file has none. It never opens a file.
"""

from __future__ import annotations

import io
import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.errors import InvalidFile, MissingExtra

Array = NDArray[Any]

UTF8_MARK = b"\xef\xbb\xbf"
UTF16_MARKS = (b"\xff\xfe", b"\xfe\xff")
_MARKS = ((UTF8_MARK, "utf-8-sig"), *((mark, "utf-16") for mark in UTF16_MARKS))
_NO_NUMBER = re.compile(r"[^\t-\r !-^`-~]")  # anything but plain ASCII, and the underscore
MOST_TRIANGLES = 20_000_000  # of a file
MOST_CORNERS = 20_000  # of a concave polygon: cut in less than a second, or in some seconds if it crosses itself
_FLATTEST = 1e-9  # smallest singular value over the largest of a node's transform


class MeshRejected(InvalidFile):
    """The file is refused; the message is the reason, without the file's name."""


class MeshEmpty(InvalidFile):
    """A sound file without a triangle; the message says what it holds instead."""


def no_triangles() -> Array:
    """The triangles ``(0, 3, 3)`` of a sound file without any."""
    return np.zeros((0, 3, 3))


def decode_text(data: bytes) -> str:
    """Text of any usual encoding (byte order mark, UTF-8, Latin-1) and any line end, its lines ended by ``\\n``.

    Raises:
        MeshRejected: no such text, or NUL characters in it.
    """
    encoding = next((name for mark, name in _MARKS if data.startswith(mark)), "utf-8")
    try:
        text = data.decode(encoding)
    except UnicodeDecodeError as error:
        if encoding != "utf-8":
            raise MeshRejected(f"text with the byte order mark of {encoding} that is not {encoding}") from error
        text = data.decode("latin-1")
    if "\0" in text:
        raise MeshRejected("NUL characters in a text file")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def number_words(text: str) -> list[str]:
    """Split text at white space into words that ``int`` and ``float`` read as file formats mean them.

    Raises:
        ValueError: an underscore, or anything but plain ASCII: Python takes ``1_0``, digits of any script, and white
            space of any script between them.
    """
    if _NO_NUMBER.search(text):
        raise InvalidFile(f"no plain numbers: {text.strip()[:60]!r}")
    return text.split()


def whole_numbers(text: str) -> Array:
    """The whole numbers of a text, ``(N,)`` int64.

    Raises:
        ValueError: a word that is none, or one of more than 64 bits.
    """
    try:
        return np.array([int(word) for word in number_words(text)], dtype=np.int64)
    except OverflowError:
        raise InvalidFile(f"a number of more than 64 bits: {text.strip()[:60]!r}") from None


def decimal_numbers(text: str) -> Array:
    """The numbers of a text, ``(N,)`` float64; NaN and infinity are numbers, which no face may use.

    Raises:
        ValueError: a word that is none.
    """
    return np.array([float(word) for word in number_words(text)], dtype=np.float64)


def strip_corners(corners: Array, lengths: Array) -> Array:
    """Corners ``(3 T,)`` of the triangles of strips, every second one turned round, so that all face the same way.

    Args:
        corners: ``(lengths.sum(),)``, the strips' vertex numbers one after the other.
        lengths: ``(S,)``, the corners of each strip.

    Raises:
        MeshRejected: a strip of fewer than three corners.
    """
    if len(lengths) and lengths.min() < 3:
        raise MeshRejected(f"a strip of {int(lengths.min())} corners")
    first = np.repeat(np.cumsum(lengths) - lengths, lengths - 2)
    step = np.arange(len(first)) - np.repeat(np.cumsum(lengths - 2) - (lengths - 2), lengths - 2)
    odd, first = step % 2, first + step
    return np.stack([corners[first], corners[first + 1 + odd], corners[first + 2 - odd]], axis=-1).ravel()


def triangulate(vertices: Array, counts: Array, corners: Array) -> Array:
    """Cut polygons into triangles: a fan where that is right, along inner diagonals where the polygon is concave.

    Concave quads are cut here, other concave polygons by ``mapbox_earcut``; a polygon that crosses itself is a fan.

    Args:
        vertices: ``(V, 3)``.
        counts: ``(P,)``, the corners of each polygon.
        corners: ``(counts.sum(),)``, the polygons' vertex numbers one after the other.

    Returns:
        ``(F, 3, 3)``, in the order of the polygons.

    Raises:
        MeshRejected: a polygon of fewer than three corners, or a corner that is no vertex.
    """
    if len(counts) == 0:
        return no_triangles()
    if counts.min() < 3:
        raise MeshRejected(f"face {int(counts.argmin())} has {int(counts.min())} corners")
    if corners.min() < 0 or corners.max() >= len(vertices):
        outside = int(((corners < 0) | (corners >= len(vertices))).sum())
        raise MeshRejected(f"{outside} face corners name a vertex that is not among the {len(vertices)}")
    with np.errstate(invalid="ignore", over="ignore"):  # whether the values are finite is judged after reading
        return _cut(vertices, counts, corners)


def _cut(vertices: Array, counts: Array, corners: Array) -> Array:
    starts = np.cumsum(counts) - counts
    pieces: list[Array] = []
    owners: list[Array] = []
    for n in np.unique(counts):
        rows = np.flatnonzero(counts == n)
        rings = vertices[corners[starts[rows][:, None] + np.arange(n)]]
        fans = np.stack([rings[:, :1].repeat(n - 2, axis=1), rings[:, 1:-1], rings[:, 2:]], axis=2)
        concave = np.flatnonzero(_concave(fans))
        if n == 4:
            other = rings[concave][:, [[1, 2, 3], [1, 3, 0]]]  # cut along the other diagonal
            right = ~_concave(other)
            fans[concave[right]] = other[right]
        elif len(concave):
            triangles, polygons = _cut_concave(rings[concave])
            pieces.append(triangles)
            owners.append(rows[concave[polygons]])
            rows, fans = np.delete(rows, concave), np.delete(fans, concave, axis=0)
        pieces.append(fans.reshape(-1, 3, 3))
        owners.append(np.repeat(rows, n - 2))
    return np.concatenate(pieces)[np.argsort(np.concatenate(owners), kind="stable")]


def _concave(fans: Array) -> Array:
    """Which of the polygons, cut into triangles ``(P, n - 2, 3, 3)``, have one that is turned against the whole."""
    fans = fans - fans[:, :1, :1]
    fans = fans / np.maximum(np.abs(fans).max(axis=(1, 2, 3), keepdims=True), 1e-300)
    normals = np.cross(fans[:, :, 1] - fans[:, :, 0], fans[:, :, 2] - fans[:, :, 0])
    whole = normals.sum(axis=1, keepdims=True)
    turned: Array = ((normals * whole).sum(axis=2) < -1e-9 * (whole**2).sum(axis=2)).any(axis=1)
    return turned


def _cut_concave(rings: Array) -> tuple[Array, Array]:
    """Cut concave polygons ``(P, n, 3)`` along diagonals inside them, in the coordinate plane that each faces most.

    Returns:
        Triangles ``(F, 3, 3)``, turned as their polygons, and the number ``(F,)`` of each one's polygon. Corners on a
        straight line may be left out. A polygon that crosses itself is a fan: no cut covers its area once.
    """
    n = rings.shape[1]
    if n > MOST_CORNERS:
        raise MeshRejected(f"a concave polygon of {n} corners, more than {MOST_CORNERS}")
    try:
        from mapbox_earcut import triangulate_float64
    except ImportError as error:
        raise MissingExtra("triangulate: concave polygons need mapbox_earcut: pip install unghost[recipes]") from error
    moved = rings - rings[:, :1]
    moved = np.ldexp(moved, -np.frexp(np.abs(moved).max(axis=(1, 2), keepdims=True))[1])  # at most 1, without rounding
    normal = np.cross(moved, np.roll(moved, -1, axis=1)).sum(axis=1)
    plane = np.array([[1, 2], [2, 0], [0, 1]])[np.abs(normal).argmax(axis=1)]
    flat = np.take_along_axis(moved, plane[:, None, :], axis=2)
    areas = _signed_areas(flat[:, :1], flat[:, 1:-1], flat[:, 2:]).sum(axis=1)
    ends = np.array([n], dtype=np.uint32)
    cuts = [triangulate_float64(ring, ends).reshape(-1, 3).astype(np.int64) for ring in flat]
    index, owner = np.concatenate(cuts), np.repeat(np.arange(len(cuts)), [len(cut) for cut in cuts])
    parts = _signed_areas(*np.moveaxis(flat[owner[:, None], index], 1, 0))
    covered = np.bincount(owner, np.abs(parts), minlength=len(cuts))
    right = np.abs(covered - np.abs(areas)) <= 1e-9 * np.abs(areas) + 1e-12
    index = np.where((parts * areas[owner] < 0)[:, None], index[:, ::-1], index)
    crossed, fan = (
        np.flatnonzero(~right),
        np.stack([np.zeros(n - 2, int), np.arange(1, n - 1), np.arange(2, n)], axis=1),
    )
    index = np.concatenate([index[right[owner]], np.tile(fan, (len(crossed), 1))])
    owner = np.concatenate([owner[right[owner]], np.repeat(crossed, n - 2)])
    return rings[owner[:, None], index], owner


def _signed_areas(a: Array, b: Array, c: Array) -> Array:
    """Signed areas ``(...)`` of triangles with corners ``(..., 2)``."""
    area: Array = ((b - a)[..., 0] * (c - a)[..., 1] - (b - a)[..., 1] * (c - a)[..., 0]) / 2
    return area


def trimesh_triangles(data: bytes, file_type: str, sides: dict[str, bytes] | None = None) -> Array:
    """What trimesh reads: every mesh of the scene, moved by its node's transform, ``(F, 3, 3)``.

    Args:
        data: the file.
        file_type: trimesh's name of the format.
        sides: files it may refer to, by name; there are no others.

    Raises:
        ImportError: trimesh, or what trimesh needs for this format, is not installed.
        MeshRejected: trimesh fails, a face names a vertex that is not there, or a node's transform is not finite
            or flattens what it carries.
    """
    import trimesh

    try:
        with np.errstate(invalid="ignore"):  # whether the values are finite is judged after reading
            scene: Any = trimesh.load_scene(
                io.BytesIO(data), file_type=file_type, resolver=sides or {}, process=False, skip_materials=True
            )
    except (ImportError, MemoryError):
        raise
    except Exception as error:  # readers of a dozen formats raise whatever they like
        raise MeshRejected(f"not readable as {file_type} ({type(error).__name__}: {str(error)[:200]})") from error
    soup = []
    for node in scene.graph.nodes_geometry:
        matrix, name = scene.graph.get(node)
        geometry = scene.geometry[name]
        if isinstance(geometry, trimesh.Trimesh) and len(geometry.faces):
            soup.append(place(np.asarray(geometry.vertices, dtype=np.float64), geometry.faces, matrix, str(node)))
    return np.concatenate(soup) if soup else no_triangles()


def place(vertices: Array, faces: Array, matrix: Array, node: str) -> Array:
    """Triangles ``(F, 3, 3)`` of one node in the scene's frame.

    Args:
        vertices: ``(V, 3)``, in the node's frame.
        faces: ``(F, 3)``, F > 0.
        matrix: ``(4, 4)``, from the node's frame to the scene's.
        node: its name, for the message.

    Raises:
        MeshRejected: a face names a vertex that is not there, or the matrix is not finite or flattens the mesh.
    """
    faces, matrix = np.asarray(faces), np.asarray(matrix, dtype=np.float64)
    if not np.isfinite(matrix).all():
        raise MeshRejected(f"the transform of node {node[:80]!r} is not finite")
    sizes = np.linalg.svd(matrix[:3, :3], compute_uv=False)
    if not sizes[2] > _FLATTEST * sizes[0]:
        raise MeshRejected(f"the transform of node {node[:80]!r} flattens its mesh (singular values {sizes})")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise MeshRejected(f"faces of node {node[:80]!r} name vertices that are not among its {len(vertices)}")
    with np.errstate(invalid="ignore", over="ignore"):
        placed: Array = (vertices @ matrix[:3, :3].T + matrix[:3, 3])[faces]
    return placed
