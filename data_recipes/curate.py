"""From a recipe to shards of training pairs: parallel, resumable, the same bytes for any number of workers."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from ..core.frames import RESOLUTION
from ..core.occupancy import FREE_LABEL, IGNORE_LABEL, SURFACE_LABEL, signed_from_occupancy
from ..core.shards import pack_labels, quantize_signed, read_shard, write_shard
from .augment import corrupt, soften
from .compose import dilate, sample_cube
from .recipe import Recipe

SHARD_LENGTH = 8192
CHUNK_LENGTH = 256
SOFT_SKIRT = 1  # voxels
MAX_COUNT = 2**31 - 1  # a group is an int32

Arrays = dict[str, NDArray[Any]]
CleanCube = tuple[NDArray[np.bool_], float, int]


def _clean_cube(rng: np.random.Generator, recipe: Recipe, mesh_root: str | None, index: int, seed: int) -> CleanCube:
    """Occupancy, edge fraction and group of one sample before corruption."""
    if recipe.source == "procedural":
        occupancy, fraction = sample_cube(rng, recipe)
        return occupancy, fraction, index
    from .meshes import mesh_cube_at

    assert mesh_root is not None
    drawn: CleanCube = mesh_cube_at(rng, recipe, mesh_root, index, seed)
    return drawn


def damage(
    rng: np.random.Generator, clean: NDArray[np.bool_], recipe: Recipe
) -> tuple[NDArray[np.float32], NDArray[np.uint8], float]:
    """Corrupt one clean cube as a recipe says.

    A soft input spreads true surfaces over their neighbours, which is no fault: there, voxels next to the
    surface carry the label "ignore".

    Args:
        rng: of this sample.
        clean: ``(R, R, R)`` bool.
        recipe: its ``clean_share``, ``severity``, ``soft_share`` and ``soft_dilation`` count.

    Returns:
        input ``(R, R, R)`` float32 signed opacity, labels ``(R, R, R)`` uint8 (0 free, 1 surface, 2 ignore),
        severity in [0, 1].
    """
    if rng.random() < recipe.clean_share:
        return signed_from_occupancy(clean), _labels(clean), 0.0
    low, high = recipe.severity
    severity = float(low + (high - low) * rng.random() ** recipe.severity_exponent)
    if rng.random() >= recipe.soft_share:
        return signed_from_occupancy(corrupt(rng, clean, severity)), _labels(clean), severity
    clean = dilate(clean, recipe.soft_dilation)
    signed = soften(rng, clean, corrupt(rng, clean, severity), severity)
    labels = _labels(clean)
    labels[dilate(clean, SOFT_SKIRT) & ~clean] = IGNORE_LABEL
    return signed, labels, severity


def _labels(clean: NDArray[np.bool_]) -> NDArray[np.uint8]:
    return np.where(clean, SURFACE_LABEL, FREE_LABEL).astype(np.uint8)


def sample_pair(
    recipe: Recipe, index: int, *, seed: int, mesh_root: str | Path | None = None
) -> tuple[NDArray[np.float32], NDArray[np.uint8], float, float, int]:
    """Training pair ``index``: depends on (recipe, seed, index) alone.

    Returns:
        input ``(32, 32, 32)`` float32 signed opacity, labels ``(32, 32, 32)`` uint8 (see :func:`damage`), severity
        in [0, 1], edge fraction, group (the sample's own index, or its mesh's row in the manifest).
    """
    root = _checked_root(recipe, mesh_root)
    rng = np.random.default_rng([seed, index])
    clean, fraction, group = _clean_cube(rng, recipe, root, index, seed)
    signed, labels, severity = damage(rng, clean, recipe)
    return signed, labels, severity, fraction, group


def _checked_root(recipe: Recipe, mesh_root: str | Path | None) -> str | None:
    if recipe.source == "procedural":
        return None
    if mesh_root is None:
        raise ValueError(f"curate: recipe {recipe.name!r} reads meshes: mesh_root must name their folder, got None")
    return str(mesh_root)


def _chunk(recipe: Recipe, seed: int, mesh_root: str | None, start: int, stop: int) -> Arrays:
    """Samples ``start`` to ``stop`` in the layout of a shard."""
    count = stop - start
    arrays: Arrays = {
        "inputs": np.empty((count, *(RESOLUTION,) * 3), dtype=np.uint8),
        "labels": np.empty((count, RESOLUTION**3 // 4), dtype=np.uint8),
        "severity": np.empty(count, dtype=np.float32),
        "edge_fraction": np.empty(count, dtype=np.float32),
        "group": np.empty(count, dtype=np.int32),
    }
    for row, index in enumerate(range(start, stop)):
        signed, labels, severity, fraction, group = sample_pair(recipe, index, seed=seed, mesh_root=mesh_root)
        arrays["inputs"][row] = quantize_signed(signed)
        arrays["labels"][row] = pack_labels(labels[None])[0]
        arrays["severity"][row], arrays["edge_fraction"][row] = severity, fraction
        arrays["group"][row] = group
    return arrays


def _ordered(
    pool: ProcessPoolExecutor, call: Callable[..., Arrays], tasks: list[tuple[Any, ...]], ahead: int
) -> Iterator[Arrays]:
    """Results in the order of the tasks, never more than ``ahead`` of them under way."""
    pending: dict[int, Future[Arrays]] = {}
    submitted = 0
    for wanted in range(len(tasks)):
        while submitted < len(tasks) and submitted < wanted + ahead:
            pending[submitted] = pool.submit(call, *tasks[submitted])
            submitted += 1
        wait([pending[wanted]], return_when=FIRST_COMPLETED)
        yield pending.pop(wanted).result()


def _is_finished(folder: Path, provenance: dict[str, Any]) -> bool:
    """Whether the shard is there and is the one wanted; another one in its place is an error."""
    if not folder.exists():
        return False
    found = read_shard(folder).provenance
    differing = sorted(key for key in set(found) | set(provenance) if found.get(key) != provenance.get(key))
    if differing:
        raise ValueError(f"curate: {folder} holds another curation (it differs in {', '.join(differing)}): "
                         "choose another out folder or remove it")  # fmt: skip
    return True


def curate(
    recipe: Recipe,
    out: str | Path,
    *,
    count: int,
    seed: int,
    workers: int = 1,
    progress: bool = False,
    mesh_root: str | Path | None = None,
) -> list[Path]:
    """Write ``count`` pairs as shards ``out/shard-00000``, ... of up to 8192 each.

    A finished shard is skipped, an unfinished one is made anew, so a killed run continues where it was.

    Args:
        recipe: see :class:`Recipe`.
        out: folder; made if absent.
        count: >= 1.
        seed: >= 0.
        workers: processes (spawned: a script that asks for more than one needs the usual
            ``if __name__ == "__main__"``). The bytes do not depend on it.
        progress: show a bar with cubes per second and the time left.
        mesh_root: folder with the meshes and their ``manifest.csv``, for recipes with ``source = "meshes"``.

    Returns:
        The shard folders, in order.

    Raises:
        ValueError: a count, seed or worker number out of range, no ``mesh_root`` where one is needed, or
            shards of another recipe or seed in ``out``.

    Example:
        >>> from unghost.data_recipes.recipe import load_recipe
        >>> shards = curate(load_recipe("procedural"), "pairs", count=20000, seed=0, workers=2)  # doctest: +SKIP
    """
    for name, value, least in (("count", count, 1), ("seed", seed, 0), ("workers", workers, 1)):
        if value < least:
            raise ValueError(f"curate: {name} must be >= {least}, got {value}")
    if count > MAX_COUNT:
        raise ValueError(f"curate: count must be <= {MAX_COUNT}, got {count}")
    root, folder = _checked_root(recipe, mesh_root), Path(out)
    base: dict[str, Any] = {"recipe": recipe.to_dict(), "seed": seed}
    if root is not None:
        from .meshes import select_meshes

        base["meshes"] = len(select_meshes(recipe, root))
    plans: list[tuple[Path, dict[str, Any], int, int]] = []
    for number, start in enumerate(range(0, count, SHARD_LENGTH)):
        stop = min(start + SHARD_LENGTH, count)
        plans.append((folder / f"shard-{number:05d}", {**base, "first": start, "last": stop - 1}, start, stop))
    unfinished = [plan for plan in plans if not _is_finished(plan[0], plan[1])]
    _write_all(unfinished, recipe, seed, root, workers, progress)
    return [plan[0] for plan in plans]


def _write_all(
    plans: list[tuple[Path, dict[str, Any], int, int]],
    recipe: Recipe, seed: int, root: str | None, workers: int, progress: bool,
) -> None:  # fmt: skip
    total = sum(stop - start for _, _, start, stop in plans)
    length = CHUNK_LENGTH if total >= 4 * CHUNK_LENGTH * workers else max(8, total // (4 * workers))
    manager: AbstractContextManager[ProcessPoolExecutor | None] = nullcontext()
    if workers > 1 and plans:
        manager = ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn"))
    with manager as pool, tqdm(total=total, unit="cube", disable=not progress, smoothing=0.05) as bar:
        for folder, provenance, start, stop in plans:
            tasks = [(recipe, seed, root, low, min(low + length, stop)) for low in range(start, stop, length)]
            chunks: list[Arrays] = []
            made = map(_chunk, *zip(*tasks)) if pool is None else _ordered(pool, _chunk, tasks, 2 * workers)
            for chunk in made:
                chunks.append(chunk)
                bar.update(len(chunk["inputs"]))
            write_shard(folder, {key: np.concatenate([c[key] for c in chunks]) for key in chunks[0]}, provenance)
