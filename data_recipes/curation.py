"""From a recipe to shards of training pairs: parallel, resumable, the same bytes for any engine and workers."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..core.errors import InvalidArgument
from ..core.progress import Bar, progress_bar
from ..core.shards.storage import read_shard, write_shard
from .engines import WorkerDied, open_engine, spans
from .folder_lock import locked
from .pairs import Arrays, Chunk, Notes, SampleError, checked_root, close_meshes, damage, make_chunk, sample_pair
from .recipe import Recipe

__all__ = ["SampleError", "curate", "damage", "sample_pair"]

SHARD_LENGTH = 8192
CHUNK_LENGTH = 256
MAX_COUNT = 2**31 - 1  # a group is an int32


@dataclass(frozen=True)
class _Plan:
    """One shard: its folder, what its provenance must say, and its samples ``[start, stop)``."""

    folder: Path
    provenance: dict[str, Any]
    start: int
    stop: int

    def finished(self) -> dict[str, Any] | None:
        """The provenance of the shard if it is there, whole and the one wanted; another one there is an error."""
        if not self.folder.exists():
            return None
        shard = read_shard(self.folder, verify=True)
        there = _flat(shard.provenance | {"count": len(shard), "frames": shard.frames is not None})
        wanted = _flat(self.provenance | {"count": self.stop - self.start, "frames": True})
        differing = [
            f"{key}: {there.get(key)!r:.80}, not {value!r:.80}"
            for key, value in sorted(wanted.items())
            if there.get(key) != value
        ]
        if differing:
            raise InvalidArgument(
                f"curate: {self.folder} holds another curation ({'; '.join(differing)}): "
                "choose another out folder or remove it"
            )
        return shard.provenance

    def write(self, chunks: Iterator[Chunk], bar: Bar) -> dict[str, Any]:
        """Collect the shard's chunks and write it; its provenance."""
        arrays: Arrays = {}
        sources: Notes = {}
        rejected: Notes = {}
        filled, count = 0, self.stop - self.start
        while filled < count:
            chunk = next(chunks)
            length = len(chunk.arrays["inputs"])
            for name, part in chunk.arrays.items():
                if name not in arrays:
                    arrays[name] = np.empty((count, *part.shape[1:]), part.dtype)
                arrays[name][filled : filled + length] = part
            sources |= chunk.sources
            rejected |= chunk.rejected
            filled += length
            bar.update(length)
        provenance = dict(self.provenance)
        if sources:
            rows = np.array(sorted(sources))
            arrays["source"] = np.searchsorted(rows, arrays["group"]).astype(np.int32)
            provenance["sources"] = [sources[row] for row in rows.tolist()]
            provenance["rejected"] = [rejected[row] for row in sorted(rejected)]
        write_shard(self.folder, arrays, provenance, kind="pairs")
        return provenance


def _flat(provenance: dict[str, Any]) -> dict[str, Any]:
    """The entries, those of the recipe one by one."""
    recipe = provenance.get("recipe")
    inner = (
        {f"recipe.{key}": value for key, value in recipe.items()} if isinstance(recipe, dict) else {"recipe": recipe}
    )
    return {key: value for key, value in provenance.items() if key != "recipe"} | inner


def _plans(recipe: Recipe, folder: Path, count: int, seed: int, root: str | None, shard_length: int) -> list[_Plan]:
    base: dict[str, Any] = {"recipe": recipe.to_dict(), "seed": seed}
    if root is None:
        base["licence"] = "generated"
    else:
        from .meshes.sources import open_library

        library = open_library(recipe, root)
        base |= {"meshes": len(library.entries), "mesh_manifest_sha256": library.manifest_sha256}
    return [
        _Plan(folder / f"shard-{number:05d}", {**base, "first": start, "last": stop - 1}, start, stop)
        for number, (start, stop) in enumerate(spans(0, count, shard_length))
    ]


def curate(
    recipe: Recipe,
    out: str | Path,
    *,
    count: int,
    seed: int,
    workers: int = 1,
    engine: str = "local",
    progress: bool = False,
    mesh_root: str | Path | None = None,
    shard_length: int = SHARD_LENGTH,
    log: Callable[[str], None] | None = None,
) -> list[Path]:
    """Write ``count`` pairs as shards ``out/shard-00000``, ... of up to ``shard_length`` each.

    A finished shard is skipped once its hashes are checked, an unfinished one is made anew, so that a killed run goes
    on to the same bytes: what it loses is the shard it was at, and what its workers had made ahead (at most 512 pairs
    each). A second run in the same folder at the same time is refused (:mod:`.folder_lock`). A mesh that cannot be
    used costs that mesh: another one takes its samples, and the shard's provenance says so.

    Args:
        recipe: see :class:`Recipe`.
        out: folder; made if absent.
        count: >= 1.
        seed: >= 0.
        workers: processes (spawned: a script that asks for more than one needs the usual
            ``if __name__ == "__main__"``). The bytes do not depend on it.
        engine: ``"local"`` or ``"ray"``, see :mod:`.engines`. The bytes do not depend on it either.
        progress: show a bar with cubes per second and the time left.
        mesh_root: folder with the meshes and their ``manifest.csv``, for recipes with ``source = "meshes"``.
        shard_length: >= 1; a pair takes 41 kB of disk, and of memory until its shard is written.
        log: hears, at the end, of the meshes that were passed over.

    Returns:
        The shard folders, in order.

    Raises:
        ValueError: a number out of range, an unknown engine, no ``mesh_root`` where one is needed, or shards of
            another recipe or seed, or damaged ones, in ``out``.
        SampleError: a pair could not be made (a ValueError too).
        OSError: a shard cannot be written; the finished ones stay. :class:`.engines.WorkerDied` is one, and
            ``BlockingIOError``: another run is at work in ``out``.

    Example:
        >>> import tempfile
        >>> from unghost.data_recipes.recipe import load_recipe
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     (shard,) = curate(load_recipe("procedural"), folder, count=2, seed=0)
        ...     print(shard.name, len(read_shard(shard)))
        shard-00000 2
    """
    _check_numbers(count=(count, 1), seed=(seed, 0), workers=(workers, 1), shard_length=(shard_length, 1))
    opened, root = open_engine(engine, workers), checked_root(recipe, mesh_root)
    plans = _plans(recipe, Path(out), count, seed, root, shard_length)
    with locked(out, verb="curate"):
        found = [plan.finished() for plan in plans]
        todo = [plan for plan, provenance in zip(plans, found) if provenance is None]
        left = sum(plan.stop - plan.start for plan in todo)
        length = CHUNK_LENGTH if left >= 4 * CHUNK_LENGTH * workers else max(8, left // (4 * workers))
        tasks = ((recipe, seed, root, *span) for plan in todo for span in spans(plan.start, plan.stop, length))
        made: list[dict[str, Any]] = []
        if todo:
            with (
                opened,
                progress_bar(count, unit="cube", shown=progress, initial=count - left, smoothing=0.05) as bar,
                closing(opened.ordered(make_chunk, tasks)) as chunks,
            ):
                try:
                    _write(todo, chunks, bar, made, wanted=len(plans))
                finally:
                    close_meshes(root)
    if log is not None:
        _report(log, [provenance for provenance in (*found, *made) if provenance is not None])
    return [plan.folder for plan in plans]


def _check_numbers(**numbers: tuple[int, int]) -> None:
    """Each is a value and the least it may be; ``count`` has a most as well."""
    for name, (value, least) in numbers.items():
        if value < least:
            raise InvalidArgument(f"curate: {name} must be >= {least}, got {value}")
    if numbers["count"][0] > MAX_COUNT:
        raise InvalidArgument(f"curate: count must be <= {MAX_COUNT}, got {numbers['count'][0]}")


def _write(
    todo: Sequence[_Plan], chunks: Iterator[Chunk], bar: Bar, made: list[dict[str, Any]], *, wanted: int
) -> None:
    """Write the shards of ``todo`` in order, their provenance to ``made``; a full disk says what stays."""
    try:
        for plan in todo:
            made.append(plan.write(chunks, bar))
    except WorkerDied:
        raise
    except OSError as error:
        stay = f"{wanted - len(todo) + len(made)} of {wanted} shards are finished and stay"
        message = f"curate: {error.strerror or error}; {stay}: the same call goes on from there"
        raise OSError(error.errno, message) from error


def _report(log: Callable[[str], None], shards: Sequence[dict[str, Any]]) -> None:
    """Name each mesh that some shard passed over, once."""
    passed = {note["row"]: note for provenance in shards for note in provenance.get("rejected", ())}
    for _, note in sorted(passed.items()):
        log(f"{note['path']} was passed over: {note['reason']}")
