"""Training pairs of a recipe, one by one or as chunks in the layout of a shard; each of (seed, index) alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InvalidArgument, UnghostError
from ..core.frames import CubeFrame
from ..core.occupancy import FREE_LABEL, IGNORE_LABEL, SURFACE_LABEL, signed_from_occupancy
from ..core.shards.packing import pack_frame, pack_labels, quantize_signed
from ..core.shards.storage import ARRAYS, OPTIONAL_ARRAYS
from .corruptions.structured import corrupt, soften
from .engines import spans
from .recipe import Recipe
from .solids.compose import dilate, sample_cube

CUT_TOGETHER = 16  # cubes of one mesh
SOFT_SKIRT = 1  # voxels

Arrays = dict[str, NDArray[Any]]
Notes = dict[int, dict[str, Any]]  # about meshes, by their row in the manifest


class SampleError(UnghostError, ValueError):
    """A sample could not be made; the message names it and says why."""


@dataclass(frozen=True)
class CleanCube:
    """A sample before corruption: its generator goes on to corrupt it; no frame where it lay nowhere."""

    rng: np.random.Generator
    occupancy: NDArray[np.bool_]
    fraction: float
    frame: CubeFrame | None
    group: int


@dataclass(frozen=True)
class Chunk:
    """Consecutive samples in the layout of a shard; notes on the meshes they were cut from and those passed over."""

    arrays: Arrays
    sources: Notes
    rejected: Notes


def _clean_cubes(
    recipe: Recipe, indices: Sequence[int], seed: int, mesh_root: str | None
) -> tuple[list[CleanCube], set[int]]:
    """Samples before corruption, each of (seed, index) alone, and the rows of the meshes passed over for them."""
    rngs = [np.random.default_rng([seed, index]) for index in indices]
    if recipe.source == "procedural":
        drawn = [sample_cube(rng, recipe) for rng in rngs]
        return [CleanCube(rng, *cube, index) for rng, cube, index in zip(rngs, drawn, indices)], set()
    if recipe.source == "csg":
        from .solids.csg import csg_cubes_at

        exact = csg_cubes_at(rngs, recipe, indices, seed)
        return [
            CleanCube(rng, cube, frame.edge_length, frame, group) for rng, (cube, frame, group) in zip(rngs, exact)
        ], set()
    from .meshes.sources import open_library

    assert mesh_root is not None
    cubes, passed = open_library(recipe, mesh_root).draw(rngs, indices, seed=seed)
    return [CleanCube(rng, c.occupancy, c.frame.edge_length, c.frame, c.row) for rng, c in zip(rngs, cubes)], passed


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

    Example:
        >>> from unghost.data_recipes.recipe import load_recipe
        >>> clean = np.zeros((32, 32, 32), dtype=bool)
        >>> clean[:, :, 10:13] = True
        >>> signed, labels, severity = damage(np.random.default_rng(0), clean, load_recipe("procedural"))
        >>> bool((labels[clean] == SURFACE_LABEL).all())
        True
    """
    if rng.random() < recipe.clean_share:
        return signed_from_occupancy(clean), _labels(clean), 0.0
    low, high = recipe.severity
    severity = float(low + (high - low) * rng.random() ** recipe.severity_exponent)
    if rng.random() >= recipe.soft_share:
        return signed_from_occupancy(corrupt(rng, clean, severity)), _labels(clean), severity
    clean = dilate(clean, int(rng.integers(recipe.soft_dilation + 1)))
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
        in [0, 1], edge fraction, group (the sample's own index, its mesh's row in the manifest, or its tree's number).

    Example:
        >>> from unghost.data_recipes.recipe import load_recipe
        >>> signed, labels, severity, edge_fraction, group = sample_pair(load_recipe("procedural"), 5, seed=0)
        >>> signed.shape, labels.shape, 0 <= severity <= 1, group
        ((32, 32, 32), (32, 32, 32), True, 5)
    """
    (clean,), _ = _clean_cubes(recipe, [index], seed, checked_root(recipe, mesh_root))
    signed, labels, severity = damage(clean.rng, clean.occupancy, recipe)
    return signed, labels, severity, clean.fraction, clean.group


def checked_root(recipe: Recipe, mesh_root: str | Path | None) -> str | None:
    """The folder of meshes as text; None for recipes that read none.

    Raises:
        ValueError: one is needed and None was given.

    Example:
        >>> from unghost.data_recipes.recipe import load_recipe
        >>> checked_root(load_recipe("procedural"), None) is None
        True
    """
    if recipe.source != "meshes":
        return None
    if mesh_root is None:
        raise InvalidArgument(
            f"curate: recipe {recipe.name!r} reads meshes: mesh_root must name their folder, got None"
        )
    return str(mesh_root)


def _fill(
    arrays: Arrays, first: int, recipe: Recipe, indices: Sequence[int], seed: int, mesh_root: str | None
) -> set[int]:
    """Make samples and put them into their rows; the rows of the meshes passed over."""
    cubes, passed = _clean_cubes(recipe, indices, seed, mesh_root)
    for index, clean in zip(indices, cubes):
        row = index - first
        signed, labels, arrays["severity"][row] = damage(clean.rng, clean.occupancy, recipe)
        arrays["inputs"][row] = quantize_signed(signed)
        arrays["labels"][row] = pack_labels(labels[None])[0]
        arrays["edge_fraction"][row], arrays["group"][row] = clean.fraction, clean.group
        arrays["frames"][row] = pack_frame(clean.frame)
    return passed


def _named(arrays: Arrays, first: int, recipe: Recipe, index: int, seed: int, mesh_root: str | None) -> set[int]:
    """One sample; what goes wrong carries its name."""
    try:
        return _fill(arrays, first, recipe, [index], seed, mesh_root)
    except Exception as error:
        said = str(error) if isinstance(error, UnghostError) else f"{type(error).__name__}: {error}"
        raise SampleError(f"curate: sample {index} of seed {seed}: {said}") from error


def make_chunk(recipe: Recipe, seed: int, mesh_root: str | None, start: int, stop: int) -> Chunk:
    """Samples ``start`` to ``stop`` in the layout of a shard, with ``frames``.

    Raises:
        SampleError: one of them could not be made.
        ImportError: a missing extra.

    Example:
        >>> from unghost.data_recipes.recipe import load_recipe
        >>> chunk = make_chunk(load_recipe("procedural"), 0, None, 0, 2)
        >>> chunk.arrays["inputs"].shape, chunk.arrays["group"].tolist()
        ((2, 32, 32, 32), [0, 1])
    """
    layout = ARRAYS | {"frames": OPTIONAL_ARRAYS["frames"]}
    arrays: Arrays = {name: np.empty((stop - start, *shape), dtype) for name, (shape, dtype) in layout.items()}
    passed: set[int] = set()
    for low, high in spans(start, stop, CUT_TOGETHER):
        try:
            passed |= _fill(arrays, start, recipe, range(low, high), seed, mesh_root)
        except (ImportError, MemoryError):
            raise
        except Exception:  # which of them?
            passed |= {row for i in range(low, high) for row in _named(arrays, start, recipe, i, seed, mesh_root)}
    if recipe.source != "meshes":
        return Chunk(arrays, {}, {})
    from .meshes.sources import open_library

    library = open_library(recipe, str(mesh_root))
    used = sorted(set(arrays["group"].tolist()))
    return Chunk(arrays, {row: library.sources[row] for row in used}, {row: library.rejected[row] for row in passed})


def close_meshes(root: str | None) -> None:
    """End the reader of meshes that one worker, this process, may have used."""
    if root is not None:
        from .meshes.sources import close_libraries

        close_libraries()
