"""Which mesh each sample of a recipe is cut from, and what is known of it: path, hash, licence.

Meshes are read by :mod:`.guard`, in another process. One that cannot be used costs that mesh: the next one in the
order takes its samples, and it is reported.
"""

from __future__ import annotations

import hashlib
import itertools
import weakref
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.errors import InvalidFile
from ...core.frames import CubeFrame
from ...core.shards.storage import stays_within
from ..recipe import Recipe
from .crops import sample_mesh_cubes
from .guard import GuardLimits, MeshGuard
from .library import MANIFEST, Mesh, MeshEntry, read_manifest, select_meshes
from .repair import RepairOptions

MESH_STREAM = 0x6D657368  # keeps the order of meshes apart from the samples' own generators
CACHED_MESHES = 16
LIMITS = GuardLimits(wall_seconds=120.0)  # generous: what is rejected must not depend on how busy a machine is


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
        self._rows = read_manifest(content, where=str(self.root / MANIFEST))
        self.sources: dict[int, dict[str, Any]] = {}
        self.rejected: dict[int, dict[str, Any]] = {}
        self._meshes: OrderedDict[int, Mesh] = OrderedDict()
        repair = RepairOptions(remesh_edge=recipe.remesh_edge) if recipe.repair else None
        self._guard = MeshGuard(self.root, limits=LIMITS, repair=repair)
        self.close = weakref.finalize(self, self._guard.close)
        """Ends the reader process; the library is of no use afterwards. Happens by itself when it is dropped."""

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
            if not stays_within(path):
                raise InvalidFile("rejected: its path holds a character that is no part of a name on every system")
            outcome = self._guard.read(path)
            if outcome.mesh is None:
                raise InvalidFile(f"{outcome.status}: {outcome.reason}")
            if row.get("sha256") not in (None, "", outcome.mesh.sha256):
                raise InvalidFile(f"rejected: its sha256 is {outcome.mesh.sha256}, {MANIFEST} says {row['sha256']}")
            mesh = Mesh.from_triangles(outcome.mesh.triangles)
        except ValueError as error:
            reason = " ".join(str(error).replace(str(self.root.resolve()), "").replace(str(self.root), "").split())
            self.rejected[entry.row] = {"path": path, "reason": reason, "row": entry.row}
            return None
        known = {"path": path, "sha256": outcome.mesh.sha256, "licence": row["licence"], "row": entry.row}
        if outcome.mesh.side_files:
            known["side_files"] = [list(pair) for pair in outcome.mesh.side_files]
        self.sources[entry.row] = known
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
        raise InvalidFile(f"curate: none of the {len(passed)} meshes is usable; of {first['path']}: {first['reason']}")

    def mesh(self, place: int, *, seed: int = 0) -> tuple[MeshEntry, Mesh]:
        """The mesh at ``place >= 0`` of the shuffled order, or the next one after it that is usable.

        Raises:
            ValueError: no mesh is usable.
        """
        entry, _ = self._usable(place * self.recipe.cubes_per_mesh, seed)
        mesh = self._load(entry)
        assert mesh is not None  # it was usable a moment ago
        return entry, mesh

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


_opened: dict[tuple[Recipe, str], tuple[tuple[int, int], MeshLibrary]] = {}


def open_library(recipe: Recipe, mesh_root: str | Path) -> MeshLibrary:
    """The library of a folder, kept for the next call unless its manifest changes.

    It holds a reader process; :func:`close_libraries` ends it, and so does the end of this process.

    Raises:
        FileNotFoundError: no manifest.
        ValueError: a manifest without what it needs, or none of its meshes fits the recipe.
    """
    key = recipe, str(mesh_root)
    manifest = Path(mesh_root) / MANIFEST
    status = manifest.stat() if manifest.is_file() else None
    stamp = (status.st_mtime_ns, status.st_size) if status else (0, 0)
    if key not in _opened or _opened[key][0] != stamp:
        _opened[key] = stamp, MeshLibrary(recipe, mesh_root)
    return _opened[key][1]


def close_libraries() -> None:
    """Forget what :func:`open_library` keeps, and end the reader processes."""
    for _, library in _opened.values():
        library.close()
    _opened.clear()
