"""Cubes to calibrate int8 on: from shards, or made from a recipe."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from .core.errors import InvalidArgument

if TYPE_CHECKING:
    from .core.manifest import Manifest
    from .export.onnx.parity import ParityInputs


def calibration_for(checkpoint: str | Path, source: str | Path, *, cubes: int, seed: int) -> ParityInputs:
    """Calibration inputs for a checkpoint.

    Args:
        checkpoint: a ``model.safetensors``, or its ``.onnx``.
        source: a shard, a folder of shards (``cubes`` of them evenly spread), or the name or file of a recipe.
        cubes: how many, >= 1.
        seed: of the recipe's cubes.

    Raises:
        FileNotFoundError: no such recipe.
        ValueError: an unreadable checkpoint or source.
    """
    from .export.onnx.quantization import calibration_inputs

    if cubes < 1:
        raise InvalidArgument(f"calibration_for: cubes must be >= 1, got {cubes}")
    manifest = _manifest(Path(checkpoint))
    names, stored = manifest.channels, Path(source).is_dir()
    channels, edges = _stored(Path(source), cubes, names) if stored else _made(source, cubes, seed, names)
    return calibration_inputs(channels, edges, default_timestep=manifest.default_timestep)


def _manifest(path: Path) -> Manifest:
    if path.suffix == ".onnx":
        from .export.runtime import read_manifest

        return read_manifest(path)
    from .prior.checkpoint import load_model

    return load_model(path).manifest


def _stored(folder: Path, cubes: int, names: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Channels and edge fractions of cubes evenly spread over the shards of a folder."""
    from .core.shards.finding import find_shards
    from .core.shards.storage import read_shard
    from .prior.training.batches import stored_channels

    shards = [read_shard(path) for path in find_shards(folder)]
    shares = [len(share) for share in np.array_split(np.arange(cubes), len(shards))]
    rows = [np.linspace(0, len(shard) - 1, share).astype(np.int64) for shard, share in zip(shards, shares)]
    channels = np.concatenate([stored_channels(shard, row, names) for shard, row in zip(shards, rows)])
    return channels, np.concatenate([shard.edge_fraction[row] for shard, row in zip(shards, rows)])


def _made(recipe: str | Path, cubes: int, seed: int, names: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Channels (optional ones unknown) and edge fractions of the first cubes of a recipe."""
    from .core.channels import stack_channels
    from .core.shards.packing import dequantize_signed
    from .data_recipes.pairs import make_chunk
    from .data_recipes.recipe import load_recipe

    arrays = make_chunk(load_recipe(recipe), seed, None, 0, cubes).arrays
    return stack_channels(names, dequantize_signed(arrays["inputs"]), {}), arrays["edge_fraction"]
