"""Mesh files that are not sound, or malicious: rejected with the reason."""

import base64
import io
import json
import os
import zipfile

import numpy as np
import pytest

from unghost.data_recipes.meshes import files as mesh_files
from unghost.data_recipes.meshes.collada import check_xml
from unghost.data_recipes.meshes.files import normalise, read_mesh_file
from unghost.data_recipes.meshes.reading import MeshRejected

pytest.importorskip("trimesh")

REJECTED = [
    ("obj", lambda s: s.square_obj + "f 0 1 2\n", "face index 0"),
    ("obj", lambda s: s.square_obj + "f 1 2 5\n", "1 face corners name a vertex"),
    ("obj", lambda s: s.square_obj + "f -5 1 2\n", "before the first vertex"),
    ("obj", lambda s: s.square_obj + "f 1 2\n", "needs three corners"),
    ("obj", lambda s: s.square_obj + "f 1.5 2 3\n", "whole numbers"),
    ("obj", lambda s: "v 0 0\n" + s.square_obj, "line 1: a vertex needs three numbers"),
    ("obj", lambda s: s.square_obj.replace("v 2 2 0", "v nan 2 0"), "2 coordinates of corners are not finite"),
    ("obj", lambda s: s.square_obj.replace("v 2 2 0", "v 1e999 2 0"), "not finite"),
    ("obj", lambda s: s.square_obj + "surf 0 1 0 1\n", "free-form"),
    ("obj", lambda s: s.square_obj + "nonsense\n", "line 6: 'nonsense' is no OBJ statement"),
    ("obj", lambda s: s.square_obj + "\0", "NUL"),
    ("obj", "\n \n", "no OBJ statement"),
    ("obj", "v 1 2 3\n" * 3 + "f 1 2 3\n", "the longest side is 0.0"),
    ("obj", "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "none of the 1 triangles has an area"),
    ("obj", "version https://git-lfs.github.com/spec/v1\noid sha256:0\n", "git-lfs pointer"),
    ("obj", "", "no bytes"),
    ("off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n", "3 vertices and 1 faces are announced, 3 lines follow"),
    ("off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 3\n", "name a vertex"),
    ("off", "OFF BINARY\n3 1 0\n", "counts must be whole"),
    ("off", "4OFF\n3 1 0\n", "does not start with OFF"),
    ("ply", lambda s: s.triangle_ply.replace("vertex 3", "vertex 2000000000"), "announces at least 6000000001"),
    ("ply", lambda s: s.triangle_ply.replace("3 0 1 2\n", "3 0 1\n"), "ends early"),
    ("ply", lambda s: s.triangle_ply + "7\n", "1 values longer"),
    ("ply", lambda s: s.triangle_ply.replace("3 0 1 2", "3 0 1 -1"), "name a vertex"),
    ("ply", lambda s: s.triangle_ply.replace("3 0 1 2", "3 0 1 1.5"), "not whole"),
    ("ply", lambda s: s.triangle_ply.replace("3 0 1 2", "-3 0 1 2"), "a PLY list of length -3"),
    ("ply", lambda s: s.triangle_ply.replace("float x", "float w"), "without vertices x, y, z"),
    ("ply", lambda s: s.triangle_ply.replace("vertex_indices", "others"), "without a list of vertex indices"),
    ("ply", lambda s: s.triangle_ply.replace("float y", "float128 y"), "PLY header line 'property float128 y'"),
    ("ply", lambda s: s.triangle_ply.replace("element", "elemental"), "PLY header line"),
    ("ply", lambda s: s.triangle_ply.replace("property float y", "property"), "PLY header line 'property'"),
    ("stl", b"\0" * 80 + (2).to_bytes(4, "little") + b"\0" * 50, "184 bytes of binary STL, got 134"),
    ("stl", lambda s: "solid a\n" + s.facet, "1 whole facets that is cut short"),
    ("stl", lambda s: "solid a\n" + s.facet + s.facet[:60] + "endsolid a\n", "cut short"),
    ("stl", b"\1" * 83, "neither text nor binary"),
    ("gltf", lambda s: s.gltf(nodes=[{"mesh": 0, "scale": [1, 0, 1]}]), "flattens its mesh"),
    ("gltf", lambda s: s.gltf(nodes=[{"mesh": 0, "scale": [0, 0, 0]}]), "flattens its mesh"),
    ("gltf", lambda s: s.gltf(nodes=[{"mesh": 0, "children": [0]}]), "reached twice"),
    ("gltf", lambda s: s.gltf(nodes=[{"mesh": 0, "matrix": [1] * 15}]), "16 finite numbers"),
    ("gltf", lambda s: s.gltf(nodes=[{"mesh": 0, "rotation": [0, 0, 0, 2]}]), "no unit quaternion"),
    ("gltf", lambda s: s.gltf(nodes=[{"mesh": 1}]), "mesh must be a whole number below 1"),
    (
        "gltf",
        lambda s: s.gltf(extensionsRequired=["KHR_draco_mesh_compression"]),
        "KHR_draco_mesh_compression is not read",
    ),
    (
        "gltf",
        lambda s: s.gltf(
            meshes=[
                {
                    "primitives": [
                        {"attributes": {"POSITION": 0}, "mode": 4, "extensions": {"KHR_draco_mesh_compression": {}}}
                    ]
                }
            ]
        ),
        "compressed with",
    ),
    (
        "gltf",
        lambda s: s.gltf(meshes=[{"primitives": [{"attributes": {"POSITION": 0}, "mode": 6}]}]),
        "fans are not read",
    ),
    (
        "gltf",
        lambda s: s.gltf(meshes=[{"primitives": [{"attributes": {"POSITION": 0}}]}]),
        "4 corners do not make triangles",
    ),
    ("gltf", lambda s: s.gltf(accessors=s.accessor(sparse={})), "sparse"),
    ("gltf", lambda s: s.gltf(accessors=s.accessor(count=5)), "beyond its buffer view"),
    ("gltf", lambda s: s.gltf(accessors=s.accessor(componentType=5122)), "is VEC3 of 5122"),
    (
        "gltf",
        lambda s: s.gltf(
            accessors=s.accessor(componentType=5122, normalized=True), extensionsUsed=["KHR_mesh_quantization"]
        ),
        "normalised whole numbers",
    ),
    (
        "gltf",
        lambda s: s.gltf(accessors=[{"componentType": 5126, "count": 4, "type": "VEC3"}, s.accessor()[1]]),
        "no data",
    ),
    (
        "gltf",
        lambda s: s.gltf(accessors=[s.accessor()[0], {**s.accessor()[1], "byteOffset": 12}]),
        "name vertices that are not among",
    ),
    ("gltf", lambda s: s.gltf(buffers=[{"byteLength": 56, "uri": "absent.bin"}]), "which is not there"),
    ("gltf", lambda s: s.gltf(buffers=[{"byteLength": 56, "uri": "http://127.0.0.1:9/a.bin"}]), "no relative path"),
    ("gltf", lambda s: s.gltf(buffers=[{"byteLength": 56, "uri": "/etc/passwd"}]), "no relative path"),
    ("gltf", lambda s: s.gltf(buffers=[{"byteLength": 56, "uri": "../../a.bin"}]), "outside the folder"),
    ("gltf", lambda s: s.gltf(buffers=[{"byteLength": 56, "uri": "%2e%2e/a.bin"}]), "outside the folder"),
    (
        "gltf",
        lambda s: s.gltf(buffers=[{"byteLength": 57, "uri": s.gltf()["buffers"][0]["uri"]}]),
        "announces 57 bytes and has 56",
    ),
    ("gltf", lambda s: s.gltf(asset={"version": "1.0"}), "glTF version 1.0"),
    ("gltf", lambda s: s.gltf(nodes=[{"mesh": 0, "name": 42}]), "name of text"),
    ("gltf", '{"asset": {"version": "2.0"}, "scene": NaN}', "NaN is no JSON number"),
    ("gltf", "[" * 100_000, "no JSON"),
    ("gltf", lambda s: s.gltf(meshes=7), "malformed glTF"),
    ("dae", lambda s: s.dae(before="<!DOCTYPE a [<!ENTITY b 'c'>]>"), "document type declaration"),
    ("dae", lambda s: s.dae(before="<!DOCTYPE a SYSTEM 'http://127.0.0.1:9/a.dtd'>"), "document type declaration"),
    ("dae", lambda s: s.dae(before="<!DOCTYPE a [<!ENTITY b 'c'>]>").encode("utf-16"), "document type declaration"),
    ("dae", lambda s: s.dae()[:-30], "cut short or broken"),
    ("dae", "<a>" * 300, "nested deeper"),
    (
        "dae",
        lambda s: s.dae(nodes="<node><instance_geometry url='#other'/></node>"),
        "which is no geometry of this file",
    ),
    ("dae", lambda s: s.dae(nodes="<node><instance_controller url='#g'/></node>"), "skinned or morphed"),
    ("dae", lambda s: s.dae(nodes="<node id='n'><instance_node url='#n'/></node>"), "in a cycle"),
    ("dae", lambda s: s.dae(polygons="<vcount>4</vcount><p>0 1 3</p>"), "disagree"),
    ("step", "ISO-10303-21;", "the format 'step' is not read; known: .*, obj, off, ply"),
    ("", "v 0 0 0\n", "the format '' is not read"),
    ("glb", b"PK\3\4" + b"\0" * 60, "no GLB header"),
]


@pytest.mark.parametrize(("suffix", "content", "reason"), REJECTED, ids=[f"{r[0]}:{r[2][:24]}" for r in REJECTED])
def test_what_is_not_sound_is_rejected_with_the_reason(written, suffix, content, reason):
    with pytest.raises(MeshRejected, match=reason):
        read_mesh_file(written(content, suffix))


def test_single_precision_that_cannot_tell_corners_apart_is_refused():
    near = np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0]]], dtype=np.float32)
    normalise(near + np.float32(1000))  # 2**-14 apart
    with pytest.raises(MeshRejected, match="single precision has 16 steps"):
        normalise(near + np.float32(1e6))  # steps of 1/16


@pytest.mark.parametrize("kind", ["binary stl", "binary ply", "gltf", "glb"])
@pytest.mark.parametrize("pattern", [0x7F800001, 0x7FC00000, 0xFF800000])
def test_every_kind_of_nan_is_rejected_without_a_warning(written, samples, kind, pattern):
    """A signalling and a quiet NaN, and minus infinity, in the place of the first 1.0."""
    suffix, whole = samples.valid[kind]
    broken = pattern.to_bytes(4, "little")
    if kind == "gltf":
        data = bytearray(samples.corners.tobytes() + samples.strip.tobytes())
        data[12:16] = broken
        uri = "data:;base64," + base64.b64encode(data).decode()
        content = samples.gltf(buffers=[{"byteLength": len(data), "uri": uri}])
    else:
        content = whole.replace(b"\0\0\x80\x3f", broken, 1)
    with pytest.raises(MeshRejected, match="coordinates of corners are not finite"):
        read_mesh_file(written(content, suffix))


@pytest.mark.slow
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


def test_links_and_paths_do_not_leave_the_folder(tmp_path, samples):
    inside, outside = tmp_path / "inside", tmp_path / "outside"
    inside.mkdir()
    outside.mkdir()
    (outside / "a.obj").write_text(samples.square_obj)
    (outside / "a.bin").write_bytes(samples.corners.tobytes() + samples.strip.tobytes())
    (inside / "link.obj").symlink_to(outside / "a.obj")
    (inside / "link.bin").symlink_to(outside / "a.bin")
    (inside / "a.gltf").write_text(json.dumps(samples.gltf(buffers=[{"byteLength": 56, "uri": "link.bin"}])))
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
