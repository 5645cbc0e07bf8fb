"""OBJ, OFF and STL, read to the letter: a statement that cannot be meant rejects the file.

A general reader skips what it does not understand, and a mesh with a wrong index, a missing coordinate or half of
its lines comes out as some other mesh. These formats are short enough to be read whole.

Written here, because trimesh (5.2.0) alone, on the 45 OBJ and 13 STL files of the hostile set, makes a mesh of 3 OBJ
files that are not sound (faces of two corners, NUL characters), fails on 2 that are (a byte order mark, old line ends),
calls 2 files that are no OBJ empty, and calls 4 STL files that are cut short or no STL empty. On the 216 OBJ and 8 STL
files of the ordinary set the two agree.
"""

from __future__ import annotations

import re

import numpy as np

from .reading import Array, MeshRejected, decode_text, no_triangles, triangulate, trimesh_triangles

_OBJ_SILENT = frozenset(
    {
        "vt",
        "vn",
        "vp",
        "p",
        "l",
        "o",
        "g",
        "s",
        "mg",
        "usemtl",
        "mtllib",
        "usemap",
        "maplib",
        "bevel",
        "c_interp",
        "d_interp",
        "lod",
        "shadow_obj",
        "trace_obj",
        "cstype",
        "deg",
        "bmat",
        "step",
        "parm",
        "trim",
        "hole",
        "scrv",
        "sp",
        "end",
        "con",
        "ctech",
        "stech",
        "call",
        "csh",
    }
)
_OBJ_FREE_FORM = frozenset({"surf", "curv", "curv2", "bzp", "bsp", "cdc", "cdp", "res"})
_OFF_HEADER = re.compile(r"(ST)?(C)?(N)?OFF")
_FACET = re.compile(
    rb"facet\s+normal(?:\s+\S+){3}\s+outer\s+loop" + rb"\s+vertex\s+\S+\s+\S+\s+\S+" * 3 + rb"\s+endloop\s+endfacet",
    re.IGNORECASE,
)


def _numbers(words: list[str], number: int) -> list[float]:
    """Three coordinates of line ``number``."""
    try:
        if len(words) < 3 or "_" in "".join(words[:3]):
            raise ValueError
        return [float(word) for word in words[:3]]
    except ValueError:
        raise MeshRejected(f"line {number}: a vertex needs three numbers, got {' '.join(words)[:60]!r}") from None


def read_obj(data: bytes) -> Array:
    """Triangles of a Wavefront OBJ: vertices and faces, polygons cut; groups, materials, lines and points left out.

    Colours after the coordinates and a fourth coordinate are ignored; line continuations, negative indices, byte
    order marks and old line ends are read.

    Raises:
        MeshRejected: a vertex without three numbers, a face of fewer than three corners, an index that is 0, not
            whole or out of range, a free-form surface, an unknown statement, or no statement at all.
    """
    vertices: list[list[float]] = []
    corners: list[int] = []
    counts: list[int] = []
    known = False
    for number, line in enumerate(decode_text(data).replace("\\\n", " ").split("\n"), 1):
        words = line.split("#", 1)[0].split()
        if not words:
            continue
        keyword = words[0]
        if keyword == "v":
            vertices.append(_numbers(words[1:], number))
        elif keyword in ("f", "fo"):
            corners += _obj_face(words[1:], len(vertices), number)
            counts.append(len(words) - 1)
        elif keyword in _OBJ_FREE_FORM:
            raise MeshRejected(f"line {number}: free-form surfaces ({keyword}) are not read")
        elif keyword not in _OBJ_SILENT:
            raise MeshRejected(f"line {number}: {keyword[:40]!r} is no OBJ statement")
        known = True
    if not known:
        raise MeshRejected("no OBJ statement in the file")
    points = np.array(vertices, dtype=np.float64).reshape(-1, 3)
    return triangulate(points, np.array(counts, dtype=np.int64), np.array(corners, dtype=np.int64))


def _obj_face(words: list[str], seen: int, number: int) -> list[int]:
    """Vertex numbers, from 0, of an OBJ face: counted from 1, or backwards from the last of ``seen`` vertices."""
    if len(words) < 3:
        raise MeshRejected(f"line {number}: a face needs three corners, got {len(words)}")
    try:
        raw = [int(word.split("/", 1)[0]) for word in words]
    except ValueError:
        raise MeshRejected(f"line {number}: face indices must be whole numbers, got {' '.join(words)[:60]!r}") from None
    if 0 in raw or min(raw) < -seen:
        raise MeshRejected(f"line {number}: face index 0 or before the first vertex in {' '.join(words)[:60]!r}")
    return [index - 1 if index > 0 else seen + index for index in raw]


def read_off(data: bytes) -> Array:
    """Triangles of an Object File Format file of text: OFF, COFF, NOFF, STOFF and their mixtures.

    Raises:
        MeshRejected: binary or not three-dimensional, counts that disagree with the lines, bad numbers or indices.
    """
    lines = [words for line in decode_text(data).split("\n") if (words := line.split("#", 1)[0].split())]
    if not lines or not _OFF_HEADER.fullmatch(lines[0][0]):
        raise MeshRejected("the file does not start with OFF (binary and 4- or n-dimensional files are not read)")
    head, body = (lines[0][1:], lines[1:]) if len(lines[0]) > 1 else ((lines[1] if len(lines) > 1 else []), lines[2:])
    try:
        n_vertices, n_faces = int(head[0]), int(head[1])
    except (IndexError, ValueError):
        raise MeshRejected(f"the counts must be whole numbers, got {' '.join(head)[:60]!r}") from None
    if n_vertices < 0 or n_faces < 0 or n_vertices + n_faces != len(body):
        raise MeshRejected(f"{n_vertices} vertices and {n_faces} faces are announced, {len(body)} lines follow")
    points = np.array([_numbers(words, i) for i, words in enumerate(body[:n_vertices])]).reshape(-1, 3)
    counts, corners = [], []
    for i, words in enumerate(body[n_vertices:]):
        try:
            n = int(words[0])
            ring = [int(word) for word in words[1 : n + 1]]
        except ValueError:
            raise MeshRejected(f"face {i}: corners must be whole numbers, got {' '.join(words)[:60]!r}") from None
        if n < 3 or len(ring) != n:
            raise MeshRejected(f"face {i}: {n} corners are announced, {len(ring)} are there")
        counts.append(n)
        corners += ring
    return triangulate(points, np.array(counts, dtype=np.int64), np.array(corners, dtype=np.int64))


def read_stl(data: bytes) -> Array:
    """Triangles of an STL, binary (84 + 50 n bytes, whatever its header says) or text (whole facets only).

    Raises:
        MeshRejected: neither, or cut short.
    """
    announced = int.from_bytes(data[80:84], "little") if len(data) >= 84 else -1
    if announced >= 0 and len(data) == 84 + 50 * announced:
        expected, kind = announced, "stl"
    elif data[:512].lstrip()[:5].lower() == b"solid":
        expected, kind = _count_facets(data), "stl_ascii"
    elif announced >= 0:
        raise MeshRejected(f"{announced} triangles make {84 + 50 * announced} bytes of binary STL, got {len(data)}")
    else:
        raise MeshRejected(f"neither text nor binary STL ({len(data)} bytes)")
    if expected == 0:
        return no_triangles()
    triangles = trimesh_triangles(data, kind)
    if len(triangles) != expected:
        raise MeshRejected(f"{expected} facets are in the file, {len(triangles)} were read")
    return triangles


def _count_facets(data: bytes) -> int:
    """How many whole facets an ASCII STL has."""
    words = re.split(rb"\s+", data.strip().lower())
    facets = len(_FACET.findall(data))
    if facets != words.count(b"endfacet") or facets != words.count(b"facet") or b"endsolid" not in words:
        raise MeshRejected(f"text STL of {facets} whole facets that is cut short or broken")
    return facets
