"""Messy meshes made whole (pymeshlab), and the inside of whole ones filled: both options, neither done unasked.

Repair closes holes and cracks, turns faces the same way and drops doubles; it can also remesh to even triangles.
A solid has an inside only where its surface is closed: :func:`fill_solid` says so instead of guessing. Needs
``pip install unghost[recipes]``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.errors import InvalidArgument, MissingExtra
from ...core.frames import CubeFrame

Array = NDArray[Any]
Occupancy = NDArray[np.bool_]

RULES = ("winding", "signed_distance")
_BLOCK = 1 << 18  # pairs of point and triangle worked on at once, which bounds memory
_EXTRA = "pip install unghost[recipes]"


@dataclass(frozen=True)
class Topology:
    """How whole a surface is; its corners are joined where their coordinates are equal.

    Attributes:
        faces: triangles.
        boundary_edges: edges of one triangle.
        nonmanifold_edges: edges of more than two.
        turned_edges: edges of two triangles that face opposite ways.
        unbalanced_edges: edges not run along equally often in both directions: 0 means that the surface has no rim
            and a winding number that is whole everywhere.
    """

    faces: int
    boundary_edges: int
    nonmanifold_edges: int
    turned_edges: int
    unbalanced_edges: int

    @property
    def closed(self) -> bool:
        """Whether the surface bounds something: the winding number is whole at every point off it."""
        return self.faces > 0 and self.unbalanced_edges == 0


def topology(triangles: Array) -> Topology:
    """Count the edges of a triangle soup ``(F, 3, 3)`` by what they lack; triangles with equal corners do not count.

    Raises:
        ValueError: wrong shape or values that are not finite.
    """
    _, faces = _weld(_checked(triangles, "topology"))
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    if len(faces) == 0:
        return Topology(0, 0, 0, 0, 0)
    edges = np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2)
    forward = edges[:, 0] < edges[:, 1]
    _, owner, uses = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True, return_counts=True)
    balance = np.bincount(owner.ravel(), weights=np.where(forward, 1, -1))
    return Topology(
        len(faces),
        int((uses == 1).sum()),
        int((uses > 2).sum()),
        int(((uses == 2) & (balance != 0)).sum()),
        int((balance != 0).sum()),
    )


@dataclass(frozen=True)
class RepairOptions:
    """What repairing does; lengths are shares of the mesh's longest side.

    Attributes:
        merge_distance: vertices nearer than this become one, in [0, 0.01]; 0 joins equal ones only.
        largest_hole: holes of at most so many edges are closed, >= 0; 0 closes none.
        orient: turn neighbouring faces the same way.
        remesh_edge: edges to remesh to, in [0.001, 0.5]; 0 keeps the triangles as they are.
        remesh_rounds: iterations of remeshing, in [1, 20].

    Raises:
        ValueError: a value outside its range.
    """

    merge_distance: float = 1e-5
    largest_hole: int = 64
    orient: bool = True
    remesh_edge: float = 0.0
    remesh_rounds: int = 5

    def __post_init__(self) -> None:
        ranges = {
            "merge_distance": 0 <= self.merge_distance <= 0.01,
            "largest_hole": self.largest_hole >= 0,
            "remesh_edge": self.remesh_edge == 0 or 0.001 <= self.remesh_edge <= 0.5,
            "remesh_rounds": 1 <= self.remesh_rounds <= 20,
        }
        for name, fits in ranges.items():
            if not fits:
                raise InvalidArgument(f"RepairOptions: {name} is outside its range, got {getattr(self, name)}")


@dataclass(frozen=True)
class Repaired:
    """A repaired surface ``triangles (G, 3, 3)`` and how whole it was and is."""

    triangles: Array
    before: Topology
    after: Topology


def repair_triangles(triangles: Array, *, options: RepairOptions | None = None) -> Repaired:
    """Repair a triangle soup with pymeshlab: doubles out, cracks and holes closed, faces turned the same way.

    Edges of more than two faces are cut apart rather than their faces removed, so no surface is lost. pymeshlab is
    native code: for files that may be hostile, ask :class:`~.guard.MeshGuard` to repair.

    Args:
        triangles: ``(F, 3, 3)``, any unit.
        options: what to do.

    Raises:
        ImportError: pymeshlab is not installed.
        RuntimeError: pymeshlab fails.
        ValueError: wrong shape, values that are not finite, no extent, or nothing left.
    """
    try:
        import pymeshlab
    except ImportError as error:
        raise MissingExtra(f"repair_triangles: repairing needs pymeshlab: {_EXTRA}") from error
    options = options or RepairOptions()
    soup = _checked(triangles, "repair_triangles")
    vertices, faces = _weld(soup)
    extent = float(np.ptp(vertices, axis=0).max()) if len(vertices) else 0.0
    if not (math.isfinite(extent) and extent > 0):
        raise InvalidArgument(f"repair_triangles: the longest side must be finite and > 0, got {extent}")
    middle = vertices.mean(axis=0)
    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.add_mesh(pymeshlab.Mesh((vertices - middle) / extent, faces.astype(np.int32)))
    for name, arguments in _steps(options, pymeshlab):
        if meshes.current_mesh().face_number() == 0:
            break
        try:
            meshes.apply_filter(name, **arguments)
        except pymeshlab.PyMeshLabException as error:
            raise RuntimeError(f"repair_triangles: pymeshlab cannot {name} ({str(error).strip()[:200]})") from error
    mesh = meshes.current_mesh()
    repaired = np.asarray(mesh.vertex_matrix(), dtype=np.float64)[mesh.face_matrix()] * extent + middle
    if len(repaired) == 0 or not np.isfinite(repaired).all():
        raise InvalidArgument(f"repair_triangles: nothing sound is left of {len(soup)} triangles")
    return Repaired(repaired, topology(soup), topology(repaired))


def _steps(options: RepairOptions, pymeshlab: Any) -> list[tuple[str, dict[str, Any]]]:
    """The filters, in their order, with their arguments; the mesh's longest side is 1."""
    steps: list[tuple[str, dict[str, Any]]] = []
    if options.merge_distance:
        steps.append(("meshing_merge_close_vertices", {"threshold": pymeshlab.PureValue(options.merge_distance)}))
    steps += [
        ("meshing_remove_null_faces", {}),
        ("meshing_remove_duplicate_faces", {}),
        ("meshing_remove_unreferenced_vertices", {}),
        ("meshing_repair_non_manifold_edges", {"method": "Split Vertices"}),
        ("meshing_repair_non_manifold_vertices", {"vertdispratio": 0.0}),
    ]
    if options.orient:
        steps.append(("meshing_re_orient_faces_coherently", {}))
    if options.largest_hole:
        steps.append(("meshing_close_holes", {"maxholesize": options.largest_hole + 1, "newfaceselected": False}))
    if options.remesh_edge:
        steps.append(
            (
                "meshing_isotropic_explicit_remeshing",
                {"iterations": options.remesh_rounds, "targetlen": pymeshlab.PureValue(options.remesh_edge)},
            )
        )
    return steps


def winding_numbers(points: Array, triangles: Array) -> Array:
    """How often a surface winds around points: whole off a closed surface, a fraction near an open one.

    The sum of the triangles' solid angles over 4 pi (van Oosterom and Strackee 1983).

    Args:
        points: ``(N, 3)``.
        triangles: ``(F, 3, 3)``; their sense counts, outward being positive.

    Returns:
        ``(N,)`` float64.

    Raises:
        ValueError: wrong shapes or values that are not finite.
    """
    soup = _checked(triangles, "winding_numbers")
    points = np.asarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise InvalidArgument(f"winding_numbers: points must be finite of shape (N, 3), got {points.shape}")
    result = np.zeros(len(points))
    for i in range(len(points)):
        for start in range(0, len(soup), _BLOCK):
            a, b, c = np.moveaxis(soup[start : start + _BLOCK] - points[i], 1, 0)
            la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
            volume = np.einsum("fi,fi->f", a, np.cross(b, c))
            dots = [np.einsum("fi,fi->f", u, v) for u, v in ((a, b), (b, c), (c, a))]
            result[i] += np.arctan2(volume, la * lb * lc + dots[0] * lc + dots[1] * la + dots[2] * lb).sum()
    return result / (2 * np.pi)


def fill_solid(triangles: Array, frame: CubeFrame, surface: Occupancy, *, rule: str = "winding") -> Occupancy:
    """Occupancy of a cube with the inside of a closed surface filled.

    A voxel off the surface is inside where the winding number is not 0, so the overlap of closed parts is inside,
    a part within a part is solid, and one turned inwards is a cavity. Voxels that face each other and are both off
    the surface lie on the same side of it: one point decides for a whole connected region. The rule
    ``"signed_distance"`` asks open3d at every voxel instead; it counts the crossings of a ray, so that what two
    parts share counts as outside, and a ray that meets an edge exactly can miscount.

    Args:
        triangles: ``(F, 3, 3)`` of the whole mesh, in the frame's world.
        frame: the cube.
        surface: ``(R, R, R)`` bool, all voxels that the surface touches (undilated).
        rule: ``"winding"`` or ``"signed_distance"``.

    Returns:
        ``(R, R, R)`` bool, ``surface`` and the inside.

    Raises:
        ImportError: scipy (or open3d, for the second rule) is not installed.
        ValueError: an unknown rule, a bad shape, or a surface that is not closed: there is no inside then.
    """
    if rule not in RULES:
        raise InvalidArgument(f"fill_solid: rule must be one of {', '.join(RULES)}, got {rule!r}")
    if surface.ndim != 3 or len(set(surface.shape)) != 1 or surface.dtype != bool:
        raise InvalidArgument(
            f"fill_solid: surface must be bool of shape (R, R, R), got {surface.dtype} {surface.shape}"
        )
    soup = _checked(triangles, "fill_solid")
    whole = topology(soup)
    if not whole.closed:
        raise InvalidArgument(
            f"fill_solid: the surface must be closed, got {whole.unbalanced_edges} edges that are not balanced "
            f"({whole.boundary_edges} of one triangle, {whole.turned_edges} between triangles that face opposite ways)"
        )
    centers = frame.lattice(len(surface))
    inside = _by_regions(soup, centers, surface) if rule == "winding" else _by_distance(soup, centers, surface)
    filled: Occupancy = surface | inside
    return filled


def _by_regions(soup: Array, centers: Array, surface: Occupancy) -> Occupancy:
    """Whether each connected region of voxels off the surface is inside, by the winding number at its deepest voxel."""
    try:
        from scipy import ndimage
    except ImportError as error:
        raise MissingExtra(f"fill_solid: filling needs scipy: {_EXTRA}") from error
    regions, count = ndimage.label(~surface)
    if count == 0:
        return np.zeros_like(surface)
    depth = ndimage.distance_transform_cdt(np.pad(~surface, 1))[1:-1, 1:-1, 1:-1]
    deepest = np.array(ndimage.maximum_position(depth, regions, np.arange(1, count + 1)))
    winding = np.rint(winding_numbers(centers[tuple(deepest.T)], soup))
    inside: Occupancy = np.concatenate([[False], winding != 0])[regions]
    return inside


def _by_distance(soup: Array, centers: Array, surface: Occupancy) -> Occupancy:
    """Voxels off the surface whose signed distance (open3d, the majority of three rays) is negative."""
    try:
        import open3d
    except ImportError as error:
        raise MissingExtra(f"fill_solid: rule='signed_distance' needs open3d: {_EXTRA}") from error
    vertices, faces = _weld(soup)
    scene = open3d.t.geometry.RaycastingScene()
    tensor: Any = open3d.core.Tensor
    scene.add_triangles(tensor(vertices.astype(np.float32)), tensor(faces.astype(np.uint32)))
    inside: Occupancy = np.zeros_like(surface)
    queries = tensor(np.ascontiguousarray(centers[~surface], dtype=np.float32))
    inside[~surface] = scene.compute_signed_distance(queries, nsamples=3).numpy() < 0
    return inside


def _weld(soup: Array) -> tuple[Array, Array]:
    """Vertices ``(V, 3)`` and faces ``(F, 3)``, corners of equal coordinates being one vertex."""
    vertices, owner = np.unique(soup.reshape(-1, 3) + 0.0, axis=0, return_inverse=True)
    return vertices, owner.reshape(-1, 3)


def _checked(triangles: Array, caller: str) -> Array:
    soup = np.asarray(triangles, dtype=np.float64)
    if soup.ndim != 3 or soup.shape[1:] != (3, 3):
        raise InvalidArgument(f"{caller}: triangles must have shape (F, 3, 3), got {soup.shape}")
    if not np.isfinite(soup).all():
        raise InvalidArgument(f"{caller}: triangles must be finite, got {int((~np.isfinite(soup)).sum())} other values")
    return soup
