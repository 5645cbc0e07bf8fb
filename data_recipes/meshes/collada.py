"""COLLADA (.dae): XML without declarations, stripped to its geometry, counted, and only then read by trimesh.

trimesh leaves out, without a word, each geometry whose material or source it cannot resolve. So materials, images,
effects, cameras, lights and animations are removed first, and the triangles that the scene must have are counted
on the way. Of the 26 files of the hostile and the ordinary mesh sets, trimesh (5.2.0) alone gives nothing for 3 that
have triangles. Needs ``pycollada`` (``pip install unghost[recipes]``).
"""

from __future__ import annotations

from importlib.util import find_spec
from xml.etree import ElementTree
from xml.parsers import expat

from ...core.errors import MissingExtra
from .reading import Array, MeshRejected, no_triangles, trimesh_triangles

_REMOVED = frozenset(
    {
        "library_materials",
        "library_effects",
        "library_images",
        "library_cameras",
        "library_lights",
        "library_animations",
        "library_animation_clips",
        "library_physics_materials",
        "library_physics_models",
        "library_physics_scenes",
        "library_force_fields",
        "bind_material",
        "instance_camera",
        "instance_light",
        "instance_physics_scene",
        "extra",
    }
)
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


def read_dae(data: bytes) -> Array:
    """Triangles of a COLLADA file's scene.

    Raises:
        ImportError: pycollada is not installed.
        MeshRejected: XML as :func:`check_xml`, a reference that leads nowhere, a cycle of nodes, index lists that
            disagree with their counts, polygons with holes, skinned or spline geometry, or fewer triangles read
            than counted.
    """
    check_xml(data)
    root = ElementTree.fromstring(data)
    if _name(root) != "COLLADA":
        raise MeshRejected(f"XML of {_name(root)[:40]!r}, not COLLADA")
    _strip(root)
    try:
        expected = _Census(root).total()
    except (ValueError, TypeError, AttributeError) as error:
        if isinstance(error, MeshRejected):
            raise
        raise MeshRejected(f"malformed COLLADA ({type(error).__name__}: {str(error)[:100]})") from error
    if expected == 0:
        return no_triangles()
    if find_spec("collada") is None:
        raise MissingExtra("reading .dae needs pycollada: pip install unghost[recipes]")
    triangles = trimesh_triangles(ElementTree.tostring(root), "dae")
    if len(triangles) != expected:
        raise MeshRejected(f"{expected} triangles are in the scene, {len(triangles)} were read")
    return triangles


def _name(element: ElementTree.Element) -> str:
    return str(element.tag).rsplit("}", 1)[-1]


def _strip(element: ElementTree.Element) -> None:
    for child in list(element):
        if _name(child) in _REMOVED:
            element.remove(child)
        else:
            _strip(child)


def _words(element: ElementTree.Element) -> list[str]:
    return (element.text or "").split()


class _Census:
    """Counts the triangles of a COLLADA scene from its XML alone."""

    def __init__(self, root: ElementTree.Element) -> None:
        self.root = root
        self.by_id = {
            (_name(element), element.get("id")): element for element in root.iter() if element.get("id") is not None
        }
        self.counts: dict[str, int] = {}
        self.visited = 0

    def total(self) -> int:
        """Triangles of the scene; 0 where the file has no scene."""
        instances = [e for scene in self.root if _name(scene) == "scene" for e in scene]
        scenes = [self._target(e, "visual_scene") for e in instances if _name(e) == "instance_visual_scene"]
        return sum(self._node(node, 0) for scene in scenes for node in scene if _name(node) == "node")

    def _target(self, instance: ElementTree.Element, kind: str) -> ElementTree.Element:
        url = instance.get("url", "")
        if not url.startswith("#") or (kind, url[1:]) not in self.by_id:
            raise MeshRejected(f"{_name(instance)} names {url[:60]!r}, which is no {kind} of this file")
        return self.by_id[kind, url[1:]]

    def _node(self, node: ElementTree.Element, depth: int) -> int:
        self.visited += 1
        if depth > _DEEPEST or self.visited > _MOST_INSTANCES:
            raise MeshRejected("nodes instanced in a cycle, or too deep or too often")
        total = 0
        for child in node:
            name = _name(child)
            if name == "node":
                total += self._node(child, depth + 1)
            elif name == "instance_node":
                total += self._node(self._target(child, "node"), depth + 1)
            elif name == "instance_geometry":
                total += self._geometry(self._target(child, "geometry"))
            elif name == "instance_controller":
                raise MeshRejected("skinned or morphed geometry (instance_controller) is not read")
        return total

    def _geometry(self, geometry: ElementTree.Element) -> int:
        key = str(geometry.get("id"))
        if key not in self.counts:
            meshes = [child for child in geometry if _name(child) == "mesh"]
            if not meshes:
                raise MeshRejected(f"geometry {key[:60]!r} is no mesh")
            self.counts[key] = sum(_primitive(child) for mesh in meshes for child in mesh)
        return self.counts[key]


def _primitive(element: ElementTree.Element) -> int:
    """Triangles of one primitive element of a mesh; 0 for sources, lines and all else."""
    name = _name(element)
    if name not in ("triangles", "polylist", "polygons", "tristrips", "trifans"):
        return 0
    stride = 1 + max((int(child.get("offset", "0")) for child in element if _name(child) == "input"), default=0)
    lists = [_words(child) for child in element if _name(child) == "p"]
    if any(_name(child) == "ph" for child in element):
        raise MeshRejected("polygons with holes are not read")
    if any(len(words) % stride for words in lists):
        raise MeshRejected(f"a list of {name} that is not whole")
    corners = [len(words) // stride for words in lists]
    count = int(element.get("count", "0"))
    if name == "triangles":
        if sum(corners) != 3 * count:
            raise MeshRejected(f"{count} triangles are announced, {sum(corners)} corners are there")
        return count
    if name == "polylist":
        sizes = [int(word) for child in element if _name(child) == "vcount" for word in _words(child)]
        if len(sizes) != count or sum(sizes) != sum(corners) or min(sizes, default=3) < 3:
            raise MeshRejected(f"a polylist of {count} polygons whose sizes or corners disagree")
        return sum(sizes) - 2 * count
    if min(corners, default=3) < 3:
        raise MeshRejected(f"{name} with fewer than three corners")
    return sum(corners) - 2 * len(corners)
