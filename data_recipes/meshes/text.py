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
from array import array

import numpy as np

from .reading import UTF8_MARK, UTF16_MARKS, Array, MeshRejected, decode_text, number_words, triangulate, whole_numbers

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
_OFF_HEADER = re.compile(r"(ST)?(C)?(N)?OFF(?![^\s\d])", re.ASCII)
_LARGEST = (1 << 62) - 1  # of an index
_NUMBER = r"\s+([-+.0-9a-z]+)"
_FACET = re.compile(
    r"(?<!\S)facet\s+normal(?:\s+\S+){3}\s+outer\s+loop"
    + rf"\s+vertex{_NUMBER}{_NUMBER}{_NUMBER}" * 3
    + r"\s+endloop\s+endfacet(?!\S)",
    re.IGNORECASE | re.ASCII,
)
_VERTEX = re.compile(r"(?<!\S)vertex(?:\s+[-+]?\.?[0-9][-+.0-9e]*(?!\S)){3}", re.IGNORECASE)
_FACET_PART = re.compile(r"(?<!\S)(?:facet\s+normal|outer\s+loop|endloop|endfacet)(?!\S)", re.IGNORECASE)
_STL_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attributes", "<u2")])


def _numbers(text: str, number: int) -> list[float]:
    """Three coordinates of line ``number``."""
    try:
        x, y, z, *_ = number_words(text)
        return [float(x), float(y), float(z)]
    except ValueError:
        raise MeshRejected(f"line {number}: a vertex needs three numbers, got {text.strip()[:60]!r}") from None


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
        parts = line.split("#", 1)[0].split(None, 1)
        if not parts:
            continue
        keyword, rest = parts[0], parts[1] if len(parts) > 1 else ""
        if keyword == "v":
            vertices.append(_numbers(rest, number))
        elif keyword in ("f", "fo"):
            ring = _obj_face(rest, len(vertices), number)
            corners += ring
            counts.append(len(ring))
        elif keyword in _OBJ_FREE_FORM:
            raise MeshRejected(f"line {number}: free-form surfaces ({keyword}) are not read")
        elif keyword not in _OBJ_SILENT:
            raise MeshRejected(f"line {number}: {keyword[:40]!r} is no OBJ statement")
        known = True
    if not known:
        raise MeshRejected("no OBJ statement in the file")
    points = np.array(vertices, dtype=np.float64).reshape(-1, 3)
    return triangulate(points, np.array(counts, dtype=np.int64), np.array(corners, dtype=np.int64))


def _obj_face(text: str, seen: int, number: int) -> list[int]:
    """Vertex numbers, from 0, of an OBJ face: counted from 1, or backwards from the last of ``seen`` vertices."""
    try:
        raw = [int(word.split("/", 1)[0]) for word in number_words(text)]
    except ValueError:
        raise MeshRejected(f"line {number}: face indices must be whole numbers, got {text.strip()[:60]!r}") from None
    if len(raw) < 3:
        raise MeshRejected(f"line {number}: a face needs three corners, got {len(raw)}")
    if 0 in raw or min(raw) < -seen:
        raise MeshRejected(f"line {number}: face index 0 or before the first vertex in {text.strip()[:60]!r}")
    if max(raw) > _LARGEST:
        raise MeshRejected(f"line {number}: a face index beyond {_LARGEST} in {text.strip()[:60]!r}")
    return [index - 1 if index > 0 else seen + index for index in raw]


def read_off(data: bytes) -> Array:
    """Triangles of an Object File Format file of text: OFF, COFF, NOFF, STOFF and their mixtures.

    Raises:
        MeshRejected: binary or not three-dimensional, counts that disagree with the lines, bad numbers or indices.
    """
    lines = [part for line in decode_text(data).split("\n") if (part := line.split("#", 1)[0].strip())]
    start = _OFF_HEADER.match(lines[0]) if lines else None
    if start is None:
        raise MeshRejected("the file does not start with OFF (binary and 4- or n-dimensional files are not read)")
    glued = lines[0][start.end() :].strip()  # the counts may stand on the first line, without a space too
    head, body = (glued, lines[1:]) if glued else (lines[1] if len(lines) > 1 else "", lines[2:])
    try:
        n_vertices, n_faces, *_ = (int(number) for number in whole_numbers(head))
    except ValueError:
        raise MeshRejected(f"the counts must be whole numbers, got {head[:60]!r}") from None
    if n_vertices < 0 or n_faces < 0 or n_vertices + n_faces != len(body):
        raise MeshRejected(f"{n_vertices} vertices and {n_faces} faces are announced, {len(body)} lines follow")
    points = np.array([_numbers(line, i) for i, line in enumerate(body[:n_vertices])]).reshape(-1, 3)
    counts, corners = [], []
    for i, line in enumerate(body[n_vertices:]):
        try:
            words = number_words(line)
            n = int(words[0])
            ring = [int(word) for word in words[1 : n + 1]]
        except ValueError:
            raise MeshRejected(f"face {i}: corners must be whole numbers, got {line[:60]!r}") from None
        if n < 3 or len(ring) != n:
            raise MeshRejected(f"face {i}: {n} corners are announced, {len(ring)} are there")
        if max(ring) > _LARGEST or min(ring) < 0:
            raise MeshRejected(f"face {i}: a corner below 0 or beyond {_LARGEST} in {line[:60]!r}")
        counts.append(n)
        corners += ring
    return triangulate(points, np.array(counts, dtype=np.int64), np.array(corners, dtype=np.int64))


def read_stl(data: bytes) -> Array:
    """Triangles of an STL, binary (84 + 50 n bytes, whatever its header says) or text (whole facets only).

    Lines of text may end anywhere, or nowhere: a solid's name ends with its line, or at the first facet on it.

    Raises:
        MeshRejected: neither, or cut short.
    """
    announced = int.from_bytes(data[80:84], "little") if len(data) >= 84 else -1
    if announced >= 0 and len(data) == 84 + 50 * announced:
        with np.errstate(invalid="ignore"):  # NaN of a kind that signals; whether values are finite is judged later
            return np.frombuffer(data, _STL_FACET, announced, 84)["corners"].astype(np.float64)
    start = data[:512].removeprefix(UTF8_MARK).lstrip()[:5].lower()
    if start == b"solid" or data.startswith(UTF16_MARKS):
        return _read_stl_text(decode_text(data))
    if announced >= 0:
        raise MeshRejected(f"{announced} triangles make {84 + 50 * announced} bytes of binary STL, got {len(data)}")
    raise MeshRejected(f"neither text nor binary STL ({len(data)} bytes)")


def _read_stl_text(text: str) -> Array:
    coordinates = array("d")
    at, facets, inside = 0, 0, frozenset({False})
    try:
        for facet in _FACET.finditer(text):
            inside = _between_facets(text[at : facet.start()], inside, facet_follows=True)
            if True not in inside:
                break
            coordinates.extend(float(word) for word in facet.groups())
            at, facets, inside = facet.end(), facets + 1, frozenset({True})
    except ValueError:
        raise MeshRejected(f"facet {facets}: vertices must be numbers, got {' '.join(facet.groups())[:90]!r}") from None
    if False not in _between_facets(text[at:], inside, facet_follows=False):
        raise MeshRejected(f"text STL of {facets} whole facets that is cut short or broken")
    return np.array(coordinates, dtype=np.float64).reshape(-1, 3, 3)


def _between_facets(text: str, inside: frozenset[bool], *, facet_follows: bool) -> frozenset[bool]:
    """Read the lines between two facets: beginnings and ends of solids, and nothing else.

    Args:
        text: what stands between them.
        inside: whether a solid may be open (True) or closed (False) before it. On one line, ``solid a endsolid b`` is a
            solid of that name, or two statements: what follows decides.
        facet_follows: a facet stands on the last line, so that its words cannot be a solid's name.

    Returns:
        Whether a solid may be open or closed after it; empty where the text is anything else.
    """
    lines = text.split("\n") if text and not text.isspace() else []
    for i, line in enumerate(lines):
        words = line.lower().split()
        if not words:
            continue
        if _VERTEX.search(line) or (facet_follows and i == len(lines) - 1 and _FACET_PART.search(line)):
            return frozenset()  # a broken facet
        after = set()
        if False in inside and words[0].startswith("solid"):
            after |= {True, "endsolid" not in words[1:]}
        if True in inside and words[0].startswith("endsolid"):
            after |= {False, "solid" in words[1:]}
        inside = frozenset(after)
    return inside
