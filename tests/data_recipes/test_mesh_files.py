import base64
import csv
import io
import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from unghost.data_recipes import mesh_files
from unghost.data_recipes.mesh_collada import check_xml
from unghost.data_recipes.mesh_files import load_mesh, normalise, read_mesh_file
from unghost.data_recipes.mesh_reading import MeshEmpty, MeshRejected, triangulate

trimesh = pytest.importorskip("trimesh")

SHARED = Path(__file__).resolve().parents[2].parent / "shared" / "data"
needs_shared = pytest.mark.skipif(not SHARED.exists(), reason="no data folder beside the project")

SQUARE_OBJ = "v 0 0 0\nv 2 0 0\nv 2 2 0\nv 0 2 0\nf 1 2 3 4\n"
TRIANGLE_PLY = (
    "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
)
FACET = "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n"
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], dtype="<f4")
STRIP = np.array([0, 1, 2, 3], dtype="<u2")


def area(triangles):
    return np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1) / 2


def gltf(**changes):
    """A unit square in two triangles (a strip) as a glTF tree; ``changes`` replace its parts."""
    data = CORNERS.tobytes() + STRIP.tobytes()
    tree = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "mode": 5}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
            {"bufferView": 0, "byteOffset": 48, "componentType": 5123, "count": 4, "type": "SCALAR"},
        ],
        "bufferViews": [{"buffer": 0, "byteLength": len(data)}],
        "buffers": [{"byteLength": len(data), "uri": "data:;base64," + base64.b64encode(data).decode()}],
    }  # fmt: skip
    return {**tree, **changes}


def accessor(**changes):
    return [{**gltf()["accessors"][0], **changes}, gltf()["accessors"][1]]


def dae(nodes="<node><instance_geometry url='#g'/></node>", before="", polygons="<vcount>4</vcount><p>0 1 3 2</p>"):
    return (
        f"<?xml version='1.0'?>{before}<COLLADA xmlns='http://www.collada.org/2005/11/COLLADASchema' version='1.4.1'>"
        "<library_geometries><geometry id='g'><mesh><source id='s'><float_array id='a' count='12'>"
        "0 0 0 1 0 0 0 1 0 1 1 0</float_array><technique_common><accessor count='4' source='#a' stride='3'>"
        "<param name='X' type='float'/><param name='Y' type='float'/><param name='Z' type='float'/></accessor>"
        "</technique_common></source><vertices id='v'><input semantic='POSITION' source='#s'/></vertices>"
        f"<polylist count='1'><input offset='0' semantic='VERTEX' source='#v'/>{polygons}</polylist></mesh></geometry>"
        f"</library_geometries><library_visual_scenes><visual_scene id='vs'>{nodes}</visual_scene>"
        "</library_visual_scenes><scene><instance_visual_scene url='#vs'/></scene></COLLADA>"
    )


@pytest.fixture
def written(tmp_path):
    def write(content, suffix):
        path = tmp_path / f"mesh.{suffix}"
        if isinstance(content, dict):
            content = json.dumps(content)
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return write


@pytest.mark.parametrize("suffix", ["obj", "off", "ply", "stl", "glb"])
def test_agrees_with_trimesh_on_sound_files(tmp_path, suffix):
    """Two bodies, moved: the same triangles as trimesh has, at unit size."""
    body = trimesh.util.concatenate(
        [
            trimesh.creation.icosphere(subdivisions=2),
            trimesh.creation.box(extents=(1, 2, 7)).apply_translation([9, 0, 0]),
        ]
    )
    body.export(tmp_path / f"body.{suffix}")
    read = read_mesh_file(tmp_path / f"body.{suffix}")
    assert read.extent == pytest.approx(10.5, rel=1e-6)  # from -1 to 9.5 along x
    np.testing.assert_allclose(read.center, [4.25, 0, 0], atol=1e-6)
    np.testing.assert_allclose(read.triangles * read.extent + read.center, body.triangles, atol=1e-5)
    assert np.ptp(read.triangles.reshape(-1, 3), axis=0) == pytest.approx([1, 2 / 10.5, 7 / 10.5], rel=1e-6)
    assert read.dropped == 0


@pytest.mark.parametrize("ascii_", [True, False])
def test_text_and_binary_ply_and_stl(tmp_path, ascii_):
    ball = trimesh.creation.icosphere(subdivisions=1)
    (tmp_path / "a.ply").write_bytes(trimesh.exchange.ply.export_ply(ball, encoding="ascii" if ascii_ else "binary"))
    ball.export(tmp_path / "a.stl", file_type="stl_ascii" if ascii_ else "stl")
    for name in ("a.ply", "a.stl"):
        read = read_mesh_file(tmp_path / name)
        np.testing.assert_allclose(read.triangles * read.extent + read.center, ball.triangles, atol=1e-6)


def test_the_hash_is_of_the_bytes_and_side_files_have_their_own(tmp_path):
    import hashlib

    tree = gltf(buffers=[{"byteLength": 56, "uri": "the%20data.bin"}])
    data = CORNERS.tobytes() + STRIP.tobytes()
    (tmp_path / "the data.bin").write_bytes(data)
    (tmp_path / "a.gltf").write_text(json.dumps(tree))
    read = read_mesh_file(tmp_path / "a.gltf")
    assert read.sha256 == hashlib.sha256((tmp_path / "a.gltf").read_bytes()).hexdigest()
    assert read.side_files == (("the%20data.bin", hashlib.sha256(data).hexdigest()),)
    assert len(read.triangles) == 2


def test_node_transforms_are_applied(written):
    """Two squares, one moved by 3: 4 long. Scale 2 of the parent makes no difference after normalising."""
    nodes = [{"children": [1, 2], "scale": [2, 2, 2]}, {"mesh": 0}, {"mesh": 0, "translation": [3, 0, 0]}]
    read = read_mesh_file(written(gltf(nodes=nodes), "gltf"))
    assert read.extent == pytest.approx(8)
    assert len(read.triangles) == 4
    assert np.ptp(read.triangles.reshape(-1, 3), axis=0) == pytest.approx([1, 0.25, 0])


@pytest.mark.parametrize("order", ["little", "big"])
def test_binary_ply_of_mixed_polygons(written, order):
    """A square and a triangle whose lists are 4, 3 long: a reader that takes the first length for all misreads it."""
    mark = "<" if order == "little" else ">"
    header = (
        f"ply\nformat binary_{order}_endian 1.0\nelement vertex 5\nproperty double x\nproperty double y\n"
        "property double z\nelement face 3\nproperty list uchar int vertex_indices\nproperty uchar red\nend_header\n"
    )
    points = np.array([[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0], [4, 0, 0]], dtype=mark + "f8")
    rows = [([0, 1, 2, 3], 9), ([1, 4, 2], 8), ([1, 2, 4], 7)]
    body = b"".join(bytes([len(r)]) + np.array(r, dtype=mark + "i4").tobytes() + bytes([red]) for r, red in rows)
    read = read_mesh_file(written(header.encode() + points.tobytes() + body, "ply"))
    assert len(read.triangles) == 4
    assert area(read.triangles * read.extent).sum() == pytest.approx(4 + 2 + 2)


def test_concave_polygons_are_cut_inside():
    """An L of area 3, from each starting corner; fans from four of its six corners would cover more."""
    ell = np.array([[0, 0, 0], [2, 0, 0], [2, 1, 0], [1, 1, 0], [1, 2, 0], [0, 2, 0]], dtype=float)
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    for first in range(6):
        for ring in (ell, ell[::-1]):
            ring = np.roll(ring, first, axis=0) @ turn.T + 5
            pieces = triangulate(ring, np.array([6]), np.arange(6))
            assert pieces.shape == (4, 3, 3)
            assert area(pieces).sum() == pytest.approx(3)


@given(st.integers(0, 2**32 - 1), st.integers(4, 24))
@settings(max_examples=30, deadline=None)
def test_star_shaped_polygons_keep_their_area(seed, n):
    rng = np.random.default_rng(seed)
    angles = (np.arange(n) + rng.uniform(0, 0.9, n)) * 2 * np.pi / n
    radii = rng.uniform(0.2, 1, n)
    x, y = radii * np.cos(angles), radii * np.sin(angles)
    exact = np.abs(x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2  # the centre sees every edge ...
    if np.diff(np.append(angles, angles[0] + 2 * np.pi)).max() < np.pi:  # ... unless an edge passes behind it
        pieces = triangulate(np.stack([x, y, 0 * x], axis=1), np.array([n]), np.arange(n))
        assert area(pieces).sum() == pytest.approx(exact)


def test_far_from_the_origin_in_double_precision(written):
    read = read_mesh_file(written(SQUARE_OBJ.replace("v 0", "v 100000000").replace("v 2", "v 100000002"), "obj"))
    assert read.extent == 2
    assert read.center.tolist() == [100000001, 1, 0]


def test_single_precision_that_cannot_tell_corners_apart_is_refused():
    near = np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0]]], dtype=np.float32)
    normalise(near + np.float32(1000))  # 2**-14 apart
    with pytest.raises(MeshRejected, match="single precision has 16 steps"):
        normalise(near + np.float32(1e6))  # steps of 1/16


def test_normalise_by_hand():
    soup = np.array([[[1, 1, 1], [5, 1, 1], [1, 3, 1]], [[1, 1, 1], [3, 1, 1], [5, 1, 1]]], dtype=float)
    kept = soup.copy()
    triangles, center, extent, dropped = normalise(soup)
    assert (extent, dropped) == (4, 1)
    assert center.tolist() == [3, 2, 1]
    assert triangles.tolist() == [[[-0.5, -0.25, 0], [0.5, -0.25, 0], [-0.5, 0.25, 0]]]
    np.testing.assert_array_equal(soup, kept)


REJECTED = [
    ("obj", SQUARE_OBJ + "f 0 1 2\n", "face index 0"),
    ("obj", SQUARE_OBJ + "f 1 2 5\n", "1 face corners name a vertex"),
    ("obj", SQUARE_OBJ + "f -5 1 2\n", "before the first vertex"),
    ("obj", SQUARE_OBJ + "f 1 2\n", "needs three corners"),
    ("obj", SQUARE_OBJ + "f 1.5 2 3\n", "whole numbers"),
    ("obj", "v 0 0\n" + SQUARE_OBJ, "line 1: a vertex needs three numbers"),
    ("obj", SQUARE_OBJ.replace("v 2 2 0", "v nan 2 0"), "2 coordinates of corners are not finite"),
    ("obj", SQUARE_OBJ.replace("v 2 2 0", "v 1e999 2 0"), "not finite"),
    ("obj", SQUARE_OBJ + "surf 0 1 0 1\n", "free-form"),
    ("obj", SQUARE_OBJ + "nonsense\n", "line 6: 'nonsense' is no OBJ statement"),
    ("obj", SQUARE_OBJ + "\0", "NUL"),
    ("obj", "\n \n", "no OBJ statement"),
    ("obj", "v 1 2 3\n" * 3 + "f 1 2 3\n", "the longest side is 0.0"),
    ("obj", "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "none of the 1 triangles has an area"),
    ("obj", "version https://git-lfs.github.com/spec/v1\noid sha256:0\n", "git-lfs pointer"),
    ("obj", "", "no bytes"),
    ("off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n", "3 vertices and 1 faces are announced, 3 lines follow"),
    ("off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 3\n", "name a vertex"),
    ("off", "OFF BINARY\n3 1 0\n", "counts must be whole"),
    ("off", "4OFF\n3 1 0\n", "does not start with OFF"),
    ("ply", TRIANGLE_PLY.replace("vertex 3", "vertex 2000000000"), "announces at least 6000000001"),
    ("ply", TRIANGLE_PLY.replace("3 0 1 2\n", "3 0 1\n"), "ends early"),
    ("ply", TRIANGLE_PLY + "7\n", "1 values longer"),
    ("ply", TRIANGLE_PLY.replace("3 0 1 2", "3 0 1 -1"), "name a vertex"),
    ("ply", TRIANGLE_PLY.replace("3 0 1 2", "3 0 1 1.5"), "not whole"),
    ("ply", TRIANGLE_PLY.replace("3 0 1 2", "-3 0 1 2"), "a PLY list of length -3"),
    ("ply", TRIANGLE_PLY.replace("float x", "float w"), "without vertices x, y, z"),
    ("ply", TRIANGLE_PLY.replace("vertex_indices", "others"), "without a list of vertex indices"),
    ("ply", TRIANGLE_PLY.replace("float y", "float128 y"), "PLY header line 'property float128 y'"),
    ("ply", TRIANGLE_PLY.replace("element", "elemental"), "PLY header line"),
    ("stl", b"\0" * 80 + (2).to_bytes(4, "little") + b"\0" * 50, "184 bytes of binary STL, got 134"),
    ("stl", "solid a\n" + FACET, "1 whole facets that is cut short"),
    ("stl", "solid a\n" + FACET + FACET[:60] + "endsolid a\n", "cut short"),
    ("stl", b"\1" * 83, "neither text nor binary"),
    ("gltf", gltf(nodes=[{"mesh": 0, "scale": [1, 0, 1]}]), "flattens its mesh"),
    ("gltf", gltf(nodes=[{"mesh": 0, "scale": [0, 0, 0]}]), "flattens its mesh"),
    ("gltf", gltf(nodes=[{"mesh": 0, "children": [0]}]), "reached twice"),
    ("gltf", gltf(nodes=[{"mesh": 0, "matrix": [1] * 15}]), "16 finite numbers"),
    ("gltf", gltf(nodes=[{"mesh": 0, "rotation": [0, 0, 0, 2]}]), "no unit quaternion"),
    ("gltf", gltf(nodes=[{"mesh": 1}]), "mesh must be a whole number below 1"),
    ("gltf", gltf(extensionsRequired=["KHR_draco_mesh_compression"]), "KHR_draco_mesh_compression is not read"),
    ("gltf", gltf(meshes=[{"primitives": [{"attributes": {"POSITION": 0}, "mode": 4,
                                           "extensions": {"KHR_draco_mesh_compression": {}}}]}]), "compressed with"),
    ("gltf", gltf(meshes=[{"primitives": [{"attributes": {"POSITION": 0}, "mode": 6}]}]), "fans are not read"),
    ("gltf", gltf(meshes=[{"primitives": [{"attributes": {"POSITION": 0}}]}]), "4 corners do not make triangles"),
    ("gltf", gltf(accessors=accessor(sparse={})), "sparse"),
    ("gltf", gltf(accessors=accessor(count=5)), "beyond its buffer view"),
    ("gltf", gltf(accessors=accessor(componentType=5122)), "is VEC3 of 5122"),
    ("gltf", gltf(accessors=accessor(componentType=5122, normalized=True), extensionsUsed=["KHR_mesh_quantization"]),
     "normalised whole numbers"),
    ("gltf", gltf(accessors=[{k: v for k, v in accessor()[0].items() if k != "bufferView"}, accessor()[1]]), "no data"),
    ("gltf", gltf(accessors=[accessor()[0], {**accessor()[1], "byteOffset": 12}]), "name vertices that are not among"),
    ("gltf", gltf(buffers=[{"byteLength": 56, "uri": "absent.bin"}]), "which is not there"),
    ("gltf", gltf(buffers=[{"byteLength": 56, "uri": "http://127.0.0.1:9/a.bin"}]), "no relative path"),
    ("gltf", gltf(buffers=[{"byteLength": 56, "uri": "/etc/passwd"}]), "no relative path"),
    ("gltf", gltf(buffers=[{"byteLength": 56, "uri": "../../a.bin"}]), "outside the folder"),
    ("gltf", gltf(buffers=[{"byteLength": 56, "uri": "%2e%2e/a.bin"}]), "outside the folder"),
    ("gltf", gltf(buffers=[{"byteLength": 57, "uri": gltf()["buffers"][0]["uri"]}]), "announces 57 bytes and has 56"),
    ("gltf", gltf(asset={"version": "1.0"}), "glTF version 1.0"),
    ("gltf", gltf(nodes=[{"mesh": 0, "name": 42}]), "name of text"),
    ("gltf", '{"asset": {"version": "2.0"}, "scene": NaN}', "NaN is no JSON number"),
    ("gltf", "[" * 100_000, "no JSON"),
    ("gltf", gltf(meshes=7), "malformed glTF"),
    ("dae", dae(before="<!DOCTYPE a [<!ENTITY b 'c'>]>"), "document type declaration"),
    ("dae", dae(before="<!DOCTYPE a SYSTEM 'http://127.0.0.1:9/a.dtd'>"), "document type declaration"),
    ("dae", dae(before="<!DOCTYPE a [<!ENTITY b 'c'>]>").encode("utf-16"), "document type declaration"),
    ("dae", dae()[:-30], "cut short or broken"),
    ("dae", "<a>" * 300, "nested deeper"),
    ("dae", dae(nodes="<node><instance_geometry url='#other'/></node>"), "which is no geometry of this file"),
    ("dae", dae(nodes="<node><instance_controller url='#g'/></node>"), "skinned or morphed"),
    ("dae", dae(nodes="<node id='n'><instance_node url='#n'/></node>"), "in a cycle"),
    ("dae", dae(polygons="<vcount>4</vcount><p>0 1 3</p>"), "disagree"),
    ("step", "ISO-10303-21;", "the format 'step' is not read; known: .*, obj, off, ply"),
    ("", "v 0 0 0\n", "the format '' is not read"),
    ("glb", b"PK\3\4" + b"\0" * 60, "no GLB header"),
]  # fmt: skip


@pytest.mark.parametrize(("suffix", "content", "reason"), REJECTED, ids=[f"{r[0]}:{r[2][:24]}" for r in REJECTED])
def test_what_is_not_sound_is_rejected_with_the_reason(written, suffix, content, reason):
    with pytest.raises(MeshRejected, match=reason):
        read_mesh_file(written(content, suffix))


@pytest.mark.parametrize(
    ("suffix", "content"),
    [
        ("obj", "v 0 0 0\nv 1 0 0\nl 1 2\n"),
        ("off", "OFF 1 0 0\n0 0 0\n"),
        ("ply", TRIANGLE_PLY.replace("face 1", "face 0").replace("3 0 1 2\n", "")),
        ("stl", b"\0" * 84),
        ("stl", "solid\nendsolid\n"),
        ("gltf", {"asset": {"version": "2.0"}}),
        ("gltf", gltf(meshes=[{"primitives": [{"attributes": {"POSITION": 0}, "mode": 1}]}])),
        ("dae", dae(nodes="")),
    ],
)
def test_sound_files_without_triangles_are_empty(written, suffix, content):
    with pytest.raises(MeshEmpty, match="no triangles"):
        read_mesh_file(written(content, suffix))


@pytest.mark.parametrize(
    "content",
    [
        SQUARE_OBJ.replace("\n", "\r"), SQUARE_OBJ.replace("\n", "\r\n"), SQUARE_OBJ.encode("utf-16"),
        b"\xef\xbb\xbf" + SQUARE_OBJ.encode(), SQUARE_OBJ.replace("f 1 2 ", "f 1/7/ \\\n 2//3 "),
        SQUARE_OBJ.replace("f 1 2 3 4", "f -4 -3 -2 -1"), "# caf\xe9\n".encode("latin-1") + SQUARE_OBJ.encode(),
        "v 1e9 0 0\n" + SQUARE_OBJ.replace("f 1 2 3 4", "f 2 3 4 5"),
    ],
)  # fmt: skip
def test_odd_but_sound_obj_files_are_the_same_square(written, content):
    read = read_mesh_file(written(content, "obj"))
    assert read.extent == 2
    assert area(read.triangles).sum() == pytest.approx(1)


def test_what_no_scene_shows_does_not_matter(written):
    """A broken accessor, a remote image and a material that is not there, none of which bears on the geometry."""
    tree = gltf(images=[{"uri": "http://127.0.0.1:9/a.png"}], accessors=[*accessor(), {"bufferView": 99}])
    tree["meshes"][0]["primitives"][0]["material"] = 5
    tree["meshes"][0]["primitives"][0]["attributes"]["NORMAL"] = 77
    assert len(read_mesh_file(written(tree, "gltf")).triangles) == 2


def test_collada_keeps_its_geometry_without_its_materials(written):
    pytest.importorskip("collada")
    bound = "<instance_geometry url='#g'><bind_material><technique_common><instance_material symbol='m' target='#no'/>"
    bound += "</technique_common></bind_material></instance_geometry>"
    moved = f"<node><translate>0 3 0</translate>{bound}</node><node>{bound}</node>"
    read = read_mesh_file(written(dae(nodes=moved), "dae"))
    assert len(read.triangles) == 4
    assert read.extent == pytest.approx(4)


def test_missing_pycollada_names_the_extra(tmp_path):
    (tmp_path / "a.dae").write_text(dae())
    code = (
        "from unghost.data_recipes import mesh_collada\nmesh_collada.find_spec = lambda name: None\n"
        f"mesh_collada.read_dae(open({str(tmp_path / 'a.dae')!r}, 'rb').read())"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert "ImportError: reading .dae needs pycollada: pip install unghost[recipes]" in run.stderr


def test_xml_in_bulk_is_refused():
    check_xml(b"<a><b/></a>")
    with pytest.raises(MeshRejected, match="more than 2000000 elements"):
        check_xml(b"<a>" + b"<b/>" * 2_000_001 + b"</a>")


def test_zipped_formats_are_looked_through_first(monkeypatch):
    def packed(*members):
        stream = io.BytesIO()
        with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, content in members:
                archive.writestr(name, content)
        return stream.getvalue()

    mesh_files._check_zip(packed(("3D/a.model", "<model/>")))
    monkeypatch.setattr(mesh_files, "MOST_BYTES", 1 << 20)
    bomb = packed(*((f"{i}.bin", b"\0" * (1 << 17)) for i in range(9)))
    assert len(bomb) < 1 << 16
    for data, reason in [
        (bomb, "unpacks to more than"),
        (packed(("../a.model", "<model/>")), "holds the path"),
        (packed(("a.model", "<!DOCTYPE a []><model/>")), "document type"),
        (b"PK\3\4", "no whole zip archive"),
    ]:
        with pytest.raises(MeshRejected, match=reason):
            mesh_files._check_zip(data)


def test_links_and_paths_do_not_leave_the_folder(tmp_path):
    inside, outside = tmp_path / "inside", tmp_path / "outside"
    inside.mkdir()
    outside.mkdir()
    (outside / "a.obj").write_text(SQUARE_OBJ)
    (outside / "a.bin").write_bytes(CORNERS.tobytes() + STRIP.tobytes())
    (inside / "link.obj").symlink_to(outside / "a.obj")
    (inside / "link.bin").symlink_to(outside / "a.bin")
    (inside / "a.gltf").write_text(json.dumps(gltf(buffers=[{"byteLength": 56, "uri": "link.bin"}])))
    for name in ("link.obj", "../outside/a.obj"):
        with pytest.raises(MeshRejected, match="leads outside the folder"):
            read_mesh_file(inside / name, root=inside)
    with pytest.raises(MeshRejected, match=r"'link\.bin', outside the folder"):
        read_mesh_file(inside / "a.gltf", root=inside)
    assert read_mesh_file(inside / "link.obj").extent == 2  # a link that the caller names is the caller's own
    assert len(read_mesh_file(inside / "a.gltf", root=tmp_path).triangles) == 2


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes")
def test_what_is_no_file_is_refused_without_waiting(tmp_path):
    os.mkfifo(tmp_path / "pipe.obj")
    (tmp_path / "folder.obj").mkdir()
    with pytest.raises(MeshRejected, match="no regular file"):
        read_mesh_file(tmp_path / "pipe.obj")
    with pytest.raises(MeshRejected, match=r"no regular file|cannot be opened"):
        read_mesh_file(tmp_path / "folder.obj")
    with pytest.raises(FileNotFoundError, match=r"absent\.obj is not a file"):
        read_mesh_file(tmp_path / "absent.obj")


def test_too_long_a_file_is_refused(tmp_path):
    with (tmp_path / "long.stl").open("wb") as stream:
        stream.truncate(mesh_files.MOST_BYTES + 1)  # takes no room on the disk
    with pytest.raises(MeshRejected, match="more than 536870912"):
        read_mesh_file(tmp_path / "long.stl")


def test_load_mesh_is_the_drop_in(written):
    mesh = load_mesh(written(SQUARE_OBJ, "obj"))
    assert np.ptp(mesh.triangles.reshape(-1, 3), axis=0).tolist() == [1, 1, 0]
    assert len(mesh.cumulative_areas) == 2
    with pytest.raises(ValueError, match=r"load_mesh: .*mesh\.obj: line 1: 'nonsense'"):
        load_mesh(written("nonsense", "obj"))


# --- fuzzing: whatever the bytes, one of the three ends, and never a mesh that is not finite or not at unit size

SUFFIXES = ("obj", "off", "ply", "stl", "gltf", "glb", "dae")


def _glb():
    tree = {**gltf(), "buffers": [{"byteLength": 56}]}
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    data = CORNERS.tobytes() + STRIP.tobytes()
    chunks = len(text).to_bytes(4, "little") + b"JSON" + text + len(data).to_bytes(4, "little") + b"BIN\0" + data
    return b"glTF" + (2).to_bytes(4, "little") + (12 + len(chunks)).to_bytes(4, "little") + chunks


_BINARY_PLY = (
    TRIANGLE_PLY.split("end_header")[0].replace("ascii", "binary_little_endian").encode()
    + b"end_header\n" + CORNERS[:3].tobytes() + b"\3" + np.array([0, 1, 2], dtype="<i4").tobytes()
)  # fmt: skip
VALID = [
    ("off", b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"), ("ply", TRIANGLE_PLY.encode()), ("ply", _BINARY_PLY),
    ("stl", b"solid a\n" + FACET.encode() * 2 + b"endsolid a\n"),
    ("stl", b"\0" * 80 + (1).to_bytes(4, "little") + b"\0" * 12 + CORNERS[:3].tobytes() + b"\0\0"),
    ("gltf", json.dumps(gltf()).encode()), ("glb", _glb()), ("dae", dae().encode()), ("obj", SQUARE_OBJ.encode()),
]  # fmt: skip


@pytest.fixture(scope="module")
def outcome(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fuzz")

    def end(data, suffix):
        path = folder / f"mesh.{suffix}"
        path.write_bytes(data)
        try:
            read = read_mesh_file(path)
        except (MeshEmpty, MeshRejected) as error:
            return None if str(error) else "no reason given"
        except ImportError as error:
            return None if "pycollada" in str(error) else "another library is missing"
        assert np.isfinite(read.triangles).all()
        assert np.ptp(read.triangles.reshape(-1, 3), axis=0).max() <= 1 + 1e-12
        assert (area(read.triangles) > 0).all()
        return read

    return end


@given(st.sampled_from(SUFFIXES), st.binary(max_size=400))
@settings(max_examples=150, deadline=None)
def test_any_bytes_end_well(outcome, suffix, data):
    outcome(data, suffix)


@given(st.sampled_from(VALID), st.binary(max_size=200))
@settings(max_examples=100, deadline=None)
def test_any_bytes_behind_a_sound_beginning_end_well(outcome, valid, data):
    suffix, whole = valid
    outcome(whole[: len(whole) // 2] + data, suffix)


@given(st.sampled_from(VALID), st.lists(st.tuples(st.floats(0, 1), st.integers(0, 255)), min_size=1, max_size=4))
@settings(max_examples=200, deadline=None)
def test_changed_bytes_end_well(outcome, valid, changes):
    suffix, whole = valid
    data = bytearray(whole)
    for place, byte in changes:
        data[int(place * (len(data) - 1))] = byte
    outcome(bytes(data), suffix)


@pytest.mark.parametrize("valid", VALID[:-1], ids=[v[0] for v in VALID[:-1]])
def test_a_cut_file_is_never_another_mesh(outcome, valid):
    """At every length: refused, empty, or all of it. (OBJ has no end, so a cut OBJ can be a smaller OBJ.)"""
    suffix, whole = valid
    full = outcome(whole, suffix)
    if full is None:
        pytest.skip("needs pycollada")
    for length in range(len(whole)):
        read = outcome(whole[:length], suffix)
        assert read is None or np.array_equal(read.triangles, full.triangles), f"{length} of {len(whole)} bytes"


@needs_shared
@pytest.mark.shared_data
def test_real_meshes_agree_with_trimesh():
    """Every 25th file of the shared folder: as many triangles, the same bounds and area, and the manifest's hash."""
    root = SHARED / "meshes"
    with (root / "manifest.csv").open(encoding="utf-8", newline="") as stream:
        rows = [row for row in csv.DictReader(stream) if not row["path"].lower().endswith(".dae")]
    for row in rows[::25]:
        read = read_mesh_file(root / row["path"], root=root)
        assert read.sha256 == row["sha256"]
        scene = trimesh.load_scene(root / row["path"], process=False, skip_materials=True)
        plain = np.concatenate(
            [
                trimesh.transform_points(scene.geometry[name].vertices, matrix)[scene.geometry[name].faces]
                for matrix, name in map(scene.graph.get, scene.graph.nodes_geometry)
                if isinstance(scene.geometry[name], trimesh.Trimesh)
            ]
        )
        assert len(plain) == len(read.triangles) + read.dropped
        assert area(plain).sum() == pytest.approx(area(read.triangles).sum() * read.extent**2, rel=1e-9)
        assert np.ptp(plain.reshape(-1, 3), axis=0).max() == pytest.approx(read.extent)
