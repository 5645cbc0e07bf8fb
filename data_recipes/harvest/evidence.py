"""Give harvested shards other sparse points, without fitting their fields again."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ...core.config import from_dict, to_dict
from ...core.errors import InvalidArgument
from ...core.frames import RESOLUTION, cube_lattices
from ...core.shards.finding import find_shards
from ...core.shards.storage import ARRAYS, OPTIONAL_ARRAYS, read_shard, write_shard
from ...core.sight_lines import SightLines
from ...core.visibility.view_counts import count_views
from .config import HarvestConfig
from .context import evidence
from .rooms import draw_objects_of

if TYPE_CHECKING:
    from ...core.cameras import Cameras
    from ...core.sparse_points import SparsePoints
    from ...scenes.generator import PhotographedScene
    from ...scenes.sparse_points import MatchingConfig

POINT_STREAM = 0x73666D  # keeps the points apart from all else that is drawn for a scene
TOGETHER = 8  # consecutive cubes that share a set of points
FINEST = 0.008  # pitch of the finest grid of a room's sight lines
LEVELS = 3  # grids for a room, each twice as coarse as the one before


def point_sets(
    photographed: PhotographedScene,
    *,
    seed: int,
    index: int,
    snapshot: int,
    sets: int,
    matching: MatchingConfig | None = None,
) -> list[SparsePoints]:
    """Simulated sparse points for a snapshot of scene ``index``, set by set."""
    from ...scenes.sparse_points import simulate_sparse_points

    rng = np.random.default_rng([seed, index, POINT_STREAM, snapshot])
    return [simulate_sparse_points(rng, photographed, matching) for _ in range(sets)]


def lines_of(
    points: list[SparsePoints], cameras: Cameras, *, aabb: NDArray[np.float64], pitch: float
) -> list[SightLines]:
    """Sight lines of each set, on a grid of the field's own pitch."""
    return [SightLines.build(each, cameras, aabb=aabb, pitch=pitch) for each in points]


def easy_matching() -> MatchingConfig:
    """Matching that finds many points: a room's cells are finer than those of a field that was fitted to it."""
    from ...scenes.sparse_points import MatchingConfig

    return MatchingConfig(points=(1000.0, 20_000.0), contrast=(0.002, 0.006), repeatability=(0.4, 0.7))


def room_evidence(
    points: list[SparsePoints], cameras: Cameras, frames: NDArray[np.float64]
) -> dict[str, NDArray[np.uint8]]:
    """View counts, support and crossings of cubes of a perfect field, each at its own pitch.

    Args:
        points: sets of sparse points; consecutive cubes share one.
        cameras: that observed them.
        frames: ``(N, 13)`` of the cubes.
    """
    aabb = np.array([[-1.0] * 3, [1.0] * 3])
    edges, rotations = frames[:, 3], frames[:, 4:].reshape(-1, 3, 3)
    cell = edges / RESOLUTION / np.where(np.arange(len(frames)) % 3 == 2, 2.0, 1.0)  # some at twice the field's pitch
    level = np.clip(np.rint(np.log2(cell / FINEST)), 0, LEVELS - 1).astype(np.int64)
    found = {name: np.zeros((len(frames), *(RESOLUTION,) * 3), dtype=np.uint8) for name in ("support", "crossings")}
    group = np.arange(len(frames)) // TOGETHER % len(points)
    for number, pitch_level in sorted(set(zip(group.tolist(), level.tolist()))):
        (lines,) = lines_of([points[number]], cameras, aabb=aabb, pitch=FINEST * 2.0**pitch_level)
        rows = np.flatnonzero((group == number) & (level == pitch_level))
        for part in np.array_split(rows, -(-len(rows) // TOGETHER)):
            lattice = cube_lattices(frames[part, :3], edges[part], rotations[part])
            for name, values in evidence(lines, lattice).items():
                found[name][part] = values
    return {**found, "view_count": count_views(cameras, frames[:, :3], edges, rotations)}


def replace_evidence(
    source: str | Path,
    out: str | Path,
    *,
    matching: MatchingConfig | None = None,
    sets: int = 4,
    mesh_root: str | Path | None = None,
    log: Callable[[str], None] | None = None,
) -> int:
    """Copy harvested shards, with ``support`` and ``crossings`` of newly simulated points.

    A scene and its photos follow from the seed and the number in its provenance, so that no field is needed.

    Args:
        source: a folder of harvested shards.
        out: folder for the copies; those that are there are left alone.
        matching: how many points there are and how bad; None for the harvest's own ranges.
        sets: of points for each snapshot, >= 1.
        mesh_root: the folder of meshes that the harvest had.
        log: called with one line for each scene.

    Returns:
        Number of shards in ``out``.

    Raises:
        ValueError: a shard is no harvest, or its meshes are missing.
    """
    if sets < 1:
        raise InvalidArgument(f"replace_evidence: sets must be >= 1, got {sets}")
    folders = find_shards(source)
    for path in folders:
        target = Path(out) / path.name
        if target.exists():
            continue
        counts = _copy(path, target, matching, sets, mesh_root)
        if log is not None:
            log(f"{path.name}: {', '.join(map(str, counts))} points")
    return len(folders)


def _copy(
    path: Path, target: Path, matching: MatchingConfig | None, sets: int, mesh_root: str | Path | None
) -> list[int]:
    """One shard; numbers of points."""
    from .run import photograph_scene

    shard = read_shard(path)
    provenance = shard.provenance
    if provenance.get("recipe") != "harvest" or shard.frames is None:
        raise InvalidArgument(f"replace_evidence: {path} must be a harvested shard with frames")
    if provenance.get("meshes") and mesh_root is None:
        raise InvalidArgument(f"replace_evidence: {path} was harvested with meshes: mesh_root must be given")
    config = from_dict(HarvestConfig, provenance["config"])
    seed, index = provenance["seed"], provenance["scene"]
    objects, _ = draw_objects_of(seed, index, config, mesh_root if provenance.get("meshes") else None)
    photographed = photograph_scene(np.random.default_rng([seed, index]), config, objects)
    aabb, pitch = np.array([[-1.0] * 3, [1.0] * 3]), provenance["field_pitch"]
    parts: list[dict[str, NDArray[np.uint8]]] = []
    counts: list[int] = []
    for snapshot in range(len(shard) // config.cubes):
        points = point_sets(photographed, seed=seed, index=index, snapshot=snapshot, sets=sets, matching=matching)
        counts += [len(each) for each in points]
        lines = lines_of(points, photographed.cameras, aabb=aabb, pitch=pitch)
        for number, start in enumerate(range(0, config.cubes, TOGETHER)):
            first = snapshot * config.cubes + start
            rows = np.array(shard.frames[first : first + min(TOGETHER, config.cubes - start)])
            lattice = cube_lattices(rows[:, :3], rows[:, 3], rows[:, 4:].reshape(-1, 3, 3))
            parts.append(evidence(lines[number % len(lines)], lattice))
    stored: dict[str, Any] = {
        name: np.asarray(getattr(shard, name))
        for name in (*ARRAYS, *OPTIONAL_ARRAYS)
        if getattr(shard, name) is not None
    }
    stored |= {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    told = {**provenance, "points": counts, "matching": None if matching is None else to_dict(matching)}
    write_shard(target, stored, told, kind="harvest")
    return counts
