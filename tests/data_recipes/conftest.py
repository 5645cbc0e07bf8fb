"""What several of these tests start from: mesh files, a folder of meshes, a photographed scene."""

import base64
import dataclasses
import json
from types import SimpleNamespace

import numpy as np
import pytest

from unghost.core.cameras import Cameras, look_at
from unghost.data_recipes.recipe import load_recipe

_SQUARE_OBJ = "v 0 0 0\nv 2 0 0\nv 2 2 0\nv 0 2 0\nf 1 2 3 4\n"
_TRIANGLE_PLY = (
    "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
)
_FACET = "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n"
_CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], dtype="<f4")
_STRIP = np.array([0, 1, 2, 3], dtype="<u2")


def _area(triangles):
    return np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1) / 2


def _gltf(**changes):
    """A unit square in two triangles (a strip) as a glTF tree; ``changes`` replace its parts."""
    data = _CORNERS.tobytes() + _STRIP.tobytes()
    tree = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "mode": 5}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
            {"bufferView": 0, "byteOffset": 48, "componentType": 5123, "count": 4, "type": "SCALAR"},
        ],
        "bufferViews": [{"buffer": 0, "byteLength": len(data)}],
        "buffers": [{"byteLength": len(data), "uri": "data:;base64," + base64.b64encode(data).decode()}],
    }
    return {**tree, **changes}


def _accessor(**changes):
    return [{**_gltf()["accessors"][0], **changes}, _gltf()["accessors"][1]]


def _dae(nodes="<node><instance_geometry url='#g'/></node>", before="", polygons="<vcount>4</vcount><p>0 1 3 2</p>"):
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


def _glb():
    tree = {**_gltf(), "buffers": [{"byteLength": 56}]}
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    data = _CORNERS.tobytes() + _STRIP.tobytes()
    chunks = len(text).to_bytes(4, "little") + b"JSON" + text + len(data).to_bytes(4, "little") + b"BIN\0" + data
    return b"glTF" + (2).to_bytes(4, "little") + (12 + len(chunks)).to_bytes(4, "little") + chunks


_BINARY_PLY = (
    _TRIANGLE_PLY.split("end_header")[0].replace("ascii", "binary_little_endian").encode()
    + b"end_header\n"
    + _CORNERS[:3].tobytes()
    + b"\3"
    + np.array([0, 1, 2], dtype="<i4").tobytes()
)
_VALID = {
    "off": ("off", b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"),
    "ply": ("ply", _TRIANGLE_PLY.encode()),
    "binary ply": ("ply", _BINARY_PLY),
    "stl": ("stl", b"solid a\n" + _FACET.encode() * 2 + b"endsolid a\n"),
    "binary stl": ("stl", b"\0" * 80 + (1).to_bytes(4, "little") + b"\0" * 12 + _CORNERS[:3].tobytes() + b"\0\0"),
    "gltf": ("gltf", json.dumps(_gltf()).encode()),
    "glb": ("glb", _glb()),
    "dae": ("dae", _dae().encode()),
    "obj": ("obj", _SQUARE_OBJ.encode()),
}


@pytest.fixture(scope="session")
def samples():
    """Small sound mesh files, some made to order; ``valid`` has one of each kind, its ending and its bytes."""
    return SimpleNamespace(
        square_obj=_SQUARE_OBJ,
        triangle_ply=_TRIANGLE_PLY,
        facet=_FACET,
        corners=_CORNERS,
        strip=_STRIP,
        gltf=_gltf,
        accessor=_accessor,
        dae=_dae,
        valid=_VALID,
    )


@pytest.fixture(scope="session")
def area():
    """The areas of triangles ``(F, 3, 3)``."""
    return _area


@pytest.fixture
def written(tmp_path, samples):
    """Writes a mesh file: text, bytes, a glTF tree, or a function of ``samples`` that gives one of these."""

    def write(content, suffix):
        path = tmp_path / f"mesh.{suffix}"
        content = content(samples) if callable(content) else content
        content = json.dumps(content) if isinstance(content, dict) else content
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return write


@pytest.fixture(scope="session")
def photographed():
    """A ball and a box on a floor, photographed from +x: their -x sides are seen by nobody."""
    pytest.importorskip("torch")
    from unghost.scenes import furniture, solids
    from unghost.scenes import generator as scenes

    rng = np.random.default_rng(0)
    texture = furniture.random_texture(rng)
    scene = solids.SolidScene(
        [
            solids.Solid("sphere", (0.3,), np.array([0.2, 0.3, -0.1]), texture, 0.3),
            solids.Solid("box", (np.array([0.2, 0.2, 0.3]),), np.array([-0.2, -0.4, -0.1]), texture, 0.42),
            solids.Solid("box", (np.array([2.0, 2.0, 0.1]),), np.array([0.0, 0.0, -0.55]), texture, 2.84),
        ],
        [],
    )
    origins = np.array([[0.95, 0.0, 0.2], [0.9, 0.3, 0.4]])
    poses = look_at(origins, np.array([[0.0, 0.0, -0.2]] * 2))
    cameras = Cameras.create(poses, np.array([24.0, 24.0, 20.0, 15.0]), 40, 30)
    rays = [[ray.reshape(-1, 3) for ray in cameras.rays(index)] for index in range(2)]
    depth = [scene.trace(*ray) * -(ray[1] @ poses[index, :, 2]) for index, ray in enumerate(rays)]
    images = np.zeros((2, 30, 40, 3), dtype=np.float32)
    return scenes.PhotographedScene(scene, cameras, cameras, images, np.stack(depth).reshape(2, 30, 40))


@pytest.fixture(scope="session")
def whole_bytes():
    """Every file under a folder, as bytes by its path."""

    def read(folder):
        files = (path for path in sorted(folder.rglob("*")) if path.is_file())
        return {str(path.relative_to(folder)): path.read_bytes() for path in files}

    return read


@pytest.fixture(scope="session")
def mesh_recipe():
    """That of meshes, four cubes of each in a row."""
    return dataclasses.replace(load_recipe("meshes"), cubes_per_mesh=4)


@pytest.fixture
def mesh_root(tmp_path):
    """Three balls: rows 0 and 2 to train on, row 1 for validation."""
    trimesh = pytest.importorskip("trimesh")
    root = tmp_path / "meshes"
    (root / "balls").mkdir(parents=True)
    lines = ["path,split,licence"]
    for number in range(3):
        trimesh.creation.icosphere(subdivisions=1, radius=1 + number).export(root / f"balls/{number}.ply")
        lines.append(f"balls/{number}.ply,{'val' if number == 1 else 'train'},{'MIT-0' if number else 'CC0-1.0'}")
    (root / "manifest.csv").write_text("\n".join(lines), encoding="utf-8")
    return root
