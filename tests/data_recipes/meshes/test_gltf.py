"""glTF and GLB: what the scene shows, and nothing that is forbidden."""

import base64
import struct

import numpy as np
import pytest

from unghost.data_recipes.meshes.files import read_mesh_file
from unghost.data_recipes.meshes.reading import MeshEmpty, MeshRejected

pytest.importorskip("trimesh")

HIDDEN = {"KHR_node_visibility": {"visible": False}}
SHOWN = {"KHR_node_visibility": {"visible": True}}


def glb(*chunks):
    """A GLB of ``(kind, bytes)`` chunks."""
    body = b"".join(struct.pack("<I4s", len(data), kind) + data for kind, data in chunks)
    return b"glTF" + struct.pack("<2I", 2, 12 + len(body)) + body


def test_chunks_of_a_glb(samples, written):
    """One JSON, at most one BIN right after it, and any number of chunks of unknown kinds."""
    whole = samples.valid["glb"][1]
    size = struct.unpack_from("<I", whole, 12)[0]
    text, binary = (b"JSON", whole[20 : 20 + size]), (b"BIN\0", whole[28 + size :])
    unknown = (b"OWN\0", b"....")
    assert glb(text, binary) == whole
    for chunks in ((text, binary), (text, binary, unknown), (text, binary, unknown, unknown)):
        assert len(read_mesh_file(written(glb(*chunks), "glb")).triangles) == 2
    for chunks in (
        (text, binary, text),
        (text, text, binary),
        (text, text),
        (text, binary, unknown, text),
        (text, binary, binary),
        (text, unknown, binary),
        (binary, text),
        (unknown, text, binary),
    ):
        with pytest.raises(MeshRejected, match="the GLB chunks are not one JSON and at most one BIN after it"):
            read_mesh_file(written(glb(*chunks), "glb"))


def grid(component, indices, *, vertices):
    """A strip or list over ``vertices`` points, its indices of a component type."""
    rng = np.random.default_rng(0)
    points = rng.random((vertices, 3)).astype("<f4").tobytes()
    dtype = {5121: "<u1", 5123: "<u2", 5125: "<u4"}[component]
    numbers = np.array(indices, dtype=dtype)
    data = points + numbers.tobytes()
    views = [
        {"buffer": 0, "byteLength": len(points)},
        {"buffer": 0, "byteOffset": len(points), "byteLength": len(data) - len(points)},
    ]
    return {
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": vertices, "type": "VEC3"},
            {"bufferView": 1, "componentType": component, "count": len(indices), "type": "SCALAR"},
        ],
        "bufferViews": views,
        "buffers": [{"byteLength": len(data), "uri": "data:;base64," + base64.b64encode(data).decode()}],
    }


@pytest.mark.parametrize("mode", [4, 5])
@pytest.mark.parametrize(("component", "largest"), [(5121, 255), (5123, 65535), (5125, 2**32 - 1)])
def test_primitive_restart_is_refused(samples, written, component, largest, mode):
    """Also where there is a vertex of that number, which is what a reader without restarts takes it for."""
    meshes = [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "mode": mode}]}]
    vertices = min(largest, 65535) + 1
    sound = samples.gltf(meshes=meshes, **grid(component, [0, 1, 2, 3, 4, min(largest, 65535) - 1], vertices=vertices))
    assert len(read_mesh_file(written(sound, "gltf")).triangles) == (2 if mode == 4 else 4)
    broken = samples.gltf(meshes=meshes, **grid(component, [0, 1, 2, largest, 3, 4], vertices=vertices))
    with pytest.raises(MeshRejected, match=f"accessor 1 has 1 indices of {largest}, primitive restart"):
        read_mesh_file(written(broken, "gltf"))


def test_indices_with_an_offset_are_looked_at_where_they_are(samples, written):
    """255 before the indices, which begin one further, does not matter."""
    meshes = [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "mode": 4}]}]
    tree = samples.gltf(meshes=meshes, **grid(5121, [255, 0, 1, 2], vertices=256))
    tree["accessors"][1] |= {"byteOffset": 1, "count": 3}
    assert len(read_mesh_file(written(tree, "gltf")).triangles) == 1
    tree["accessors"][1] |= {"byteOffset": 0}
    with pytest.raises(MeshRejected, match="primitive restart"):
        read_mesh_file(written(tree, "gltf"))


@pytest.mark.parametrize("required", [False, True])
def test_hidden_nodes_are_left_out_with_their_children(samples, written, required):
    nodes = [
        {"mesh": 0, "children": [1, 2, 4], "extensions": SHOWN},
        {"mesh": 0, "translation": [3, 0, 0], "extensions": {"KHR_node_visibility": {}}},
        {"mesh": 0, "translation": [50, 0, 0], "extensions": HIDDEN, "children": [3]},
        {"mesh": 0, "translation": [90, 0, 0], "extensions": SHOWN},
        {"translation": [0, 9, 0]},
        {"mesh": 0, "translation": [0, 700, 0], "extensions": HIDDEN},
    ]
    tree = samples.gltf(nodes=nodes, scenes=[{"nodes": [5, 0]}], extensionsUsed=["KHR_node_visibility"])
    if required:
        tree["extensionsRequired"] = ["KHR_node_visibility"]
    read = read_mesh_file(written(tree, "gltf"))
    assert len(read.triangles) == 4
    assert read.extent == pytest.approx(4)


def test_a_scene_that_is_hidden_is_empty(samples, written):
    """What hangs on a hidden node is not shown, broken or not."""
    nodes = [{"mesh": 0, "scale": [0, 0, 0], "extensions": HIDDEN, "children": [1]}, {"mesh": 77}]
    with pytest.raises(MeshEmpty):
        read_mesh_file(written(samples.gltf(nodes=nodes), "gltf"))


def test_visibility_that_is_no_truth_value_is_rejected(samples, written):
    for value in (0, "false", None):
        nodes = [{"mesh": 0, "extensions": {"KHR_node_visibility": {"visible": value}}}]
        with pytest.raises(MeshRejected, match="must be true or false"):
            read_mesh_file(written(samples.gltf(nodes=nodes), "gltf"))


def test_a_version_in_other_digits_is_rejected(samples, written):
    with pytest.raises(MeshRejected, match="glTF version"):
        read_mesh_file(written(samples.gltf(asset={"version": "2.\uff10"}), "gltf"))
