"""OBJ, OFF and text STL: lawful files of odd shapes, and numbers that only Python reads."""

import numpy as np
import pytest

from unghost.data_recipes.meshes.files import read_mesh_file
from unghost.data_recipes.meshes.reading import MeshEmpty, MeshRejected
from unghost.data_recipes.meshes.text import read_obj, read_off, read_stl

pytest.importorskip("trimesh")

TRIANGLE = [[[0, 0, 0], [1, 0, 0], [0, 1, 0]]]
OFF_BODY = "0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"


def facet(x, *, normal="0 0 1"):
    """A facet whose corners have the number x."""
    return f"facet normal {normal}\nouter loop\nvertex {x} 0 0\nvertex {x} 1 0\nvertex {x} 0 1\nendloop\nendfacet\n"


def corners(*numbers):
    return [[[x, 0, 0], [x, 1, 0], [x, 0, 1]] for x in numbers]


@pytest.mark.parametrize(
    "change",
    [
        lambda text: text,
        lambda text: text.replace("\n", "\r"),
        lambda text: text.replace("\n", "\r\n"),
        lambda text: text.replace("\n", "\n\n   "),
        lambda text: text.replace("\n", " "),
        lambda text: text.replace("\n", "\t").strip(),
        lambda text: "  \n" + text.upper(),
        lambda text: text.replace("vertex", "\n vertex \n"),
        lambda text: b"\xef\xbb\xbf" + text.encode(),
        lambda text: text.encode("utf-16"),
    ],
)
@pytest.mark.parametrize(
    "text",
    [
        "solid a\n" + facet(1) + facet(-2.5e-1) + "endsolid a\n",
        "solid\n" + facet(1, normal="nan nan -nan(ind)") + facet("-.25") + "endsolid\n",
        "solid a\n" + facet("+1.") + "endsolid a\nsolid b\n" + facet("-25E-2") + "endsolid b\n",
        "solid a\n" + facet(1) + "endsolid\nsolid b\nendsolid b\nsolid\n" + facet(-0.25) + "endsolid c\n",
    ],
)
def test_text_stl_of_any_line_ends(text, change):
    """Old line ends, everything on one line, several solids, numbers in every notation."""
    changed = change(text)
    np.testing.assert_array_equal(
        read_stl(changed if isinstance(changed, bytes) else changed.encode()), corners(1, -0.25)
    )


@pytest.mark.parametrize(
    "name",
    [
        "facet",
        "a facet normal",
        "endfacet",
        "endsolid",
        "my endsolid of it",
        "solid solid",
        "vertex of a loop",
        "outer loop",
        "endloop endfacet facet endsolid",
        "caf\u00e9",
        "facet normal 0 0 1",
    ],
)
@pytest.mark.parametrize("end", ["\n", "\r", "\r\n"])
def test_the_name_of_a_solid_may_hold_any_word(name, end):
    text = f"solid {name}\n{facet(1)}{facet(2)}endsolid {name}\nsolid {name}\nendsolid {name}\n"
    np.testing.assert_array_equal(read_stl(text.replace("\n", end).encode()), corners(1, 2))


def test_the_name_of_a_solid_on_one_line():
    text = "solid facet of loop " + (facet(1) + "endsolid of solid b solid c " + facet(2) + "endsolid c").replace(
        "\n", " "
    )
    np.testing.assert_array_equal(read_stl(text.encode()), corners(1, 2))


def test_empty_solids(written):
    for text in ("solid\nendsolid\n", "solid a endsolid a", "solid endsolid\nendsolid\n", "SOLID a\r\rENDSOLID a"):
        with pytest.raises(MeshEmpty):
            read_mesh_file(written(text, "stl"))


@pytest.mark.parametrize(
    "text",
    [
        "solid a\n" + facet(1),
        "solid a\nendsolid a\n" + facet(1),
        "solid a\n" + facet(1) + "endsolid a\n" + facet(2) + "endsolid a\n",
        "solid a\n" + facet(1) + "solid b\n" + facet(2) + "endsolid b\n",
        "solid a\n" + facet(1) + "endsolid a\nmore\n",
        "solid a\n" + facet(1) + "more\n" + facet(2) + "endsolid a\n",
        "solid a\n" + facet(1)[:-10] + "\n" + facet(2) + "endsolid a\n",
        "solid a\n" + facet(1) + facet(2)[20:] + "endsolid a\n",
        "solid a\n" + facet(1).replace("vertex 1 1 0\n", "") + facet(2) + "endsolid a\n",
        ("solid a\n" + facet(1).replace("vertex 1 1 0\n", "") + facet(2) + "endsolid a\n").replace("\n", " "),
        ("solid a\n" + facet(1)[:60] + facet(2) + "endsolid a\n").replace("\n", " "),
        "solid a\n" + facet(1).replace("endloop", "vertex 1 1 1\nendloop") + facet(2) + "endsolid a\n",
        "solid a\n" + facet("1_0") + "endsolid a\n",
        "solid a\n" + facet("\uff11") + "endsolid a\n",
        "solid a\n" + facet("1,5") + "endsolid a\n",
        "solid a\n" + facet("0x1p3") + "endsolid a\n",
        "solid a\n" + facet("one") + "endsolid a\n",
    ],
)
def test_broken_text_stl_is_rejected(text):
    with pytest.raises(MeshRejected, match=r"text STL of . whole facets that is cut short|vertices must be numbers"):
        read_stl(text.encode())


def test_no_number_in_a_facet_matters_where_it_is_drawn(written):
    with pytest.raises(MeshRejected, match="coordinates of corners are not finite"):
        read_mesh_file(written("solid a\n" + facet("nan") + facet(1) + "endsolid a\n", "stl"))


@pytest.mark.parametrize(
    "head",
    ["OFF\n3 1 0\n", "OFF3 1 0\n", "OFF 3 1 0\n", "OFF\t3 1\n", "COFF3 1 3\n", "STCNOFF 3 1 0\n", "OFF # a\n3 1 0\n"],
)
def test_off_counts_on_the_first_line(head):
    np.testing.assert_array_equal(read_off((head + OFF_BODY).encode()), TRIANGLE)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("OFFSET 3 1 0\n" + OFF_BODY, "does not start with OFF"),
        ("OFF_3 1 0\n" + OFF_BODY, "does not start with OFF"),
        ("OFF-3 1 0\n" + OFF_BODY, "does not start with OFF"),
        ("OFF\uff13 1 0\n" + OFF_BODY, "does not start with OFF"),
        ("OFF3.0 1 0\n" + OFF_BODY, "counts must be whole"),
        ("OFF 0_3 1 0\n" + OFF_BODY, "counts must be whole"),
        ("OFF 3\n" + OFF_BODY, "counts must be whole"),
        ("OFF\n\uff13 1 0\n" + OFF_BODY, "counts must be whole"),
        ("OFF\n3 1 0\n" + OFF_BODY.replace("1 0 0", "0_1 0 0"), "line 1: a vertex needs three numbers"),
        ("OFF\n3 1 0\n" + OFF_BODY.replace("1 0 0", "\u0661 0 0"), "line 1: a vertex needs three numbers"),
        ("OFF\n3 1 0\n" + OFF_BODY.replace("3 0 1 2", "3 0 1 0_2"), "face 0: corners must be whole"),
        ("OFF\n3 1 0\n" + OFF_BODY.replace("3 0 1 2", "3 0 1 \uff12"), "face 0: corners must be whole"),
        ("OFF\n3 1 0\n" + OFF_BODY.replace("3 0 1 2", "\uff13 0 1 2"), "face 0: corners must be whole"),
        ("OFF\n3 1 0\n" + OFF_BODY.replace("3 0 1 2", "3 0 1 99999999999999999999"), "a corner below 0 or beyond"),
    ],
)
def test_off_with_numbers_that_are_none_is_rejected(text, reason):
    with pytest.raises(MeshRejected, match=reason):
        read_off(text.encode())


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ("f 1 2 3 4", "f 1 2 0_3 4", "line 5: face indices must be whole numbers"),
        ("f 1 2 3 4", "f 1 2 \uff13 4", "line 5: face indices must be whole numbers"),
        ("f 1 2 3 4", "f 1 2 \u0663/1 4", "line 5: face indices must be whole numbers"),
        ("f 1 2 3 4", "f 1\u00a02\u30003 4", "line 5: face indices must be whole numbers"),
        ("f 1 2 3 4", "f 1 2 3 99999999999999999999", "line 5: a face index beyond"),
        ("v 2 0 0", "v 0_2 0 0", "line 2: a vertex needs three numbers"),
        ("v 2 0 0", "v \uff12 0 0", "line 2: a vertex needs three numbers"),
        ("v 2 0 0", "v 2\u00a00 0", "line 2: a vertex needs three numbers"),
        ("v 2 0 0", "v 2\x1f0 0", "line 2: a vertex needs three numbers"),
    ],
)
def test_obj_with_numbers_that_are_none_is_rejected(samples, old, new, reason):
    assert samples.square_obj.count(old) == 1
    with pytest.raises(MeshRejected, match=reason):
        read_obj(samples.square_obj.replace(old, new).encode())


def test_obj_comments_and_names_of_any_script(samples, area):
    text = "# \uff11_0\ng a_\u0661\n" + samples.square_obj.replace("v 2 0 0", "v 2 0 0 # \uff12_0")
    assert area(read_obj(text.encode())).sum() == pytest.approx(4)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["darts", "spirals"])
def test_concave_polygons_in_bulk_are_cut_exactly(kind, area):
    """100,000 concave quads, and 1,000 spirals of 100 corners (a second or two; some twenty with ear clipping)."""
    if kind == "darts":
        ring, count = np.array([[0, 0, 0], [2, 1, 0], [0, 2, 0], [0.5, 1, 0]]), 100_000
    else:
        angles = np.linspace(0, 6 * np.pi, 50)
        circle = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
        inner = (1 + angles / (2 * np.pi))[:, None]
        ring, count = np.concatenate([inner * circle, ((inner + 0.5) * circle)[::-1]]), 1000
    expected = np.linalg.norm(np.cross(ring, np.roll(ring, -1, axis=0)).sum(axis=0)) / 2
    n = len(ring)
    lines = [f"v {x!r} {y!r} {z}" for z in range(count) for x, y, _ in ring.tolist()]
    lines += ["f " + " ".join(map(str, range(n * i + 1, n * i + n + 1))) for i in range(count)]
    data = "\n".join(lines).encode()
    triangles = read_obj(data)
    assert len(triangles) == count * (n - 2)
    assert area(triangles).sum() == pytest.approx(count * expected)
