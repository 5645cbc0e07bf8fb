"""COLLADA (.dae), read to the letter: XML without declarations, and the polygons of its scene, moved by its nodes.

Nothing but geometry is looked at, so that a material, an image or an animation that is missing does no harm.

Written here, because trimesh (5.2.0) with ``pycollada`` (0.9.3), on the 26 files of the hostile and the ordinary mesh
sets, gives nothing for 3 that have triangles, and covers concave polygons of 2 with fans (one of them an area of 3.22
for .245). It also ignores the stride and the offset of accessors and ``skew``, and makes 0 of NaN, and of index -1 the
last vertex.
"""

from __future__ import annotations

import io
import zipfile
from urllib.parse import unquote
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np

from .reading import (
    MOST_TRIANGLES,
    Array,
    MeshRejected,
    decimal_numbers,
    no_triangles,
    place,
    strip_corners,
    triangulate,
    whole_numbers,
)

_GEOMETRY = frozenset({"library_geometries", "library_nodes", "library_visual_scenes"})
_PRIMITIVES = frozenset({"triangles", "polylist", "polygons", "tristrips", "trifans"})
_TRANSFORMS = {"matrix": 16, "translate": 3, "rotate": 4, "scale": 3, "lookat": 9, "skew": 7}
_DEEPEST, _MOST_ELEMENTS, _MOST_INSTANCES = 256, 2_000_000, 100_000


def check_xml(data: bytes) -> None:
    """Check that XML is whole and declares nothing: no document type, so no entities to expand or to fetch.

    Raises:
        MeshRejected: a document type, elements nested too deep or too many, or text that is not well-formed.
    """
    parser = expat.ParserCreate()
    depth, elements = 0, 0

    def refuse(*_: object) -> None:
        raise MeshRejected("XML with a document type declaration (entities could expand or be fetched)")

    def begin(*_: object) -> None:
        nonlocal depth, elements
        depth, elements = depth + 1, elements + 1
        if depth > _DEEPEST or elements > _MOST_ELEMENTS:
            raise MeshRejected(f"XML nested deeper than {_DEEPEST} or of more than {_MOST_ELEMENTS} elements")

    def end(*_: object) -> None:
        nonlocal depth
        depth -= 1

    parser.StartDoctypeDeclHandler = refuse
    parser.EntityDeclHandler = refuse
    parser.StartElementHandler, parser.EndElementHandler = begin, end
    try:
        parser.Parse(data, True)
    except (expat.ExpatError, ValueError, LookupError) as error:
        if isinstance(error, MeshRejected):
            raise
        raise MeshRejected(f"XML that is cut short or broken ({error})") from error


def _parse(data: bytes) -> ElementTree.Element:
    """The root of checked XML."""
    check_xml(data)
    try:
        return ElementTree.fromstring(data)
    except ElementTree.ParseError as error:  # names of namespaces that are not declared, say
        raise MeshRejected(f"XML that is broken ({error})") from None


def read_dae(data: bytes) -> Array:
    """Triangles of a COLLADA file's scene, in its unit and with its up axis; polygons of any shape cut.

    Raises:
        MeshRejected: XML as :func:`check_xml`, a reference that leads nowhere or to several elements, a cycle of
            nodes, index lists that disagree with their counts, an accessor that reaches beyond its array or does not
            name three coordinates, an index out of range, polygons with holes, skinned or spline geometry, or a
            transform that is broken or skews.
    """
    root = _parse(data)
    if _name(root) != "COLLADA":
        raise MeshRejected(f"XML of {_name(root)[:40]!r}, not COLLADA")
    try:
        return _Scene(root).triangles()
    except (ValueError, TypeError, AttributeError) as error:
        if isinstance(error, MeshRejected):
            raise
        raise MeshRejected(f"malformed COLLADA ({type(error).__name__}: {str(error)[:100]})") from error


def read_zae(data: bytes) -> Array:
    """Triangles of a zipped COLLADA file: those of the document that its ``manifest.xml`` names, or of its only one.

    Raises:
        MeshRejected: no such document, several and none named, or as :func:`read_dae`.
    """
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        documents = [name for name in archive.namelist() if name.lower().endswith(".dae")]
        if "manifest.xml" in archive.namelist():
            manifest = _parse(archive.read("manifest.xml"))
            root = next((element for element in manifest.iter() if _name(element) == "dae_root"), None)
            path = "" if root is None else unquote((root.text or "").strip().split("#", 1)[0])
            documents = [name for name in documents if name == path.removeprefix("./").lstrip("/")]
        if len(documents) != 1:
            raise MeshRejected(f"the archive names {len(documents)} COLLADA documents, not one")
        return read_dae(archive.read(documents[0]))


def _name(element: ElementTree.Element) -> str:
    return str(element.tag).rsplit("}", 1)[-1]


def _children(element: ElementTree.Element, *names: str) -> list[ElementTree.Element]:
    return [child for child in element if _name(child) in names]


def _only(element: ElementTree.Element, name: str, **attributes: str) -> ElementTree.Element:
    """The one child of that name and with these attributes."""
    fits = [child for child in _children(element, name) if attributes.items() <= child.attrib.items()]
    if len(fits) != 1:
        what = " ".join((name, *attributes.values()))
        raise MeshRejected(f"{_name(element)} {element.get('id', '')[:60]!r} has {len(fits)} {what}, not one")
    return fits[0]


def _count(element: ElementTree.Element, attribute: str, default: int | None = None) -> int:
    """An attribute that is a whole number >= 0."""
    text = element.get(attribute)
    if text is None and default is not None:
        return default
    numbers = whole_numbers(text or "")
    if len(numbers) != 1 or numbers[0] < 0:
        raise MeshRejected(f"the {attribute} of {_name(element)} must be a whole number >= 0, got {text!r:.60}")
    return int(numbers[0])


class _Scene:
    """One COLLADA tree and the triangles that its scene shows."""

    def __init__(self, root: ElementTree.Element) -> None:
        self.root = root
        self.by_id: dict[tuple[str, str], list[ElementTree.Element]] = {}
        for library in _children(root, *_GEOMETRY):
            self._index(library)
        self.soups: dict[int, Array] = {}
        self.points: dict[int, Array] = {}
        self.pieces: list[Array] = []
        self.visited = self.total = 0

    def _index(self, element: ElementTree.Element) -> None:
        for child in element:
            if _name(child) not in ("extra", "technique"):  # of one program only, and not meant for others
                if (key := child.get("id")) is not None:
                    self.by_id.setdefault((_name(child), key), []).append(child)
                self._index(child)

    def triangles(self) -> Array:
        """Triangles ``(F, 3, 3)`` of the scene; none where the file has no scene."""
        for instance in [e for scene in _children(self.root, "scene") for e in scene]:
            if _name(instance) == "instance_visual_scene":
                for node in _children(self._target(instance, "visual_scene"), "node"):
                    self._node(node, np.eye(4), 0)
        return np.concatenate(self.pieces) if self.pieces else no_triangles()

    def _target(self, instance: ElementTree.Element, kind: str, attribute: str = "url") -> ElementTree.Element:
        url = instance.get(attribute, "")
        targets = self.by_id.get((kind, url[1:]), []) if url.startswith("#") else []
        if not targets:
            raise MeshRejected(f"{_name(instance)} names {url[:60]!r}, which is no {kind} of this file")
        if len(targets) > 1:
            raise MeshRejected(f"{_name(instance)} names {url[:60]!r}, which {len(targets)} of this file's {kind} have")
        return targets[0]

    def _node(self, node: ElementTree.Element, matrix: Array, depth: int) -> None:
        self.visited += 1
        if depth > _DEEPEST or self.visited > _MOST_INSTANCES:
            raise MeshRejected("nodes instanced in a cycle, or too deep or too often")
        label = str(node.get("id", node.get("name", "")))
        for transform in _children(node, *_TRANSFORMS):
            matrix = matrix @ _transform(transform, label)
        for child in node:
            name = _name(child)
            if name == "node":
                self._node(child, matrix, depth + 1)
            elif name == "instance_node":
                self._node(self._target(child, "node"), matrix, depth + 1)
            elif name == "instance_controller":
                raise MeshRejected("skinned or morphed geometry (instance_controller) is not read")
            elif name == "instance_geometry":
                soup = self._geometry(self._target(child, "geometry"))
                self.total += len(soup)
                if self.total > MOST_TRIANGLES:
                    raise MeshRejected(f"more than {MOST_TRIANGLES} triangles")
                if len(soup):
                    faces = np.arange(3 * len(soup)).reshape(-1, 3)
                    self.pieces.append(place(soup.reshape(-1, 3), faces, matrix, label))

    def _geometry(self, geometry: ElementTree.Element) -> Array:
        if id(geometry) not in self.soups:
            meshes = _children(geometry, "mesh")
            if not meshes:
                raise MeshRejected(f"geometry {geometry.get('id', '')[:60]!r} is no mesh")
            soups = [self._primitive(child) for mesh in meshes for child in _children(mesh, *_PRIMITIVES)]
            self.soups[id(geometry)] = np.concatenate(soups) if soups else no_triangles()
        return self.soups[id(geometry)]

    def _primitive(self, element: ElementTree.Element) -> Array:
        """Triangles of one primitive element of a mesh."""
        counts, corners = _polygons(element)
        if len(counts) == 0:
            return no_triangles()
        vertices = self._target(_only(element, "input", semantic="VERTEX"), "vertices", "source")
        source = self._target(_only(vertices, "input", semantic="POSITION"), "source", "source")
        if id(source) not in self.points:
            self.points[id(source)] = self._points(source)
        return triangulate(self.points[id(source)], counts, corners)

    def _points(self, source: ElementTree.Element) -> Array:
        """The positions ``(count, 3)`` of a source, as its accessor finds them in its array."""
        accessor = _only(_only(source, "technique_common"), "accessor")
        array = self._target(accessor, "float_array", "source")
        values = decimal_numbers(array.text or "")
        if len(values) != _count(array, "count"):
            raise MeshRejected(f"a float_array announces {array.get('count')} numbers and has {len(values)}")
        count, offset = _count(accessor, "count"), _count(accessor, "offset", 0)
        stride, axes = _count(accessor, "stride", 1), _axes(accessor)
        if max(axes) >= stride:
            raise MeshRejected(f"an accessor of stride {stride} has its coordinates at {axes}")
        if count and offset + (count - 1) * stride + max(axes) >= len(values):
            raise MeshRejected(f"an accessor of {count} items reaches beyond its array of {len(values)} numbers")
        points: Array = values[offset + stride * np.arange(count)[:, None] + np.array(axes)]
        return points


def _axes(accessor: ElementTree.Element) -> list[int]:
    """Where x, y and z stand in a row: by name, or, if they have other names, in the order of the named parameters."""
    names = [param.get("name", "").upper() for param in _children(accessor, "param")]
    if {"X", "Y", "Z"} <= set(names):
        return [names.index(axis) for axis in "XYZ"]
    named = [i for i, name in enumerate(names) if name]  # a parameter without a name is a number to be passed over
    if not named and _count(accessor, "stride", 1) == 3:
        return [0, 1, 2]
    if len(named) != 3:
        raise MeshRejected(f"an accessor of positions names {' '.join(names)[:60]!r}, not three coordinates")
    return named


def _polygons(element: ElementTree.Element) -> tuple[Array, Array]:
    """The sizes of a primitive's polygons, and their corners' vertex numbers one after the other."""
    name, count = _name(element), _count(element, "count")
    inputs = _children(element, "input")
    stride = 1 + max((_count(child, "offset") for child in inputs), default=0)
    lists = [whole_numbers(child.text or "") for child in _children(element, "p")]
    if _children(element, "ph"):
        raise MeshRejected("polygons with holes are not read")
    if any(len(numbers) % stride for numbers in lists):
        raise MeshRejected(f"a list of {name} that is not whole")
    lengths = np.array([len(numbers) // stride for numbers in lists], dtype=np.int64)
    corners = np.concatenate(lists).reshape(-1, stride) if lists else np.zeros((0, stride), np.int64)
    offset = _count(_only(element, "input", semantic="VERTEX"), "offset") if len(corners) else 0
    corners = corners[:, offset]
    if name == "triangles":
        if len(corners) != 3 * count:
            raise MeshRejected(f"{count} triangles are announced, {len(corners)} corners are there")
        return np.full(count, 3), corners
    if name == "polylist":
        sizes = whole_numbers(" ".join(child.text or "" for child in _children(element, "vcount")))
        if len(sizes) != count or sum(sizes.tolist()) != len(corners) or (count and sizes.min() < 3):
            raise MeshRejected(f"a polylist of {count} polygons whose sizes or corners disagree")
        return sizes, corners
    if len(lists) != count or (count and lengths.min() < 3):
        raise MeshRejected(f"{count} {name} are announced, {len(lists)} are there, or one has fewer than three corners")
    if name == "polygons":
        return lengths, corners
    if name == "tristrips":
        corners = strip_corners(corners, lengths)
    else:  # fans: the first corner, and each pair of neighbours after it
        first = np.repeat(np.cumsum(lengths) - lengths, lengths - 2)
        step = np.arange(len(first)) - np.repeat(np.cumsum(lengths - 2) - (lengths - 2), lengths - 2)
        corners = corners[np.stack([first, first + step + 1, first + step + 2], axis=-1)].ravel()
    return np.full(len(corners) // 3, 3), corners


def _transform(element: ElementTree.Element, node: str) -> Array:
    """The matrix ``(4, 4)`` of one transform of a node."""
    name, values = _name(element), decimal_numbers(element.text or "")
    where = f"the {name} of node {node[:80]!r}"
    if len(values) != _TRANSFORMS[name] or not np.isfinite(values).all():
        raise MeshRejected(f"{where} must be {_TRANSFORMS[name]} finite numbers")
    matrix = np.eye(4)
    if name == "matrix":
        matrix = values.reshape(4, 4)
        if not np.allclose(matrix[3], [0, 0, 0, 1], atol=1e-6):
            raise MeshRejected(f"{where} is not affine")
    elif name == "translate":
        matrix[:3, 3] = values
    elif name == "scale":
        matrix[:3, :3] = np.diag(values)
    elif name == "rotate":
        matrix[:3, :3] = _rotation(values[:3], np.radians(values[3]), where)
    elif name == "lookat":
        back = _unit(values[:3] - values[3:6], where)
        right = _unit(np.cross(_unit(values[6:], where), back), where)
        matrix[:3] = np.stack([right, np.cross(back, right), back, values[:3]], axis=-1)
    elif values[0] != 0:  # programs disagree about its axes and its sign
        raise MeshRejected(f"{where} is not read")
    return matrix


def _rotation(axis: Array, angle: float, where: str) -> Array:
    """Rodrigues' rotation ``(3, 3)`` by ``angle`` radians about ``axis (3,)``."""
    if angle == 0:
        return np.eye(3)
    x, y, z = _unit(axis, where)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    rotation: Array = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    return rotation


def _unit(vector: Array, where: str) -> Array:
    length = float(np.linalg.norm(vector))
    if not 1e-12 < length < np.inf:
        raise MeshRejected(f"{where} has no direction")
    unit: Array = vector / length
    return unit
