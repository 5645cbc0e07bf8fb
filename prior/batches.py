"""Endless training batches from memory-mapped shards; sample i depends on (seed, i) alone."""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.schedule import timestep_from_severity
from ..core.shards import Shard, dequantize_signed, read_shard, unpack_labels

SYMMETRIES: tuple[tuple[tuple[int, ...], tuple[int, ...]], ...] = tuple(
    (permutation, tuple(axis for axis in range(3) if flips >> axis & 1))
    for permutation in itertools.permutations(range(3))
    for flips in range(8)
)  # the 48 symmetries of the cube: a permutation of the axes, then flips


def apply_symmetry(grid: NDArray[Any], symmetry: int) -> NDArray[Any]:
    """One of the 48 symmetries of ``grid (R, R, R)``; 0 is the identity. A view."""
    permutation, flips = SYMMETRIES[symmetry]
    return np.flip(grid.transpose(permutation), flips)


BLIND_SEVERITY = 0.8
HARVEST_RECIPE = "harvest"  # what the provenance of cubes of fitted fields says


DEPTH_JITTER = 0.5  # of the logarithm of a harvested cube's optical depth: a field's cell is known but roughly


def _harvested(shard: Shard) -> bool:
    return bool(shard.provenance.get("recipe") == HARVEST_RECIPE)


def scale_depth(signed: NDArray[np.float32], factor: float) -> NDArray[np.float32]:
    """Signed opacity as it were with ``factor`` times the density: ``o -> 1 - (1 - o)^factor``; -1 and +1 stay."""
    transparency = np.clip((1.0 - signed) * np.float32(0.5), 0.0, 1.0)
    scaled: NDArray[np.float32] = (1.0 - 2.0 * transparency ** np.float32(factor)).astype(np.float32)
    return scaled


@dataclass(frozen=True)
class Batch:
    """``channels (N, 1, R, R, R)``, ``labels (N, R, R, R)``, the rest ``(N,)``; ``harvested``: of a fitted field."""

    channels: NDArray[np.float32]
    labels: NDArray[np.uint8]
    timestep: NDArray[np.int64]
    edge_fraction: NDArray[np.float32]
    harvested: NDArray[np.bool_]


class Mixture:
    """Random access to an endless weighted mixture of shards.

    Sample i draws, from a generator seeded by (seed, i): its shard (by weight), its cube, one of the 48 symmetries (of
    harvested cubes also a factor on the optical depth), and ``t = round(999 u)``, ``u`` uniform in
    [min(severity, BLIND_SEVERITY), 1]: the timestep says "at most this much corruption", from ``BLIND_SEVERITY`` on
    "any amount"; a clean cube is seen at every timestep.
    """

    def __init__(self, shards: Sequence[tuple[str | Path, float]], *, seed: int) -> None:
        if not shards:
            raise ValueError("Mixture: at least one training shard is needed")
        weights = np.array([weight for _, weight in shards], dtype=np.float64)
        if not (np.isfinite(weights).all() and (weights > 0).all()):
            raise ValueError(f"Mixture: weights must be finite and > 0, got {weights.tolist()}")
        self.shards: list[Shard] = [read_shard(path) for path, _ in shards]
        for (path, _), shard in zip(shards, self.shards):
            if not len(shard):
                raise ValueError(f"Mixture: {path} holds no cubes")
        self.seed = seed
        self._cumulative = np.cumsum(weights) / weights.sum()

    def _draw(self, index: int) -> tuple[Shard, int, int, float, float]:
        rng = np.random.default_rng([self.seed, index])
        choice = int(np.searchsorted(self._cumulative, rng.random(), side="right"))
        shard = self.shards[min(choice, len(self.shards) - 1)]
        cube, symmetry, position = int(rng.integers(len(shard))), int(rng.integers(len(SYMMETRIES))), rng.random()
        depth = float(np.exp(rng.uniform(-DEPTH_JITTER, DEPTH_JITTER)))
        return shard, cube, symmetry, float(position), depth if _harvested(shard) else 1.0

    def batch(self, step: int, batch_size: int) -> Batch:
        """Samples ``step * batch_size`` to ``(step + 1) * batch_size``."""
        draws = [self._draw(index) for index in range(step * batch_size, (step + 1) * batch_size)]
        stored = [apply_symmetry(shard.inputs[cube], symmetry) for shard, cube, symmetry, *_ in draws]
        signed = dequantize_signed(np.stack(stored))
        for row, (*_, depth) in enumerate(draws):
            if depth != 1.0:
                signed[row] = scale_depth(signed[row], depth)
        labels = [
            apply_symmetry(unpack_labels(shard.labels[cube : cube + 1])[0], symmetry)
            for shard, cube, symmetry, *_ in draws
        ]
        severity = np.array([shard.severity[cube] for shard, cube, *_ in draws], dtype=np.float64)
        least = np.minimum(severity, BLIND_SEVERITY)
        position = np.array([position for *_, position, _ in draws])
        return Batch(
            signed[:, None],
            np.stack(labels),
            timestep_from_severity(least + (1.0 - least) * position),
            np.array([shard.edge_fraction[cube] for shard, cube, *_ in draws], dtype=np.float32),
            np.array([_harvested(shard) for shard, *_ in draws]),
        )

    def stream(self, first_step: int, batch_size: int, *, ahead: int = 2) -> Iterator[Batch]:
        """Batches ``first_step``, ``first_step + 1``, … for ever, ``ahead`` of them prepared in threads."""
        with ThreadPoolExecutor(max_workers=max(1, ahead)) as pool:
            pending: deque[Future[Batch]] = deque()
            try:
                for step in itertools.count(first_step):
                    pending.append(pool.submit(self.batch, step, batch_size))
                    if len(pending) > ahead:
                        yield pending.popleft().result()
            finally:
                for future in pending:
                    future.cancel()
