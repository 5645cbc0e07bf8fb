"""glTF 2.0 and GLB: checked, stripped to its geometry, and only then read by trimesh.

What trimesh is given is a new, minimal scene: the default scene's nodes, their meshes' positions and indices, and
the bytes these name. Images, materials, skins, animations and morph targets never reach it: the geometry is the
one at rest, as stored, under its nodes' transforms.

Checked here, because trimesh (5.2.0) alone, on the 146 glTF and GLB files of the hostile set, calls 10 files empty that
are broken or made of what it does not read (triangle fans, required extensions), and fails on 40 sound files without a
triangle (mostly with a KeyError or an UnboundLocalError). Of the 731 files of the ordinary set it makes the same
triangles.
"""

from __future__ import annotations

import base64
import binascii
import json
import re
import struct
from collections.abc import Callable
from typing import Any

import numpy as np

from ...core.errors import InvalidFile
from .reading import Array, MeshRejected, no_triangles, trimesh_triangles

Side = Callable[[str], bytes]
Json = dict[str, Any]

_ITEM_BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
_INDEX_TYPES = (5121, 5123, 5125)
_HARMLESS = re.compile(
    r"(KHR|EXT|MSFT|ADOBE)_(materials|texture|lights|animation)_\w+|KHR_mesh_quantization|KHR_xmp.*|KHR_node_visibility",
    re.ASCII,
)
_CHUNK_JSON, _CHUNK_BIN = 0x4E4F534A, 0x004E4942
_DEEPEST = 512
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_DATA_URI = re.compile(r"data:[\w.+/-]*(;[\w.+=-]+)*;base64,", re.ASCII)


def read_glb(data: bytes, side: Side) -> Array:
    """Triangles of a binary glTF; ``side`` is asked for the files its buffers name.

    Raises:
        MeshRejected: a broken container, or as :func:`read_gltf`.
    """
    if len(data) < 20 or data[:4] != b"glTF":
        raise MeshRejected("no GLB header")
    version, length = struct.unpack_from("<2I", data, 4)
    if version != 2 or length > len(data):
        raise MeshRejected(f"GLB version {version} (2 is read), {length} bytes announced, {len(data)} there")
    chunks: list[tuple[int, bytes]] = []
    at = 12
    while at + 8 <= length:
        size, kind = struct.unpack_from("<2I", data, at)
        if at + 8 + size > length:
            raise MeshRejected(f"GLB chunk {len(chunks)} of {size} bytes reaches beyond the file")
        chunks.append((kind, data[at + 8 : at + 8 + size]))
        at += 8 + size
    kinds = [kind for kind, _ in chunks]
    if at != length or kinds[:1] != [_CHUNK_JSON] or _CHUNK_JSON in kinds[1:] or _CHUNK_BIN in kinds[2:]:
        raise MeshRejected("the GLB chunks are not one JSON and at most one BIN after it")
    binary = chunks[1][1] if len(chunks) > 1 and chunks[1][0] == _CHUNK_BIN else None
    return _read(chunks[0][1], binary, side)


def read_gltf(data: bytes, side: Side) -> Array:
    """Triangles of a glTF 2.0 file; ``side`` is asked for the files its buffers name.

    Raises:
        MeshRejected: another version, a required extension that changes geometry, a mesh compressed, instanced,
            sparse or normalised, a fan, a reference that leads nowhere, a cycle of nodes, a buffer that is missing,
            remote, outside the folder or too short, or any other breach that bears on the geometry.
    """
    return _read(data, None, side)


def _read(text: bytes, binary: bytes | None, side: Side) -> Array:
    try:
        tree = json.loads(text.decode("utf-8"), parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:  # includes UnicodeDecodeError and JSONDecodeError
        raise MeshRejected(f"no JSON ({type(error).__name__}: {str(error)[:100]})") from None
    try:
        scene = _Scene(tree, binary, side)
        minimal, buffers, expected = scene.minimal()
    except MeshRejected:
        raise
    except (KeyError, IndexError, TypeError, AttributeError, ValueError, OverflowError) as error:
        raise MeshRejected(f"malformed glTF ({type(error).__name__}: {str(error)[:100]})") from error
    if expected == 0:
        return no_triangles()
    triangles = trimesh_triangles(json.dumps(minimal).encode(), "gltf", buffers)
    if len(triangles) != expected:
        raise MeshRejected(f"{expected} triangles are in the scene, {len(triangles)} were read")
    return triangles


def _no_constant(name: str) -> float:
    raise InvalidFile(f"{name} is no JSON number")


def _number_of(value: Any, limit: int, what: str) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < limit:
        raise MeshRejected(f"{what} must be a whole number below {limit}, got {str(value)[:40]}")
    return value


class _Scene:
    """One glTF tree and the way from it to its minimal twin."""

    def __init__(self, tree: Any, binary: bytes | None, side: Side) -> None:
        if not isinstance(tree, dict) or not isinstance(tree.get("asset"), dict):
            raise MeshRejected("no glTF object with an asset")
        asset = tree["asset"]
        version = str(asset.get("version"))
        if not re.fullmatch(r"2\.[0-9]+", version) or str(asset.get("minVersion", "2.0")) != "2.0":
            raise MeshRejected(
                f"glTF version {version[:20]} (minimum {str(asset.get('minVersion'))[:20]}), 2.0 is read"
            )
        for name in tree.get("extensionsRequired", []):
            if not _HARMLESS.fullmatch(name):
                raise MeshRejected(f"the required extension {name[:60]} is not read")
        for kind in ("scenes", "nodes", "meshes", "accessors", "bufferViews", "buffers"):
            for i, item in enumerate(tree.get(kind, [])):
                if not isinstance(item, dict) or not isinstance(item.get("name", ""), str):
                    raise MeshRejected(f"{kind}[{i}] is no object with a name of text")
        self.tree, self.binary, self.side = tree, binary, side
        self.quantized = "KHR_mesh_quantization" in tree.get("extensionsUsed", [])
        self.accessors: dict[int, int] = {}
        self.views: dict[int, int] = {}
        self.buffers: dict[int, bytes] = {}
        self.counts: list[int] = []

    def minimal(self) -> tuple[Json, dict[str, bytes], int]:
        """The stripped tree, the bytes of its buffers by name, and how many triangles it has."""
        tree = self.tree
        scenes = tree.get("scenes", [])
        if not scenes:
            return {}, {}, 0
        roots = scenes[_number_of(tree.get("scene", 0), len(scenes), "scene")].get("nodes", [])
        order = self._nodes(roots)
        place = {old: new for new, old in enumerate(order)}  # without hidden nodes and what hangs on them
        used = sorted({m for old in order if (m := tree["nodes"][old].get("mesh")) is not None})
        meshes, faces = {}, {}
        for m in used:
            meshes[m], faces[m] = self._mesh(tree["meshes"][_number_of(m, len(tree.get("meshes", [])), "mesh")])
        kept = [m for m in used if faces[m]]
        nodes = []
        for old in order:
            node = {
                k: tree["nodes"][old][k]
                for k in ("matrix", "translation", "rotation", "scale")
                if k in tree["nodes"][old]
            }
            if children := tree["nodes"][old].get("children"):
                node["children"] = [place[child] for child in children if child in place]
            if tree["nodes"][old].get("mesh") in kept:
                node["mesh"] = kept.index(tree["nodes"][old]["mesh"])
            nodes.append(node)
        expected = sum(faces.get(tree["nodes"][old].get("mesh"), 0) for old in order)
        minimal: Json = {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": [place[root] for root in roots if root in place]}],
            "nodes": nodes,
            "meshes": [meshes[m] for m in kept],
            "accessors": [self._accessor(i) for i in self.accessors],
            "bufferViews": [self._view(i) for i in self.views],
        }
        numbers = list(self.buffers)
        for view in minimal["bufferViews"]:
            view["buffer"] = numbers.index(view["buffer"])
        minimal["buffers"] = [{"uri": f"{i}", "byteLength": len(self.buffers[i])} for i in numbers]
        return minimal, {f"{i}": self.buffers[i] for i in numbers}, expected

    def _nodes(self, roots: list[Any]) -> list[int]:
        """The nodes that the scene shows, parents first; each may be reached once only."""
        nodes = self.tree.get("nodes", [])
        order: list[int] = []
        level = list(roots)
        seen: set[int] = set()
        for _ in range(_DEEPEST):
            below: list[Any] = []
            for number in level:
                index = _number_of(number, len(nodes), "a node")
                if index in seen:
                    raise MeshRejected(f"node {index} is reached twice: the nodes are no trees")
                seen.add(index)
                if _is_hidden(nodes[index], index):
                    continue  # and so is everything below it
                _check_transform(nodes[index], index)
                order.append(index)
                below += nodes[index].get("children", [])
            level = below
            if not level:
                return order
        raise MeshRejected(f"nodes nested deeper than {_DEEPEST}")

    def _mesh(self, mesh: Json) -> tuple[Json, int]:
        """The mesh without all but positions and indices, and its triangles."""
        primitives, total = [], 0
        for primitive in mesh["primitives"]:
            mode = _number_of(primitive.get("mode", _TRIANGLES), 7, "the mode of a primitive")
            if compressed := [name for name in primitive.get("extensions", {}) if "compression" in name]:
                raise MeshRejected(f"a primitive compressed with {', '.join(compressed)[:60]}")
            if mode == _FAN:
                raise MeshRejected("triangle fans are not read")
            if mode < _TRIANGLES or "POSITION" not in primitive["attributes"]:
                continue  # points and lines have no surface; a primitive without positions draws nothing
            position = primitive["attributes"]["POSITION"]
            slim: Json = {"mode": mode, "attributes": {"POSITION": self._use(position, points=True)}}
            count = self.tree["accessors"][position]["count"]
            if "indices" in primitive:
                slim["indices"] = self._use(primitive["indices"], points=False)
                self._check_indices(primitive["indices"])
                count = self.tree["accessors"][primitive["indices"]]["count"]
            triangles = count // 3 if mode == _TRIANGLES else max(count - 2, 0)
            if mode == _TRIANGLES and count % 3:
                raise MeshRejected(f"{count} corners do not make triangles")
            if mode == _STRIP and 0 < count < 3:
                raise MeshRejected(f"a strip of {count} corners")
            if triangles:
                primitives.append(slim)
                total += triangles
        return {"primitives": primitives}, total

    def _use(self, index: Any, *, points: bool) -> int:
        """The new number of an accessor of positions or of indices."""
        accessors = self.tree.get("accessors", [])
        accessor = accessors[_number_of(index, len(accessors), "an accessor")]
        kind, component = accessor.get("type"), accessor.get("componentType")
        allowed = ((5126, *_ITEM_BYTES) if self.quantized else (5126,)) if points else _INDEX_TYPES
        if kind != ("VEC3" if points else "SCALAR") or component not in allowed or "sparse" in accessor:
            raise MeshRejected(
                f"accessor {index} of {'positions' if points else 'indices'} is {str(kind)[:20]} of {component}"
                f"{', sparse' if 'sparse' in accessor else ''}"
            )
        if points and component != 5126 and accessor.get("normalized"):
            raise MeshRejected(f"accessor {index}: normalised whole numbers as positions are not read")
        if "bufferView" not in accessor:
            raise MeshRejected(f"accessor {index} has no data (compressed geometry?)")
        self._fits(index, accessor)
        return self.accessors.setdefault(index, len(self.accessors))

    def _fits(self, index: int, accessor: Json) -> None:
        """Check that an accessor's items lie within its view, and that within its buffer."""
        views, buffers = self.tree.get("bufferViews", []), self.tree.get("buffers", [])
        number = _number_of(accessor["bufferView"], len(views), "a buffer view")
        view = views[number]
        buffer = _number_of(view["buffer"], len(buffers), "a buffer")
        if buffer not in self.buffers:
            self.buffers[buffer] = self._bytes(buffers[buffer], buffer)
        self.views.setdefault(number, len(self.views))
        item = _ITEM_BYTES[accessor["componentType"]] * (3 if accessor["type"] == "VEC3" else 1)
        stride = _number_of(view.get("byteStride", item), 253, "a byte stride")
        count = _number_of(accessor["count"], 1 << 32, "the count of an accessor")
        offset = _number_of(accessor.get("byteOffset", 0), 1 << 40, "a byte offset")
        start = _number_of(view.get("byteOffset", 0), 1 << 40, "a byte offset")
        length = _number_of(view["byteLength"], 1 << 40, "a byte length")
        if stride < item or (count and offset + (count - 1) * stride + item > length):
            raise MeshRejected(f"accessor {index} of {count} items reaches beyond its buffer view of {length} bytes")
        if start + length > len(self.buffers[buffer]):
            raise MeshRejected(f"buffer view {number} reaches beyond its buffer of {len(self.buffers[buffer])} bytes")

    def _check_indices(self, index: int) -> None:
        """Check that no index is the largest of its type: forbidden, as some programs start a strip anew there."""
        accessor = self.tree["accessors"][index]
        view = self.tree["bufferViews"][accessor["bufferView"]]
        dtype = np.dtype(f"<u{_ITEM_BYTES[accessor['componentType']]}")
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        stride, count = view.get("byteStride", dtype.itemsize), accessor["count"]
        values = np.ndarray((count,), dtype, self.buffers[view["buffer"]], start, (stride,)) if count else np.zeros(0)
        if (restarts := int((values == np.iinfo(dtype).max).sum())) > 0:
            raise MeshRejected(f"accessor {index} has {restarts} indices of {np.iinfo(dtype).max}, primitive restart")

    def _bytes(self, buffer: Json, number: int) -> bytes:
        """The bytes of a buffer: of the GLB's chunk, a data URI, or a file beside the glTF."""
        length = _number_of(buffer["byteLength"], 1 << 40, "a byte length")
        uri = buffer.get("uri")
        if uri is None:
            if self.binary is None or number != 0:
                raise MeshRejected(f"buffer {number} has no data")
            data = self.binary
        elif isinstance(uri, str) and (match := _DATA_URI.match(uri)):
            try:
                data = base64.b64decode(uri[match.end() :], validate=True)
            except (binascii.Error, ValueError):
                raise MeshRejected(f"buffer {number}: its data URI is no base64") from None
        elif isinstance(uri, str):
            data = self.side(uri)
        else:
            raise MeshRejected(f"buffer {number}: its uri is no text")
        if len(data) < length:
            raise MeshRejected(f"buffer {number} announces {length} bytes and has {len(data)}")
        return data

    def _accessor(self, index: int) -> Json:
        accessor = self.tree["accessors"][index]
        slim = {k: accessor[k] for k in ("componentType", "type", "count", "byteOffset") if k in accessor}
        return {**slim, "bufferView": self.views[accessor["bufferView"]]}

    def _view(self, index: int) -> Json:
        view = self.tree["bufferViews"][index]
        return {k: view[k] for k in ("buffer", "byteLength", "byteOffset", "byteStride") if k in view}


def _is_hidden(node: Json, index: int) -> bool:
    """Whether KHR_node_visibility hides a node with all its children."""
    visible = node.get("extensions", {}).get("KHR_node_visibility", {}).get("visible", True)
    if not isinstance(visible, bool):
        raise MeshRejected(
            f"node {index}: visible (KHR_node_visibility) must be true or false, got {str(visible)[:40]}"
        )
    return not visible


def _check_transform(node: Json, index: int) -> None:
    """Check that a node's matrix, or translation, rotation and scale, are what glTF allows."""
    parts = {"matrix": 16, "translation": 3, "rotation": 4, "scale": 3}
    given = {name: np.array(node[name], dtype=np.float64) for name in parts if name in node}
    for name, value in given.items():
        if value.shape != (parts[name],) or not np.isfinite(value).all():
            raise MeshRejected(f"node {index}: its {name} must be {parts[name]} finite numbers")
    if "matrix" in given and len(given) > 1:
        raise MeshRejected(f"node {index} has a matrix and a {', '.join(sorted(given.keys() - {'matrix'}))}")
    if "matrix" in given and not np.allclose(given["matrix"][[3, 7, 11, 15]], [0, 0, 0, 1], atol=1e-6):
        raise MeshRejected(f"node {index}: its matrix is not affine")
    if "rotation" in given and abs(np.linalg.norm(given["rotation"]) - 1) > 1e-2:
        raise MeshRejected(f"node {index}: its rotation {given['rotation']} is no unit quaternion")
    if "EXT_mesh_gpu_instancing" in node.get("extensions", {}):
        raise MeshRejected(f"node {index}: instances (EXT_mesh_gpu_instancing) are not read")
