"""Exact solids by boolean trees of primitives, for what distances do not compose: sharp inner edges, hulls, bevels.

A tree is evaluated by ``manifold3d`` (``pip install unghost[recipes]``) into a watertight mesh, whose cubes are cut by
the exact voxeliser like those of any mesh; because it is watertight, they can be solid.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.errors import InvalidArgument, MissingExtra
from ...core.frames import CubeFrame, random_rotations
from ..meshes.crops import choose_frame, cut_cubes
from ..meshes.library import Mesh
from ..meshes.repair import fill_solid
from ..recipe import Recipe
from .compose import random_dilation
from .draws import log_uniform, log_whole

Array = NDArray[Any]
Occupancy = NDArray[np.bool_]

_LEAST_VOLUME = 1e-4  # of the volume of the tree's first leaf
STREAM = 0x637367  # keeps the trees apart from the samples' own generators


@dataclass(frozen=True)
class CsgSettings:
    """What a random tree is made of; ranges are log-uniform, shares are probabilities.

    Attributes:
        leaves: how many primitives.
        extent: a primitive's longest side over that of the first.
        segments: sides of what is round.
        cut_share: a primitive is taken away rather than added.
        common_share: only what two have in common is kept.
        hull_share: two are wrapped in their convex hull.
    """

    leaves: tuple[int, int] = (2, 12)
    extent: tuple[float, float] = (0.1, 1.0)
    segments: tuple[int, int] = (8, 64)
    cut_share: float = 0.4
    common_share: float = 0.08
    hull_share: float = 0.08

    def __post_init__(self) -> None:
        for name, least in (("leaves", 1), ("extent", 1e-3), ("segments", 3)):
            low, high = getattr(self, name)
            if not least <= low <= high < np.inf:
                raise InvalidArgument(
                    f"CsgSettings: {name} must be (low, high) with {least} <= low <= high, got {low, high}"
                )
        shares = (self.cut_share, self.common_share, self.hull_share)
        if min(shares) < 0 or sum(shares) > 1:
            raise InvalidArgument(f"CsgSettings: shares must be >= 0 and add to at most 1, got {shares}")


def _manifold3d() -> Any:
    try:
        import manifold3d
    except ImportError as error:
        raise MissingExtra("csg: boolean solids need manifold3d: pip install unghost[recipes]") from error
    return manifold3d


def _block(m: Any, rng: np.random.Generator, segments: int) -> Any:
    """Box, sides 0.1 to 1."""
    return m.Manifold.cube(log_uniform(rng, 0.1, 1.0, 3), True)


def _plate(m: Any, rng: np.random.Generator, segments: int) -> Any:
    """Thin box, 0.3 to 1 by 0.3 to 1 by 0.005 to 0.05."""
    return m.Manifold.cube([*log_uniform(rng, 0.3, 1.0, 2), log_uniform(rng, 0.005, 0.05)], True)


def _egg(m: Any, rng: np.random.Generator, segments: int) -> Any:
    """Ellipsoid, radii 0.1 to 0.5."""
    return m.Manifold.sphere(1.0, segments).scale(log_uniform(rng, 0.1, 0.5, 3))


def _frustum(m: Any, rng: np.random.Generator, segments: int) -> Any:
    """Cone cut short or not, radii 0.02 to 0.5, height 0.05 to 1."""
    low, high = log_uniform(rng, 0.02, 0.5, 2)
    return m.Manifold.cylinder(log_uniform(rng, 0.05, 1.0), low, high, segments, True)


def _drum(m: Any, rng: np.random.Generator, segments: int) -> Any:
    """Prism of 3 to 8 sides, or a pole: radius 0.01 to 0.5, height 0.05 to 1."""
    return m.Manifold.cylinder(
        log_uniform(rng, 0.05, 1.0), log_uniform(rng, 0.01, 0.5), -1.0, log_whole(rng, 3, 8), True
    )


def _pipe(m: Any, rng: np.random.Generator, segments: int) -> Any:
    """Open pipe, radius 0.1 to 0.5, wall 0.02 to 0.5 of it, height 0.05 to 1."""
    radius, height = log_uniform(rng, 0.1, 0.5), log_uniform(rng, 0.05, 1.0)
    bore = m.Manifold.cylinder(2 * height, radius * (1 - log_uniform(rng, 0.02, 0.5)), -1.0, segments, True)
    return m.Manifold.cylinder(height, radius, -1.0, segments, True) - bore


def _ring(m: Any, rng: np.random.Generator, segments: int) -> Any:
    """Torus, major radius 0.2 to 0.4, minor 0.03 to 0.6 of it."""
    major = log_uniform(rng, 0.2, 0.4)
    section = m.CrossSection.circle(major * log_uniform(rng, 0.03, 0.6), max(segments // 2, 3))
    return section.translate([major, 0.0]).revolve(segments)


def _crystal(m: Any, rng: np.random.Generator, segments: int) -> Any:
    """Convex hull of 5 to 16 points about a ball."""
    points = rng.normal(size=(log_whole(rng, 5, 16), 3))
    return m.Manifold.hull_points(points / np.linalg.norm(points, axis=1, keepdims=True) * 0.5)


def _twist(m: Any, rng: np.random.Generator, segments: int) -> Any:
    """Star of 3 to 9 corners, drawn up by 0.05 to 1, turned by up to 180 degrees and tapered to 0.3 to 1."""
    corners = log_whole(rng, 3, 9) * 2
    angles = np.arange(corners) * 2 * np.pi / corners
    radii = np.where(np.arange(corners) % 2, log_uniform(rng, 0.1, 0.5), 0.5)[:, None]
    section = m.CrossSection([radii * np.stack([np.cos(angles), np.sin(angles)], axis=1)])
    height, taper = log_uniform(rng, 0.05, 1.0), log_uniform(rng, 0.3, 1.0)
    turned = section.extrude(height, 12, rng.uniform(-180, 180), [taper, taper])
    return turned.translate([0.0, 0.0, -height / 2])


_LEAVES = (_block, _plate, _egg, _frustum, _drum, _pipe, _ring, _crystal, _twist)


def _leaf(m: Any, rng: np.random.Generator, settings: CsgSettings) -> Any:
    return _LEAVES[int(rng.integers(len(_LEAVES)))](m, rng, log_whole(rng, *settings.segments))


def random_solid(rng: np.random.Generator, settings: CsgSettings | None = None) -> Any:
    """A random boolean tree, evaluated: a ``manifold3d.Manifold`` about one unit across, never empty.

    Each primitive after the first is placed about the corners and edges of what is there and added, taken
    away, intersected or wrapped with it; a step that leaves next to nothing is left out.

    Raises:
        ImportError: manifold3d is not installed.

    Example:
        >>> solid = random_solid(np.random.default_rng(0))
        >>> bool(solid.volume() > 0)
        True
    """
    m, settings = _manifold3d(), settings or CsgSettings()
    whole = _leaf(m, rng, settings)
    least = _LEAST_VOLUME * whole.volume()
    count = log_whole(rng, *settings.leaves)
    upright = rng.random() < 0.34  # as furniture and rooms are
    for _ in range(count - 1):
        pose = np.empty((3, 4))
        extent = log_uniform(rng, *settings.extent)
        pose[:, :3] = (np.eye(3) if upright else random_rotations(rng, 1)[0]) * extent
        corners = whole.to_mesh64().vert_properties[:, :3]
        pose[:, 3] = corners[int(rng.integers(len(corners)))] * rng.uniform(0.3, 1.0) + rng.normal(size=3) * 0.1
        leaf, draw = _leaf(m, rng, settings).transform(pose), rng.random()
        if draw < settings.cut_share:
            found = whole - leaf
        elif draw < settings.cut_share + settings.common_share:
            found = whole ^ leaf
        elif draw < settings.cut_share + settings.common_share + settings.hull_share:
            found = m.Manifold.batch_hull([whole, leaf])
        else:
            found = whole + leaf
        if found.volume() > least:
            whole = found
    return whole


def solid_triangles(solid: Any) -> Array:
    """The triangles ``(F, 3, 3)`` float64 of a ``manifold3d.Manifold``, watertight and turned outwards.

    Example:
        >>> solid_triangles(random_solid(np.random.default_rng(0))).shape[1:]
        (3, 3)
    """
    mesh = solid.to_mesh64()
    triangles: Array = np.asarray(mesh.vert_properties, dtype=np.float64)[:, :3][np.asarray(mesh.tri_verts)]
    return triangles


@dataclass(frozen=True)
class ClosedMesh:
    """A watertight mesh of longest side 1.

    Attributes:
        mesh: what its cubes are cut from.
        triangles: ``(F, 3, 3)`` in the same coordinates, slivers too: without those it would not be closed.
    """

    mesh: Mesh
    triangles: Array

    @classmethod
    def from_solid(cls, solid: Any) -> ClosedMesh:
        """Normalise a ``manifold3d.Manifold``."""
        triangles = solid_triangles(solid)
        low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
        return cls(Mesh.from_triangles(triangles), (triangles - (low + high) / 2) / (high - low).max())


def sample_csg_cubes(
    rngs: Sequence[np.random.Generator], closed: ClosedMesh, recipe: Recipe
) -> tuple[Occupancy, list[CubeFrame]]:
    """One clean cube of a watertight mesh from each generator, ``recipe.solid_share`` of them filled.

    Returns:
        ``occupancy (N, 32, 32, 32)`` bool; the cubes in the mesh's coordinates.
    """
    frames = [choose_frame(rng, closed.mesh, recipe) for rng in rngs]
    occupancy = cut_cubes(closed.mesh, frames)
    for row, (rng, frame) in enumerate(zip(rngs, frames)):
        if rng.random() < recipe.solid_share:
            occupancy[row] = fill_solid(closed.triangles, frame, occupancy[row])
        occupancy[row] = random_dilation(rng, occupancy[row], recipe.max_dilation)
    return occupancy, frames


@lru_cache(maxsize=4)
def _mesh_at(seed: int, number: int, settings: CsgSettings) -> ClosedMesh:
    return ClosedMesh.from_solid(random_solid(np.random.default_rng([seed, number, STREAM]), settings))


def csg_cubes_at(
    rngs: Sequence[np.random.Generator],
    recipe: Recipe,
    indices: Sequence[int],
    seed: int,
    settings: CsgSettings | None = None,
) -> list[tuple[Occupancy, CubeFrame, int]]:
    """The clean cubes of samples ``indices``: occupancy, where they lay, and the number of their tree (the group).

    They lie in the coordinates of their solid, normalised as :class:`ClosedMesh` has it, where an edge length is an
    edge fraction.

    ``recipe.cubes_per_mesh`` consecutive samples share a tree, which depends on the seed and its number alone.
    """
    settings, found, start = settings or CsgSettings(), [], 0
    for number, group in itertools.groupby(indices, key=lambda index: index // recipe.cubes_per_mesh):
        stop = start + len(list(group))
        occupancy, frames = sample_csg_cubes(rngs[start:stop], _mesh_at(seed, number, settings), recipe)
        found += [(cube, frame, number) for cube, frame in zip(occupancy, frames)]
        start = stop
    return found
