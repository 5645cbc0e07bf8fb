"""What the readers of mesh files share: the two ways of failing, text, polygons, and trimesh behind a check.

A reader takes a file's bytes and gives the triangles it describes, ``(F, 3, 3)`` float64 in the file's own unit,
with the transforms of scene nodes applied; ``(0, 3, 3)`` where a sound file has none. It never opens a file.
"""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

_MARKS = ((b"\xef\xbb\xbf", "utf-8-sig"), (b"\xff\xfe", "utf-16"), (b"\xfe\xff", "utf-16"))
MOST_CORNERS = 2000  # of a concave polygon
_FLATTEST = 1e-9  # smallest singular value over the largest of a node's transform


class MeshRejected(ValueError):
    """The file is refused; the message is the reason, without the file's name."""


class MeshEmpty(ValueError):
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


def triangulate(vertices: Array, counts: Array, corners: Array) -> Array:
    """Cut polygons into triangles: a fan where that is right, ears where the polygon is concave.

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
        fans = np.stack([np.stack([rings[:, 0], rings[:, i], rings[:, i + 1]], axis=1) for i in range(1, n - 1)], 1)
        for row in _concave(fans) if n > 3 else ():
            fans[row] = _clip_ears(rings[row], fans[row])
        pieces.append(fans.reshape(-1, 3, 3))
        owners.append(np.repeat(rows, n - 2))
    return np.concatenate(pieces)[np.argsort(np.concatenate(owners), kind="stable")]


def _concave(fans: Array) -> Array:
    """Numbers of the polygons ``(P, n - 2, 3, 3)`` with a fan triangle turned against the whole."""
    fans = fans - fans[:, :1, :1]
    fans = fans / np.maximum(np.abs(fans).max(axis=(1, 2, 3), keepdims=True), 1e-300)
    normals = np.cross(fans[:, :, 1] - fans[:, :, 0], fans[:, :, 2] - fans[:, :, 0])
    whole = normals.sum(axis=1, keepdims=True)
    turned = (normals * whole).sum(axis=2) < -1e-9 * (whole**2).sum(axis=2)
    rows: Array = np.flatnonzero(turned.any(axis=1))
    return rows


def _clip_ears(ring: Array, fan: Array) -> Array:
    """Triangles ``(n - 2, 3, 3)`` of a concave polygon ``(n, 3)``; its fan where no cut is right (it meets itself)."""
    if len(ring) > MOST_CORNERS:
        raise MeshRejected(f"a concave polygon of {len(ring)} corners, more than {MOST_CORNERS}")
    moved = ring - ring[0]
    normal = np.cross(moved, np.roll(moved, -1, axis=0)).sum(axis=0)
    flat = np.delete(moved, int(np.abs(normal).argmax()), axis=1)
    x, y = flat[:, 0], flat[:, 1]
    if (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() < 0:
        flat = flat * [1, -1]
    left, ears = list(range(len(ring))), []
    while len(left) > 3:
        ear = next((i for i in range(len(left)) if _is_ear(flat, left, i)), None)
        if ear is None:
            return fan
        ears.append([left[ear - 1], left[ear], left[(ear + 1) % len(left)]])
        del left[ear]
    triangles: Array = ring[np.array([*ears, left])]
    return triangles


def _is_ear(flat: Array, left: list[int], i: int) -> bool:
    """Whether corner ``i`` of the remaining counter-clockwise ring can go: convex, and no other in its triangle."""
    a, b, c = (flat[left[j % len(left)]] for j in (i - 1, i, i + 1))

    def side(p: Array, q: Array, r: Array) -> Array:
        area: Array = (q[0] - p[0]) * (r[..., 1] - p[1]) - (q[1] - p[1]) * (r[..., 0] - p[0])
        return area

    if side(a, b, c) <= 0:  # a straight corner adds no area
        return bool(side(a, b, c) == 0 and np.dot(b - a, c - b) >= 0)
    others = flat[left]
    at_corner = (others == a).all(axis=1) | (others == b).all(axis=1) | (others == c).all(axis=1)
    inside = (side(a, b, others) >= 0) & (side(b, c, others) >= 0) & (side(c, a, others) >= 0) & ~at_corner
    return not bool(inside.any())


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
            soup.append(_place(np.asarray(geometry.vertices, dtype=np.float64), geometry.faces, matrix, str(node)))
    return np.concatenate(soup) if soup else no_triangles()


def _place(vertices: Array, faces: Array, matrix: Array, node: str) -> Array:
    """Triangles ``(F, 3, 3)`` of one node in the scene's frame."""
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
