import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from unghost.core.ply import parse_header, read_ply_vertices

XYZ = np.array([[0.5, -1.0, 2.0], [1e-3, 4.0, -7.25], [0.0, 0.0, 0.0]])
FORMATS = {"ascii": {"text": True}, "<": {"byte_order": "<"}, ">": {"byte_order": ">"}}


def written(path, options, *, kind="f8", before=False, faces=False):
    """A file by plyfile, with colours between the coordinates."""
    rows = np.zeros(len(XYZ), np.dtype([("x", kind), ("red", "u1"), ("z", kind), ("y", kind)]))
    for axis, name in enumerate("xyz"):
        rows[name] = XYZ[:, axis]
    rows["red"] = 200
    elements = [PlyElement.describe(rows, "vertex")]
    if before:
        camera = np.array([(1.5, 2)], np.dtype([("focal", "f4"), ("id", "i2")]))
        elements.insert(0, PlyElement.describe(camera, "camera"))
    if faces:
        lists = np.empty(2, np.dtype([("vertex_indices", object)]))
        lists["vertex_indices"] = [np.array([0, 1, 2], "i4"), np.array([2, 1, 0, 1], "i4")]
        elements.append(PlyElement.describe(lists, "face"))
    PlyData(elements, **options).write(path)
    return path


@pytest.mark.parametrize("options", FORMATS.values(), ids=FORMATS)
@pytest.mark.parametrize("kind", ["f4", "f8"])
@pytest.mark.parametrize("more", [{}, {"before": True}, {"faces": True}, {"before": True, "faces": True}])
def test_each_format_gives_the_named_columns(tmp_path, options, kind, more):
    path = written(tmp_path / "points.ply", options, kind=kind, **more)
    np.testing.assert_allclose(read_ply_vertices(path, "x", "y", "z"), XYZ, rtol=1e-7)
    assert read_ply_vertices(path, "red").ravel().tolist() == [200.0] * 3


def test_crlf_and_comments(tmp_path):
    lines = ["ply", "comment end_header is near", "format ascii 1.0", "element vertex 1", "property float x"]
    (tmp_path / "a.ply").write_bytes("\r\n".join([*lines, "end_header", "3", ""]).encode())
    assert read_ply_vertices(tmp_path / "a.ply", "x").tolist() == [[3.0]]


@pytest.mark.parametrize("options", FORMATS.values(), ids=FORMATS)
def test_no_vertices_are_none(tmp_path, options):
    PlyData([PlyElement.describe(np.zeros(0, [("x", "f4")]), "vertex")], **options).write(tmp_path / "a.ply")
    assert read_ply_vertices(tmp_path / "a.ply", "x").shape == (0, 1)


@pytest.mark.parametrize("options", FORMATS.values(), ids=FORMATS)
def test_a_file_that_is_cut_anywhere_is_refused(tmp_path, options):
    data = written(tmp_path / "whole.ply", options).read_bytes()
    body = data.index(b"end_header") + len(b"end_header\n")
    cut = tmp_path / "cut.ply"
    ends = range(body, len(data) - 3) if b"ascii" not in data else range(body, data.rstrip().rindex(b" ") + 1)
    for end in [0, 3, 10, body - 1, *ends]:
        cut.write_bytes(data[:end])
        with pytest.raises(ValueError, match=r"probe: .*cut\.ply is not a PLY file that can be read"):
            read_ply_vertices(cut, "x", caller="probe")
    cut.write_bytes(data + b" 7 7 7 7")
    with pytest.raises(ValueError, match="longer than its header says"):
        read_ply_vertices(cut, "x")


HEAD = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (HEAD.replace("vertex 1", "vertex 99999999999999") + "0\n", "99999999999998 numbers shorter"),
        (HEAD.replace("vertex", "face") + "0\n", "one element vertex, got face"),
        (HEAD.replace("float x", "float u") + "0\n", "lack the properties x"),
        (HEAD.replace("float x", "list uchar int x") + "0\n", "element vertex has a list property"),
        (HEAD.replace("float x", "float x\nproperty float x") + "0 0\n", "a property twice"),
        (HEAD.replace("ascii", "utf8") + "0\n", "line 'format utf8 1.0' .wanted: ascii, binary_little_endian"),
        (HEAD.replace("float x", "quad x") + "0\n", "line 'property quad x'"),
        (HEAD + "1_0\n", "no number"),
        (HEAD + "zero\n", "no number"),
        ("version https://git-lfs.github.com/spec/v1\n", "no PLY header"),
        ("", "no PLY header"),
    ],
)
def test_what_is_wrong_is_said(tmp_path, text, message):
    (tmp_path / "a.ply").write_text(text)
    with pytest.raises(ValueError, match=message):
        read_ply_vertices(tmp_path / "a.ply", "x")


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"probe: no file .*a\.ply"):
        read_ply_vertices(tmp_path / "a.ply", "x", caller="probe")


def test_a_format_that_is_not_accepted_is_refused():
    with pytest.raises(ValueError, match="wanted: binary_big_endian, element"):
        parse_header(HEAD.encode(), formats=("binary_big_endian",))
