"""Training pairs made while a network trains, by worker processes: an endless stream, no shard on disk."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InvalidArgument
from ..core.shards.packing import dequantize_signed, unpack_labels
from .engines import LocalEngine, spans
from .pairs import Chunk, checked_root, close_meshes, make_chunk
from .recipe import Recipe


@dataclass(frozen=True)
class PairBatch:
    """Samples ``first`` to ``first + N - 1`` of a recipe, each with the values that a shard would give it.

    Attributes:
        channels: ``(N, 1, 32, 32, 32)`` float32 signed opacity in [-1, 1].
        labels: ``(N, 32, 32, 32)`` uint8: 0 free, 1 surface, 2 ignore.
        severity: ``(N,)`` float32 in [0, 1].
        edge_fraction: ``(N,)`` float32 > 0.
        group: ``(N,)`` int32.
        first: number of the first sample.
    """

    channels: NDArray[np.float32]
    labels: NDArray[np.uint8]
    severity: NDArray[np.float32]
    edge_fraction: NDArray[np.float32]
    group: NDArray[np.int32]
    first: int

    def __len__(self) -> int:
        return len(self.channels)


def _batch(chunk: Chunk, first: int) -> PairBatch:
    arrays = chunk.arrays
    return PairBatch(
        dequantize_signed(arrays["inputs"])[:, None],
        unpack_labels(arrays["labels"]),
        arrays["severity"],
        arrays["edge_fraction"],
        arrays["group"],
        first,
    )


class OnlinePairs:
    """The endless sequence of a recipe's samples; sample i depends on (recipe, seed, i) alone, as in its shards.

    Every sample is new: nothing is seen twice, and nothing is stored. How fast it goes depends on the recipe and
    the workers; a network that learns faster than they work waits for them, and a shard is the better choice.

    Args:
        recipe: what to make.
        seed: >= 0.
        workers: processes, spawned when a stream begins and ended with it; 1 makes the samples in this process.
        mesh_root: folder of meshes, for recipes that read them.

    Raises:
        ValueError: a number out of range, no ``mesh_root`` where one is needed, or no usable mesh manifest there.

    Example:
        >>> from unghost.data_recipes.recipe import load_recipe
        >>> pairs = OnlinePairs(load_recipe("procedural"), seed=0)
        >>> pairs.batch(3, 2).channels.shape  # samples 6 and 7
        (2, 1, 32, 32, 32)
    """

    def __init__(self, recipe: Recipe, *, seed: int, workers: int = 1, mesh_root: str | Path | None = None) -> None:
        for name, value, least in (("seed", seed, 0), ("workers", workers, 1)):
            if value < least:
                raise InvalidArgument(f"OnlinePairs: {name} must be >= {least}, got {value}")
        self.recipe, self.seed, self.workers = recipe, seed, workers
        self._root = checked_root(recipe, mesh_root)
        if self._root is not None:
            from .meshes.sources import open_library

            open_library(recipe, self._root)  # what is wrong with the folder shows here, not in a worker

    def batch(self, step: int, batch_size: int) -> PairBatch:
        """Samples ``step * batch_size`` to ``(step + 1) * batch_size``, made in this process."""
        _check(step, batch_size)
        first = step * batch_size
        return _batch(make_chunk(self.recipe, self.seed, self._root, first, first + batch_size), first)

    def stream(self, first_step: int, batch_size: int, *, ahead: int = 2) -> Generator[PairBatch, None, None]:
        """Batches ``first_step``, ``first_step + 1``, ... for ever, the same for any number of workers.

        Closing the iterator (or dropping it) ends the workers; so does an interrupt, and the death of this
        process. A worker that dies is replaced, its samples are made again.

        Args:
            first_step: >= 0.
            batch_size: >= 1.
            ahead: >= 1, batches under way beyond those that the workers are busy with.

        Raises:
            SampleError: a sample could not be made; it is named, when its batch is due.
            WorkerDied: no worker survives a batch.
        """
        _check(first_step, batch_size)
        if ahead < 1:
            raise InvalidArgument(f"OnlinePairs.stream: ahead must be >= 1, got {ahead}")
        return self._stream(first_step * batch_size, batch_size, ahead)

    def _stream(self, first: int, batch_size: int, ahead: int) -> Generator[PairBatch, None, None]:
        tasks = ((self.recipe, self.seed, self._root, *span) for span in spans(first, None, batch_size))
        with (
            LocalEngine(self.workers, ahead=self.workers + ahead) as engine,
            closing(engine.ordered(make_chunk, tasks)) as chunks,
        ):
            try:
                for chunk in chunks:
                    yield _batch(chunk, first)
                    first += batch_size
            finally:
                close_meshes(self._root)


def _check(step: int, batch_size: int) -> None:
    if step < 0 or batch_size < 1:
        raise InvalidArgument(f"OnlinePairs: step must be >= 0 and batch_size >= 1, got {step} and {batch_size}")
