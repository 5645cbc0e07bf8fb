"""Meshes as solids of a scene: signed distances on a grid, whether the mesh is closed or not.

A mesh may be a soup of sheets, so that "inside" is not asked of its faces. The solid is everything within half a
skin of a face, and whatever cannot be reached from outside without crossing one: a closed box is full, an open one is
a box of thick walls.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.distances.sampled import SampledDistance
from ...core.errors import InvalidArgument, needs_extra
from ..recipe import load_recipe
from .sources import open_library

CELLS = 72  # along the longest side
SKIN = 1.0  # half thickness of a face, in cells: less, and a thin sheet would have holes between the nodes
MARGIN = 3  # nodes beyond the mesh on every side


def solid_from_triangles(triangles: NDArray[Any], *, cells: int = CELLS) -> SampledDistance:
    """The signed distance of a triangle soup, on a grid about it.

    Args:
        triangles: ``(F, 3, 3)``, any unit, none without area.
        cells: of the grid along the mesh's longest side.

    Raises:
        ValueError: fewer than 4 cells, or a soup without extent.
    """
    with needs_extra("recipes", caller="solid_from_triangles"):
        from scipy.ndimage import label

    soup = np.asarray(triangles, dtype=np.float32)
    if cells < 4:
        raise InvalidArgument(f"solid_from_triangles: cells must be >= 4, got {cells}")
    low, high = soup.min(axis=(0, 1)).astype(np.float64), soup.max(axis=(0, 1)).astype(np.float64)
    pitch = float((high - low).max()) / cells
    if not 0 < pitch < np.inf:
        raise InvalidArgument(f"solid_from_triangles: triangles must have an extent, got {pitch * cells}")
    start = low - MARGIN * pitch
    counts = np.ceil((high - low) / pitch).astype(int) + 2 * MARGIN + 1
    nodes = np.stack(np.meshgrid(*(start[a] + pitch * np.arange(counts[a]) for a in range(3)), indexing="ij"), axis=-1)
    distance = _distances(soup, nodes.astype(np.float32))
    pieces, _ = label(distance > SKIN * pitch)
    outside = (pieces == pieces[0, 0, 0]) | (distance <= SKIN * pitch)
    values = np.where(outside, distance, -distance) - SKIN * pitch
    return SampledDistance(values.astype(np.float32), start, pitch)


def _distances(soup: NDArray[np.float32], positions: NDArray[np.float32]) -> NDArray[np.float32]:
    """Unsigned distance of ``positions (..., 3)`` to the triangles ``(F, 3, 3)``."""
    open3d: Any = importlib.import_module("open3d")
    scene = open3d.t.geometry.RaycastingScene(nthreads=1)
    corners = open3d.core.Tensor(np.ascontiguousarray(soup.reshape(-1, 3)))
    scene.add_triangles(corners, open3d.core.Tensor(np.arange(3 * len(soup), dtype=np.uint32).reshape(-1, 3)))
    distance: NDArray[np.float32] = scene.compute_distance(open3d.core.Tensor(positions), nthreads=1).numpy()
    return distance


def draw_objects(
    rng: np.random.Generator, mesh_root: str | Path, count: int
) -> tuple[list[SampledDistance], list[dict[str, Any]]]:
    """Some meshes of a folder's train split as solids of longest side 1, and where each comes from.

    Only such licences and splits as the ``meshes`` recipe allows; a mesh that cannot be read is passed over.

    Args:
        rng: of the choice.
        mesh_root: a folder with its ``manifest.csv``.
        count: how many, >= 0.

    Returns:
        The solids, and for each ``{"path", "sha256", "licence", "row"}``.

    Raises:
        FileNotFoundError, ValueError: no manifest, or no mesh that can be used.
    """
    library = open_library(load_recipe("meshes"), mesh_root)
    solids, sources = [], []
    for place in rng.integers(2**31, size=count):
        entry, mesh = library.mesh(int(place))
        solids.append(solid_from_triangles(mesh.triangles))
        sources.append(library.sources[entry.row])
    return solids, sources
