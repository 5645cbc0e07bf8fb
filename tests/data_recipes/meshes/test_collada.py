"""COLLADA: the polygons of the scene, where its accessors and its nodes say that they are."""

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest

from unghost.data_recipes.meshes.collada import read_dae, read_zae
from unghost.data_recipes.meshes.files import read_mesh_file
from unghost.data_recipes.meshes.reading import MeshRejected

pytest.importorskip("trimesh")

SHARED = Path(__file__).resolve().parents[3].parent / "shared" / "data"
needs_shared = pytest.mark.skipif(not SHARED.exists(), reason="no data folder beside the project")

ARRAY = "count='12'>0 0 0 1 0 0 0 1 0 1 1 0"
ACCESSOR = "count='4' source='#a' stride='3'"
PARAMS = "".join(f"<param name='{axis}' type='float'/>" for axis in "XYZ")
POLYLIST = "<polylist count='1'><input offset='0' semantic='VERTEX' source='#v'/><vcount>4</vcount><p>0 1 3 2</p>"
SQUARE = np.array([[[0, 0, 0], [1, 0, 0], [1, 1, 0]], [[0, 0, 0], [1, 1, 0], [0, 1, 0]]], dtype=float)
INSTANCE = "<instance_geometry url='#g'/>"


@pytest.fixture
def changed(samples):
    """The square's file with pieces of text replaced."""

    def change(*pairs, **parts):
        text = samples.dae(**parts)
        for old, new in pairs:
            assert text.count(old) == 1, old
            text = text.replace(old, new)
        return text.encode()

    return change


def total_normal(triangles):
    return np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]).sum(axis=0) / 2


def test_the_square(changed):
    np.testing.assert_array_equal(read_dae(changed()), SQUARE)


@pytest.mark.parametrize("first", range(6))
@pytest.mark.parametrize("kind", ["polylist", "polygons"])
def test_concave_polygons_are_cut_inside(changed, area, first, kind):
    """An L of area 3, from each starting corner; fans from four of its six corners cover more."""
    ell = "0 0 0 2 0 0 2 1 0 1 1 0 1 2 0 0 2 0"
    ring = " ".join(str((first + i) % 6) for i in range(6))
    sizes = "<vcount>6</vcount>" if kind == "polylist" else ""
    data = changed((ARRAY, f"count='18'>{ell}"), ("count='4'", "count='6'"), polygons=f"{sizes}<p>{ring}</p>")
    triangles = read_dae(data.replace(b"polylist", kind.encode()))
    assert area(triangles).sum() == pytest.approx(3)
    assert total_normal(triangles) == pytest.approx([0, 0, 3])


@pytest.mark.parametrize(
    ("attributes", "params", "numbers"),
    [
        ("stride='4'", PARAMS, "0 0 0 9 1 0 0 9 0 1 0 9 1 1 0 9"),
        ("stride='4'", PARAMS + "<param type='float'/>", "0 0 0 9 1 0 0 9 0 1 0 9 1 1 0 9"),
        ("stride='4'", "<param type='float'/>" + PARAMS, "9 0 0 0 9 1 0 0 9 0 1 0 9 1 1 0"),
        ("stride='3' offset='2'", PARAMS, "9 9 0 0 0 1 0 0 0 1 0 1 1 0"),
        ("stride='4' offset='1'", PARAMS, "9 0 0 0 9 1 0 0 9 0 1 0 9 1 1 0"),
        ("stride='3'", "<param name='Z'/><param name='X'/><param name='Y'/>", "0 0 0 0 1 0 0 0 1 0 1 1"),
        ("stride='3'", "<param name='a'/><param name='b'/><param name='c'/>", "0 0 0 1 0 0 0 1 0 1 1 0"),
        ("stride='3'", "", "0 0 0 1 0 0 0 1 0 1 1 0"),
    ],
)
def test_accessors_are_followed(changed, attributes, params, numbers):
    array = f"count='{len(numbers.split())}'>{numbers}"
    data = changed((ARRAY, array), ("stride='3'", attributes), (PARAMS, params))
    np.testing.assert_array_equal(read_dae(data), SQUARE)


@pytest.mark.parametrize(
    ("kind", "count", "lists"),
    [
        ("triangles", 2, ["0 1 3 0 3 2"]),
        ("polygons", 2, ["0 1 3", "0 3 2"]),
        ("polygons", 1, ["0 1 3 2"]),
        ("tristrips", 1, ["0 1 2 3"]),
        ("tristrips", 2, ["0 1 2", "1 3 2"]),
        ("trifans", 1, ["0 1 3 2"]),
        ("trifans", 2, ["0 1 3", "3 2 0"]),
    ],
)
@pytest.mark.parametrize("offset", [0, 1])
def test_every_primitive_faces_the_same_way(changed, area, kind, count, lists, offset):
    """With a second input beside the vertices, before or after them, whose indices are not looked at."""
    wide = [" ".join(f"{i} 7" if offset == 0 else f"7 {i}" for i in numbers.split()) for numbers in lists]
    inputs = f"<input offset='{offset}' semantic='VERTEX' source='#v'/><input offset='{1 - offset}' semantic='NORMAL'/>"
    element = f"<{kind} count='{count}'>{inputs}{''.join(f'<p>{numbers}</p>' for numbers in wide)}</{kind}>"
    triangles = read_dae(changed((f"{POLYLIST}</polylist>", element)))
    assert len(triangles) == 2
    assert area(triangles).sum() == pytest.approx(1)
    assert total_normal(triangles) == pytest.approx([0, 0, 1])


def test_a_trifan_is_no_polygon(changed, area):
    """The same corners as a fan of two triangles and as a concave polygon."""
    dart = (ARRAY, "count='12'>0 0 0 3 1 0 1 1 0 1 3 0")
    element = "<trifans count='1'><input offset='0' semantic='VERTEX' source='#v'/><p>1 2 3 0</p></trifans>"
    fan = read_dae(changed(dart, (f"{POLYLIST}</polylist>", element)))
    assert area(fan).sum() == pytest.approx(2 + 4)
    assert area(read_dae(changed(dart, polygons="<vcount>4</vcount><p>1 2 3 0</p>"))).sum() == pytest.approx(2)


@pytest.mark.parametrize(
    ("transforms", "corner"),
    [
        ("<translate>1 2 3</translate>", [2, 2, 3]),
        ("<rotate>0 0 2 90</rotate>", [0, 1, 0]),
        ("<rotate>0 0 0 0</rotate>", [1, 0, 0]),
        ("<translate>1 2 3</translate><rotate>0 0 1 90</rotate>", [1, 3, 3]),
        ("<rotate>0 0 1 90</rotate><translate>1 2 3</translate>", [-2, 2, 3]),
        ("<scale>2 3 4</scale>", [2, 0, 0]),
        ("<matrix>0 0 1 5 1 0 0 6 0 1 0 7 0 0 0 1</matrix>", [5, 7, 7]),
        ("<skew>0 1 0 0 0 1 0</skew>", [1, 0, 0]),
        ("<lookat>5 0 0 0 0 0 0 1 0</lookat>", [5, 0, -1]),  # backwards is +x, up +y, so that right is -z
        ("<lookat>5 0 0 0 0 0 3 4 0</lookat>", [5, 0, -1]),  # what of "up" points backwards does not matter
    ],
)
def test_transforms(changed, transforms, corner):
    """Where the corner (1, 0, 0) goes; the transforms of a node act from the last to the first."""
    triangles = read_dae(changed(nodes=f"<node>{transforms}{INSTANCE}</node>"))
    np.testing.assert_allclose(triangles[0, 1], corner, atol=1e-12)


def test_transforms_of_nested_and_instanced_nodes(changed):
    library = f"<library_nodes><node id='n'><scale>2 2 2</scale>{INSTANCE}</node></library_nodes>"
    nodes = (
        "<node><translate>1 0 0</translate><node><translate>0 1 0</translate><instance_node url='#n'/></node></node>"
    )
    data = changed(("<library_visual_scenes>", library + "<library_visual_scenes>"), nodes=nodes)
    np.testing.assert_allclose(read_dae(data), 2 * SQUARE + [1, 1, 0])


def test_nan_matters_where_a_face_uses_it(changed, written):
    nan = (ARRAY, "count='15'>0 0 0 1 0 0 0 1 0 1 1 0 NaN -INF 0")
    assert len(read_mesh_file(written(changed(nan, ("count='4'", "count='5'")), "dae")).triangles) == 2
    with pytest.raises(MeshRejected, match="coordinates of corners are not finite"):
        read_mesh_file(written(changed((ARRAY, "count='12'>0 0 NaN 1 0 0 0 1 0 1 1 0")), "dae"))


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ("<vertices id='v'>", "<x:other/><vertices id='v'>", "XML that is broken"),
        ("<vertices id='v'>", "<other xmlns='a}b'/><vertices id='v'>", "XML that is broken"),
        ("<p>0 1 3 2<", "<p>0 1 3 -1<", "1 face corners name a vertex"),
        ("<p>0 1 3 2<", "<p>0 1 3 4<", "1 face corners name a vertex"),
        ("count='4'", "count='3'", "1 face corners name a vertex"),
        ("count='4'", "count='5'", "5 items reaches beyond its array of 12"),
        ("stride='3'", "stride='3' offset='1'", "reaches beyond its array"),
        ("stride='3'", "stride='2'", "stride 2 has its coordinates at"),
        (" stride='3'", "", "stride 1 has its coordinates at"),
        ("stride='3'", "stride='3' offset='-3'", "offset of accessor must be a whole number >= 0"),
        ("stride='3'", "stride='3_0'", "malformed|plain numbers"),
        ("<param name='Z' type='float'/>", "", "names 'X Y', not three coordinates"),
        ("count='12'", "count='13'", "announces 13 numbers and has 12"),
        ("0 0 0 1 0 0", "0 0 0 1_0 0 0", "no plain numbers"),
        ("0 0 0 1 0 0", "0 0 0 \uff11 0 0", "no plain numbers"),
        ("0 0 0 1 0 0", "0\u30000 0 1 0 0", "no plain numbers"),
        ("0 0 0 1 0 0", "0 0 0 one 0 0", "malformed"),
        ("<p>0 1 3 2<", "<p>0 1 3 \uff12<", "no plain numbers"),
        ("<p>0 1 3 2<", "<p>0 1 3 0_2<", "no plain numbers"),
        ("<p>0 1 3 2<", "<p>0 1 3 99999999999999999999<", "more than 64 bits"),
        ("<vcount>4<", "<vcount>0_4<", "no plain numbers"),
        ("<vcount>4<", "<vcount>9223372036854775804<", "disagree"),
        ("<polylist count='1'>", "<polylist count='2'>", "disagree"),
        ("<polylist count='1'>", "<polylist>", "count of polylist must be"),
        ("semantic='VERTEX'", "semantic='NORMAL'", "has 0 input VERTEX, not one"),
        ("source='#v'", "source='#w'", "which is no vertices of this file"),
        ("semantic='POSITION' source='#s'", "semantic='POSITION' source='#a'", "which is no source of this file"),
        ("source='#a'", "source='b.dae#a'", "which is no float_array of this file"),
        ("<vertices id='v'>", "<vertices id='v'/><vertices id='v'>", "which 2 of this file's vertices have"),
        (f"<node>{INSTANCE}", f"<node><skew>30 1 0 0 0 1 0</skew>{INSTANCE}", "the skew of node '' is not read"),
        (
            f"<node>{INSTANCE}",
            f"<node id='n'><lookat>1 1 1 1 1 1 0 1 0</lookat>{INSTANCE}",
            "node 'n' has no direction",
        ),
        (f"<node>{INSTANCE}", f"<node><lookat>0 0 0 0 5 0 0 1 0</lookat>{INSTANCE}", "no direction"),
        (f"<node>{INSTANCE}", f"<node><rotate>0 0 0 90</rotate>{INSTANCE}", "no direction"),
        (f"<node>{INSTANCE}", f"<node><rotate>0 0 90</rotate>{INSTANCE}", "must be 4 finite numbers"),
        (f"<node>{INSTANCE}", f"<node><translate>0 0 nan</translate>{INSTANCE}", "must be 3 finite numbers"),
        (f"<node>{INSTANCE}", f"<node><scale>1 0 1</scale>{INSTANCE}", "flattens its mesh"),
        (
            f"<node>{INSTANCE}",
            f"<node><matrix>1 0 0 0 0 1 0 0 0 0 1 0 5 0 0 1</matrix>{INSTANCE}",
            "the matrix of node '' is not affine",
        ),
    ],
)
def test_what_cannot_be_meant_is_rejected(changed, written, old, new, reason):
    with pytest.raises(MeshRejected, match=reason):
        read_mesh_file(written(changed((old, new)), "dae"))


@pytest.mark.parametrize("kind", ["polygons", "tristrips", "trifans"])
def test_lists_that_are_not_announced_are_rejected(changed, kind):
    for count, numbers in ((2, "0 1 3 2"), (1, "0 1")):
        element = f"<{kind} count='{count}'><input offset='0' semantic='VERTEX' source='#v'/><p>{numbers}</p></{kind}>"
        with pytest.raises(MeshRejected, match=f"{count} {kind} are announced, 1 are there, or one has fewer"):
            read_dae(changed((f"{POLYLIST}</polylist>", element)))


def test_what_the_scene_does_not_show_does_not_matter(changed):
    """A second geometry that is broken, and doubles of every identifier where only one program looks."""
    broken = "<geometry id='h'><mesh><polylist count='x'/></mesh></geometry>"
    extra = "<extra><technique profile='P'><geometry id='g'/><node id='n'/></technique></extra>"
    data = changed(("</geometry>", f"</geometry>{broken}{extra}"))
    np.testing.assert_array_equal(read_dae(data), SQUARE)


def test_instances_in_bulk_are_refused(changed, monkeypatch):
    monkeypatch.setattr("unghost.data_recipes.meshes.collada.MOST_TRIANGLES", 5)
    assert len(read_dae(changed(nodes=f"<node>{INSTANCE * 2}</node>"))) == 4
    with pytest.raises(MeshRejected, match="more than 5 triangles"):
        read_dae(changed(nodes=f"<node>{INSTANCE * 3}</node>"))


def zipped(**members):
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, content in members.items():
            archive.writestr(name.replace("__", "/").replace("_", "."), content)
    return stream.getvalue()


def test_zipped_collada(changed, written, area):
    """The only document, or the one that the manifest names; its polygons are cut as in an unzipped file."""
    dart = changed((ARRAY, "count='12'>0 0 0 3 1 0 1 1 0 1 3 0"), polygons="<vcount>4</vcount><p>1 2 3 0</p>")
    read = read_mesh_file(written(zipped(sub__a_dae=dart), "zae"))
    assert area(read.triangles * read.extent).sum() == pytest.approx(2)
    manifest = "<dae_root>./sub/b.dae#scene</dae_root>"
    np.testing.assert_array_equal(read_zae(zipped(a_dae=dart, sub__b_dae=changed(), manifest_xml=manifest)), SQUARE)
    for members, count in (
        ({"a_dae": dart, "b_dae": dart}, 2),
        ({"a_dae": dart, "manifest_xml": manifest}, 0),
        ({"a_txt": ""}, 0),
    ):
        with pytest.raises(MeshRejected, match=f"names {count} COLLADA documents, not one"):
            read_zae(zipped(**members))


@needs_shared
@pytest.mark.shared_data
@pytest.mark.parametrize(
    ("path", "newell", "faces"),
    [
        ("hostile/assimp/Collada/ConcavePolygon.dae", 0.2454966872, 64),
        ("meshes/gazebo_models/arm_part/arm.dae", 428659.7921254, 392),
    ],
)
def test_concave_polygons_of_real_files(area, path, newell, faces):
    """One polygon of 66 corners, and four concave octagons among others: the sum of their areas after Newell."""
    triangles = read_dae((SHARED / path).read_bytes())
    assert len(triangles) == faces
    assert area(triangles).sum() == pytest.approx(newell, rel=1e-9)
