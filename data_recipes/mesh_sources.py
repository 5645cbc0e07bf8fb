"""Which mesh each sample of a recipe is cut from, and what is known of it: path, hash, licence.

A mesh that cannot be used costs that mesh: the next one in the order takes its samples, and it is reported.
"""

from __future__ import annotations

import csv
import hashlib
import io
import itertools
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.frames import CubeFrame
from .crops import sample_mesh_cubes
from .meshes import MANIFEST, Mesh, MeshEntry, load_mesh, select_meshes
from .recipe import Recipe

MESH_STREAM = 0x6D657368  # keeps the order of meshes apart from the samples' own generators
CACHED_MESHES = 16


@dataclass(frozen=True)
class MeshCube:
    """A clean cube ``occupancy (32, 32, 32)``, where it lay in its normalised mesh, and the mesh's manifest row."""

    occupancy: NDArray[np.bool_]
    frame: CubeFrame
    row: int


class MeshLibrary:
    """The meshes that a recipe may use, and what became of those that were opened.

    Attributes:
        entries: in the order of the manifest.
        manifest_sha256: of ``manifest.csv``.
        sources: row to ``{"path", "sha256", "licence", "row"}``, of the meshes loaded so far.
        rejected: row to ``{"path", "reason", "row"}``, of the meshes found unusable so far.
    """

    def __init__(self, recipe: Recipe, mesh_root: str | Path) -> None:
        self.recipe, self.root = recipe, Path(mesh_root)
        self.entries: list[MeshEntry] = select_meshes(recipe, mesh_root)
        content = (self.root / MANIFEST).read_bytes()
        self.manifest_sha256 = hashlib.sha256(content).hexdigest()
        self._rows = list(csv.DictReader(io.StringIO(content.decode("utf-8"), newline="")))
        self.sources: dict[int, dict[str, Any]] = {}
        self.rejected: dict[int, dict[str, Any]] = {}
        self._meshes: OrderedDict[int, Mesh] = OrderedDict()

    def candidates(self, index: int, seed: int) -> Iterator[MeshEntry]:
        """The mesh of sample ``index``, then those that take its place if it is unusable.

        ``recipe.cubes_per_mesh`` consecutive samples share a mesh; the meshes come in an order shuffled anew each
        time all have been used.
        """
        turn, place = divmod(index // self.recipe.cubes_per_mesh, len(self.entries))
        order = np.random.default_rng([seed, turn, MESH_STREAM]).permutation(len(self.entries))
        for step in range(len(self.entries)):
            yield self.entries[int(order[(place + step) % len(self.entries)])]

    def _relative(self, entry: MeshEntry) -> str:
        return Path(self._rows[entry.row]["path"]).as_posix()

    def _load(self, entry: MeshEntry) -> Mesh | None:
        """The mesh, or None if it is unusable; either way its fate is on record."""
        if entry.row in self.rejected:
            return None
        if entry.row in self._meshes:
            self._meshes.move_to_end(entry.row)
            return self._meshes[entry.row]
        path, row = self._relative(entry), self._rows[entry.row]
        try:
            digest = hashlib.sha256(entry.path.read_bytes()).hexdigest()
            if row.get("sha256") not in (None, "", digest):
                raise ValueError(f"its sha256 is {digest}, {MANIFEST} says {row['sha256']}")
            mesh = load_mesh(entry.path)
        except (ValueError, FileNotFoundError) as error:
            reason = " ".join(str(error).replace(str(entry.path), path).replace(str(self.root), "").split())
            self.rejected[entry.row] = {"path": path, "reason": reason, "row": entry.row}
            return None
        self.sources[entry.row] = {"path": path, "sha256": digest, "licence": row["licence"], "row": entry.row}
        self._meshes[entry.row] = mesh
        if len(self._meshes) > CACHED_MESHES:
            self._meshes.popitem(last=False)
        return mesh

    def _usable(self, index: int, seed: int) -> tuple[MeshEntry, list[int]]:
        """The mesh that sample ``index`` is cut from, and the rows of those passed over for it."""
        passed: list[int] = []
        for entry in self.candidates(index, seed):
            if self._load(entry) is not None:
                return entry, passed
            passed.append(entry.row)
        first = self.rejected[passed[0]]
        raise ValueError(f"curate: none of the {len(passed)} meshes is usable; of {first['path']}: {first['reason']}")

    def draw(
        self, rngs: Sequence[np.random.Generator], indices: Sequence[int], *, seed: int
    ) -> tuple[list[MeshCube], set[int]]:
        """Clean cubes of samples, each with its own generator, and the rows passed over as unusable.

        Those of one mesh are cut together; sample i of a batch equals sample i alone.

        Raises:
            ValueError: no mesh is usable.
        """
        chosen = [self._usable(index, seed) for index in indices]
        cubes: list[MeshCube] = []
        for entry, group in itertools.groupby(entry for entry, _ in chosen):
            mine = rngs[len(cubes) : len(cubes) + len(list(group))]
            mesh = self._load(entry)
            assert mesh is not None  # it was usable a moment ago
            occupancy, frames = sample_mesh_cubes(mine, mesh, self.recipe)
            cubes += [MeshCube(cube, frame, entry.row) for cube, frame in zip(occupancy, frames)]
        return cubes, {row for _, passed in chosen for row in passed}


@lru_cache(maxsize=4)
def _library(recipe: Recipe, mesh_root: str, stamp: tuple[int, int]) -> MeshLibrary:
    return MeshLibrary(recipe, mesh_root)


def open_library(recipe: Recipe, mesh_root: str | Path) -> MeshLibrary:
    """The library of a folder, kept for the next call unless its manifest changes.

    Raises:
        FileNotFoundError: no manifest.
        ValueError: a manifest without what it needs, or none of its meshes fits the recipe.
    """
    try:
        status = (Path(mesh_root) / MANIFEST).stat()
    except OSError:
        return MeshLibrary(recipe, mesh_root)  # which says what is wrong
    return _library(recipe, str(mesh_root), (status.st_mtime_ns, status.st_size))
