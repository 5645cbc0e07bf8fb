"""Cubes of meshes: reading, choosing by licence and split, cutting.

Mesh files need ``trimesh`` (``pip install unghost[recipes]``); everything after reading does not.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.frames import CubeFrame, random_rotations
from .compose import draw_offset, random_dilation
from .primitives import log_uniform
from .recipe import Recipe
from .voxelize import voxelize_triangles

Array = NDArray[Any]
Occupancy = NDArray[np.bool_]

MANIFEST = "manifest.csv"
_MANIFEST_COLUMNS = ("path", "split", "licence")
_MESH_STREAM = 0x6D657368  # keeps the order of meshes apart from the samples' own generators


@dataclass(frozen=True)
class Mesh:
    """A triangle soup of longest side 1, centred on the origin.

    Attributes:
        triangles: ``(F, 3, 3)``, none without area.
        centroids: ``(F, 3)``.
        reaches: ``(F,)``, the distance from a triangle's centroid to its furthest corner.
        cumulative_areas: ``(F,)``, ends at 1.
    """

    triangles: Array
    centroids: Array
    reaches: Array
    cumulative_areas: Array

    @classmethod
    def from_triangles(cls, triangles: Array) -> Mesh:
        """Centre and normalise a triangle soup ``(F, 3, 3)`` of any unit; triangles without area are dropped.

        Raises:
            ValueError: wrong shape, values that are not finite, or no triangle with an area.
        """
        soup = np.asarray(triangles, dtype=np.float64)
        if soup.ndim != 3 or soup.shape[1:] != (3, 3):
            raise ValueError(f"Mesh: triangles must have shape (F, 3, 3), got {soup.shape}")
        if not np.isfinite(soup).all():
            raise ValueError(f"Mesh: corners must be finite, got {int((~np.isfinite(soup)).sum())} that are not")
        low, high = (soup.min(axis=(0, 1)), soup.max(axis=(0, 1))) if len(soup) else (np.zeros(3), np.zeros(3))
        extent = float((high - low).max())
        if not (np.isfinite(extent) and extent > 0):
            raise ValueError(f"Mesh: the longest side must be finite and > 0, got {extent} from {len(soup)} triangles")
        soup = (soup - (low + high) / 2) / extent
        areas = np.linalg.norm(np.cross(soup[:, 1] - soup[:, 0], soup[:, 2] - soup[:, 0]), axis=1) / 2
        kept = areas > 1e-14
        if not kept.any():
            raise ValueError(f"Mesh: at least one triangle must have an area, got {len(soup)} without")
        soup, areas = soup[kept], areas[kept]
        centroids = soup.mean(axis=1)
        reaches = np.linalg.norm(soup - centroids[:, None], axis=2).max(axis=1)
        return cls(soup, centroids, reaches, np.cumsum(areas) / areas.sum())

    def surface_point(self, rng: np.random.Generator) -> tuple[Array, Array]:
        """A point uniform in area and the unit normal of its triangle, both ``(3,)``."""
        row = min(int(np.searchsorted(self.cumulative_areas, rng.random(), side="right")), len(self.triangles) - 1)
        a, b, c = self.triangles[row]
        root, along = np.sqrt(rng.random()), rng.random()
        normal = np.cross(b - a, c - a)
        return (1 - root) * a + root * (1 - along) * b + root * along * c, normal / np.linalg.norm(normal)

    def voxelize(self, frame: CubeFrame) -> Occupancy:
        """Exact occupancy ``(32, 32, 32)`` of the surface in a cube."""
        reach = self.reaches + frame.edge_length * np.sqrt(3.0) / 2
        offsets = self.centroids - frame.center
        near = np.einsum("fi,fi->f", offsets, offsets) <= reach**2
        return voxelize_triangles(frame.to_local(self.triangles[near]))


def load_mesh(path: str | Path) -> Mesh:
    """Read any format that trimesh reads, with the transforms of scene nodes applied, normalised to longest side 1.

    Raises:
        FileNotFoundError: no such file.
        ImportError: trimesh is not installed.
        ValueError: not readable as a mesh, without triangles, or with corners that are not finite.
    """
    source = Path(path)
    if not source.is_file():
        raise FileNotFoundError(f"load_mesh: {source} is not a file")
    try:
        import trimesh
    except ImportError as error:
        raise ImportError("load_mesh: reading meshes needs trimesh: pip install unghost[recipes]") from error
    try:
        scene = trimesh.load_scene(source, process=False, skip_materials=True)
        soup = [
            trimesh.transform_points(np.asarray(geometry.vertices), scene.graph.get(node)[0])[geometry.faces]
            for node in scene.graph.nodes_geometry
            if isinstance(geometry := scene.geometry[scene.graph[node][1]], trimesh.Trimesh)
        ]
    except Exception as error:  # readers of a dozen formats raise whatever they like
        raise ValueError(f"load_mesh: cannot read {source} ({type(error).__name__}: {error})") from error
    try:
        return Mesh.from_triangles(np.concatenate(soup) if soup else np.zeros((0, 3, 3)))
    except ValueError as error:
        raise ValueError(f"load_mesh: {source}: {error}") from None


@dataclass(frozen=True)
class MeshEntry:
    """One row of a mesh manifest: its number (the group of its cubes) and its file."""

    row: int
    path: Path


def select_meshes(recipe: Recipe, mesh_root: str | Path) -> list[MeshEntry]:
    """The meshes of ``mesh_root/manifest.csv`` whose licence, split and format the recipe names, in its order.

    Raises:
        FileNotFoundError: no manifest.
        ValueError: a column is missing, a path leaves the folder, or nothing is left.
    """
    manifest = Path(mesh_root) / MANIFEST
    if not manifest.is_file():
        raise FileNotFoundError(f"select_meshes: {manifest} is not a file")
    with manifest.open(encoding="utf-8", newline="") as stream:
        reader = csv.DictReader(stream)
        missing = [name for name in _MANIFEST_COLUMNS if name not in (reader.fieldnames or ())]
        if missing:
            raise ValueError(f"select_meshes: {manifest} lacks the columns {', '.join(missing)}")
        rows = list(reader)
    entries = [
        MeshEntry(number, Path(mesh_root) / row["path"])
        for number, row in enumerate(rows)
        if row["split"] == recipe.split
        and row["licence"] in recipe.licences
        and Path(row["path"]).suffix.lower().lstrip(".") in recipe.formats
    ]
    for entry in entries:
        named = Path(rows[entry.row]["path"])
        if named.is_absolute() or ".." in named.parts:
            raise ValueError(f"select_meshes: row {entry.row} of {manifest} leaves the folder: {named}")
    if not entries:
        raise ValueError(
            f"select_meshes: no mesh of {manifest} has split {recipe.split!r}, a licence of {list(recipe.licences)} "
            f"and a format of {list(recipe.formats)}"
        )
    return entries


def sample_mesh_cube(rng: np.random.Generator, mesh: Mesh, recipe: Recipe) -> tuple[Occupancy, CubeFrame, float]:
    """One clean cube of a mesh.

    The centre is a point uniform in area, moved as the recipe says (on, near, away); the rotation is uniform on
    SO(3); the edge log-uniform. Empty cubes lie beside the mesh.

    Returns:
        ``occupancy (32, 32, 32)`` bool, dilated 0 to ``recipe.max_dilation`` times; the cube in the mesh's
        (normalised) coordinates; its edge over the mesh's longest side.
    """
    fraction = log_uniform(rng, *recipe.edge_fraction)
    empty = rng.random() < recipe.empty_share
    point, normal = mesh.surface_point(rng)
    center = point + draw_offset(rng, recipe, normal) * fraction
    rotation = random_rotations(rng, 1)[0]
    if empty:
        center = center + rotation[:, 0] * (1.8 + fraction)  # longer than the diagonal of the mesh's box
    frame = CubeFrame(center, fraction, rotation)
    return random_dilation(rng, mesh.voxelize(frame), recipe.max_dilation), frame, fraction


@lru_cache(maxsize=8)
def _cached_selection(recipe: Recipe, mesh_root: str) -> tuple[MeshEntry, ...]:
    return tuple(select_meshes(recipe, mesh_root))


@lru_cache(maxsize=16)
def _cached_mesh(path: Path) -> Mesh:
    return load_mesh(path)


def mesh_cube_at(
    rng: np.random.Generator, recipe: Recipe, mesh_root: str, index: int, seed: int
) -> tuple[Occupancy, float, int]:
    """The clean cube of sample ``index``: occupancy, edge fraction, and its mesh's row in the manifest.

    ``recipe.cubes_per_mesh`` consecutive samples share a mesh; the meshes come in an order shuffled anew each
    time all have been used.
    """
    entries = _cached_selection(recipe, mesh_root)
    turn, place = divmod(index // recipe.cubes_per_mesh, len(entries))
    order = np.random.default_rng([seed, turn, _MESH_STREAM]).permutation(len(entries))
    entry = entries[int(order[place])]
    occupancy, _, fraction = sample_mesh_cube(rng, _cached_mesh(entry.path), recipe)
    return occupancy, fraction, entry.row
