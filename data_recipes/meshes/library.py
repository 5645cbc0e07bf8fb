"""Meshes: normalised, chosen by licence and split; cubes cut from them. Files are read by :mod:`.files`."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.errors import InvalidArgument, InvalidFile, MissingFile
from ..recipe import Recipe
from .box_tree import BoxTree

Array = NDArray[Any]

MANIFEST = "manifest.csv"
_MANIFEST_COLUMNS = ("path", "split", "licence")


@dataclass(frozen=True)
class Mesh:
    """A triangle soup of longest side 1, centred on the origin.

    Attributes:
        triangles: ``(F, 3, 3)``, none without area.
        normals: ``(F, 3)``, of length 1.
        cumulative_areas: ``(F,)``, ends at 1.
        tree: finds the triangles near a cube.
    """

    triangles: Array
    normals: Array
    cumulative_areas: Array
    tree: BoxTree

    @classmethod
    def from_triangles(cls, triangles: Array) -> Mesh:
        """Centre and normalise a triangle soup ``(F, 3, 3)`` of any unit; triangles without area are dropped.

        Raises:
            ValueError: wrong shape, values that are not finite, or no triangle with an area.
        """
        soup = np.asarray(triangles, dtype=np.float64)
        if soup.ndim != 3 or soup.shape[1:] != (3, 3):
            raise InvalidArgument(f"Mesh: triangles must have shape (F, 3, 3), got {soup.shape}")
        if not np.isfinite(soup).all():
            raise InvalidArgument(f"Mesh: corners must be finite, got {int((~np.isfinite(soup)).sum())} that are not")
        low, high = (soup.min(axis=(0, 1)), soup.max(axis=(0, 1))) if len(soup) else (np.zeros(3), np.zeros(3))
        extent = float((high - low).max())
        if not (np.isfinite(extent) and extent > 0):
            raise InvalidArgument(
                f"Mesh: the longest side must be finite and > 0, got {extent} from {len(soup)} triangles"
            )
        soup = (soup - (low + high) / 2) / extent
        normals = np.cross(soup[:, 1] - soup[:, 0], soup[:, 2] - soup[:, 0])
        areas = np.linalg.norm(normals, axis=1) / 2
        kept = areas > 1e-14
        if not kept.any():
            raise InvalidArgument(f"Mesh: at least one triangle must have an area, got {len(soup)} without")
        soup, areas, normals = soup[kept], areas[kept], normals[kept]
        normals /= 2 * areas[:, None]
        return cls(soup, normals, np.cumsum(areas) / areas.sum(), BoxTree.build(soup))

    def surface_point(self, rng: np.random.Generator) -> tuple[Array, Array]:
        """A point uniform in area and the unit normal of its triangle, both ``(3,)``."""
        row = min(int(np.searchsorted(self.cumulative_areas, rng.random(), side="right")), len(self.triangles) - 1)
        a, b, c = self.triangles[row]
        root, along = np.sqrt(rng.random()), rng.random()
        return (1 - root) * a + root * (1 - along) * b + root * along * c, self.normals[row]


@dataclass(frozen=True)
class MeshEntry:
    """One row of a mesh manifest: its number (the group of its cubes) and its file."""

    row: int
    path: Path


def read_manifest(content: bytes, *, where: str) -> list[dict[str, str]]:
    """The rows of a mesh manifest (CSV in UTF-8), each with a path, a split and a licence.

    Raises:
        ValueError: it is not that; the message names ``where``.
    """
    try:
        reader = csv.DictReader(io.StringIO(content.decode("utf-8"), newline=""))
        missing = [name for name in _MANIFEST_COLUMNS if name not in (reader.fieldnames or ())]
        if missing:
            raise InvalidFile(f"select_meshes: {where} lacks the columns {', '.join(missing)}")
        rows = list(reader)
    except (csv.Error, UnicodeDecodeError) as error:
        raise InvalidFile(f"select_meshes: {where} is not CSV in UTF-8 ({error})") from None
    for number, row in enumerate(rows):
        if None in row or None in [row[name] for name in _MANIFEST_COLUMNS]:
            raise InvalidFile(f"select_meshes: row {number} of {where} has more or fewer columns than its head")
    return rows


def select_meshes(recipe: Recipe, mesh_root: str | Path) -> list[MeshEntry]:
    """The meshes of ``mesh_root/manifest.csv`` whose licence, split and format the recipe names, in its order.

    Raises:
        FileNotFoundError: no manifest.
        ValueError: a column is missing, a path leaves the folder, or nothing is left.
    """
    manifest = Path(mesh_root) / MANIFEST
    if not manifest.is_file():
        raise MissingFile(
            f"select_meshes: {manifest} is not a file: a folder of meshes needs one that lists them, with the columns "
            f"{', '.join(_MANIFEST_COLUMNS)}"
        )
    rows = read_manifest(manifest.read_bytes(), where=str(manifest))
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
            raise InvalidFile(f"select_meshes: row {entry.row} of {manifest} leaves the folder: {named}")
    if not entries:
        raise InvalidArgument(
            f"select_meshes: no mesh of {manifest} has split {recipe.split!r}, a licence of {list(recipe.licences)} "
            f"and a format of {list(recipe.formats)}"
        )
    return entries
