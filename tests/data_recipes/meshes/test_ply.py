"""PLY: headers of every lawful shape, and triangle strips."""

import numpy as np
import pytest

from unghost.data_recipes.meshes.files import read_mesh_file
from unghost.data_recipes.meshes.ply import read_ply
from unghost.data_recipes.meshes.reading import MeshRejected

pytest.importorskip("trimesh")

TRIANGLE = [[[0, 0, 0], [1, 0, 0], [0, 1, 0]]]
POINTS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0, 2, 0]], dtype="<f4")
VERTEX = "element vertex 5\nproperty float x\nproperty float y\nproperty float z\n"
STRIPS = "element tristrips 1\nproperty list int int vertex_indices\n"


@pytest.mark.parametrize("binary", [False, True])
@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"element vertex", "comment caf\u00e9 \u0085 \u2028\nelement vertex".encode()),
        (b"element vertex", b"comment \x85\nobj_info \x85 \x0b x\nelement vertex"),
        (b"element vertex", "comment \u0445\u0430\u0445\u0430\u0440\nelement vertex".encode()),  # its bytes hold 0x85
        (b"element vertex", b"comment the end_header comes later\nelement vertex"),
        (b"element vertex", b"comment end_header\nelement vertex"),
        (b"element vertex", b"obj_info end_header \nelement vertex"),
        (b"end_header\n", b"end_header \n"),
        (b"end_header\n", b"end_header \t \r\n"),
        (b"end_header\n", b"comment end_header\nend_header \n"),
        (b"ply\n", b"ply \n"),
        (b"property float x\n", b"  property\tfloat  x \r\n"),
    ],
)
def test_lawful_headers(samples, binary, old, new):
    data = samples.valid["binary ply" if binary else "ply"][1]
    assert data.count(old) == 1
    np.testing.assert_array_equal(read_ply(data.replace(old, new)), TRIANGLE)


@pytest.mark.parametrize("end", [b"\n", b"\r\n", b"\r"])
@pytest.mark.parametrize("first", [0, 10, 13])
def test_line_ends_and_a_body_that_begins_like_one(end, first):
    """The header ends with its last line's end: the byte after it may be LF or CR, and is the body's."""
    header = (
        b"ply\nformat binary_little_endian 1.0\ncomment end_header of it\nelement vertex 3\nproperty uchar x\n"
        b"property uchar y\nproperty uchar z\nelement face 1\nproperty list uchar uchar vertex_index\nend_header\n"
    )
    body = bytes([first, 0, 0, 20, 0, 0, 0, 20, 0, 3, 0, 1, 2])
    triangles = read_ply(header.replace(b"\n", end) + body)
    np.testing.assert_array_equal(triangles, [[[first, 0, 0], [20, 0, 0], [0, 20, 0]]])


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        (b"end_header\n", b"end_header of it\n", "does not end with a line end_header"),
        (b"end_header\n", b"\n", "does not end with a line end_header"),
        (b"ply\n", b"plys\n", "no PLY header"),
        (b"element vertex 3", b"element vertex 0_3", "PLY header line"),
        (b"element vertex 3", "element vertex \uff13".encode(), "PLY header line"),
        (b"element vertex 3", b"element vertex " + b"9" * 5000, "PLY header line"),
        (b"0 0 0\n1", b"0 0 0\n0_1", "no number"),
        (b"0 0 0\n1", "0 0 0\n\uff11".encode(), "no number"),
        (b"3 0 1 2\n", b"3 0 1 1e300\n", "not whole numbers up to"),
        (b"3 0 1 2\n", b"3 0 1 nan\n", "not whole numbers up to"),
        (b"property float x", b"property list uchar float x", "."),
    ],
)
def test_what_cannot_be_meant_is_rejected(samples, written, old, new, reason):
    data = samples.valid["ply"][1]
    assert data.count(old) == 1
    with pytest.raises(MeshRejected, match=reason):
        read_mesh_file(written(data.replace(old, new), "ply"))


def test_a_header_of_too_many_lines_is_rejected():
    with pytest.raises(MeshRejected, match="a PLY header of more than 100000 lines"):
        read_ply(b"ply\n" + b"\n" * 100_001)


def test_a_coordinate_that_is_a_list_is_rejected():
    header = (
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty list uchar float x\nproperty float y\nproperty float z\n"
    )
    face = "element face 1\nproperty list uchar int vertex_index\nend_header\n"
    with pytest.raises(MeshRejected, match="without vertices x, y, z"):
        read_ply((header + face + "2 0 0 0 0\n2 1 1 0 0\n2 0 0 1 0\n3 0 1 2\n").encode())


def strips(*lists, faces=(), binary=False):
    """A PLY of five points with strips of triangles, and perhaps with faces before them."""
    face = f"element face {len(faces)}\nproperty list uchar int vertex_indices\n" if faces else ""
    strip = STRIPS.replace("tristrips 1", f"tristrips {len(lists)}")
    header = f"ply\nformat {'binary_little_endian' if binary else 'ascii'} 1.0\n{VERTEX}{face}{strip}end_header\n"
    if not binary:
        rows = [*POINTS.astype(int).tolist(), *([len(f), *f] for f in faces), *([len(s), *s] for s in lists)]
        return (header + "\n".join(" ".join(map(str, row)) for row in rows) + "\n").encode()
    body = POINTS.tobytes() + b"".join(bytes([len(f)]) + np.array(f, "<i4").tobytes() for f in faces)
    return header.encode() + body + b"".join(np.array([len(s), *s], "<i4").tobytes() for s in lists)


@pytest.mark.parametrize("binary", [False, True])
@pytest.mark.parametrize(
    ("lists", "expected"),
    [
        ([[0, 1, 2]], [[0, 1, 2]]),
        ([[0, 1, 2, 3]], [[0, 1, 2], [1, 3, 2]]),
        ([[0, 1, 2, 3, 4]], [[0, 1, 2], [1, 3, 2], [2, 3, 4]]),
        ([[0, 1, 2, 3, -1, 2, 3, 4]], [[0, 1, 2], [1, 3, 2], [2, 3, 4]]),
        ([[0, 1, 2, -1, 1, 3, 2, 4, -1]], [[0, 1, 2], [1, 3, 2], [3, 4, 2]]),
        ([[0, 1, 2], [1, 3, 2, 4]], [[0, 1, 2], [1, 3, 2], [3, 4, 2]]),
        ([[-1, 0, 1, 2, -1, -1], [2, 3, 4]], [[0, 1, 2], [2, 3, 4]]),
    ],
)
def test_triangle_strips(binary, lists, expected):
    """Every second triangle is turned round; -1 begins a strip anew, and its turns."""
    np.testing.assert_array_equal(read_ply(strips(*lists, binary=binary)), POINTS[np.array(expected)])


@pytest.mark.parametrize("binary", [False, True])
def test_triangle_strips_beside_faces(binary, area):
    triangles = read_ply(strips([2, 3, 4], faces=[[0, 1, 3, 2]], binary=binary))
    np.testing.assert_array_equal(triangles, POINTS[np.array([[0, 1, 3], [0, 3, 2], [2, 3, 4]])])


def test_broken_triangle_strips_are_rejected():
    for lists, reason in (
        ([[0, 1]], "a strip of 2 corners"),
        ([[0, 1, 2, -1, 3]], "a strip of 1 corners"),
        ([[0, 1, 2, 5]], "1 face corners name a vertex"),
        ([[0, 1, 2, -2]], "1 face corners name a vertex"),
    ):
        with pytest.raises(MeshRejected, match=reason):
            read_ply(strips(*lists))
    with pytest.raises(MeshRejected, match="1 values longer"):
        read_ply(strips([0, 1, 2]) + b"7\n")
    with pytest.raises(MeshRejected, match="triangle strips without a list of vertex indices"):
        read_ply(strips([0, 1, 2]).replace(b"vertex_indices", b"others"))
