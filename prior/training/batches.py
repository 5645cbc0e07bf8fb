"""Endless training batches from memory-mapped shards; sample i depends on (seed, i) alone.

A batch holds the channels that a run asks for (:mod:`unghost.core.channels`). What a shard does not store is unknown,
and of the rest a share is made unknown at random, cube by cube and channel by channel: so one model serves those who
can supply a channel and those who cannot.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Collection, Generator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.channels import (
    CROSSINGS,
    OPTIONAL_CHANNELS,
    SIGNED_OPACITY,
    SUPPORT,
    SURROUNDINGS,
    TRANSMITTANCE,
    VIEW_COUNT,
    check_channels,
    encode_known,
    stack_channels,
)
from ...core.errors import InvalidArgument, InvalidFile
from ...core.schedule import timestep_from_severity
from ...core.shards.packing import dequantize_share, dequantize_signed, unpack_labels
from ...core.shards.storage import Shard, read_shard

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
ANY_EDGE = (0.01, 2.0)  # edge fractions that fields are cleaned at
FINER = 8.0  # a field may have so many times the cells, along an axis, of those that were harvested
DEPTH_JITTER = 0.5  # of the logarithm of a harvested cube's optical depth: a field's cell is known but roughly


def _harvested(shard: Shard) -> bool:
    return shard.kind == "harvest"


def any_edge(rng: np.random.Generator) -> float:
    """An edge fraction, log-uniform over ``ANY_EDGE``."""
    low, high = np.log(ANY_EDGE)
    return float(np.exp(rng.uniform(low, high)))


def scale_depth(signed: NDArray[np.float32], factor: float) -> NDArray[np.float32]:
    """Signed opacity as it were with ``factor`` times the density: ``o -> 1 - (1 - o)^factor``; -1 and +1 stay."""
    transparency = np.clip((1.0 - signed) * np.float32(0.5), 0.0, 1.0)
    scaled: NDArray[np.float32] = (1.0 - 2.0 * transparency ** np.float32(factor)).astype(np.float32)
    return scaled


@dataclass(frozen=True)
class Batch:
    """``channels (N, C, R, R, R)``, ``labels (N, R, R, R)``, the rest ``(N,)``; ``harvested``: of a fitted field."""

    channels: NDArray[np.float32]
    labels: NDArray[np.uint8]
    timestep: NDArray[np.int64]
    edge_fraction: NDArray[np.float32]
    harvested: NDArray[np.bool_]


@dataclass(frozen=True)
class _Draw:
    """What sample i is: see :class:`Mixture`. ``dropped`` names channels to be made unknown."""

    shard: Shard
    cube: int
    symmetry: int
    position: float
    depth: float
    dropped: frozenset[str]
    edge_fraction: float


def stored_channels(
    shard: Shard, index: Any, names: Sequence[str], *, depth: float = 1.0, without: Collection[str] = ()
) -> NDArray[np.float32]:
    """The channels of some cubes of a shard.

    Args:
        shard: what it does not store is unknown.
        index: ``(N,)``.
        names: of the channels, in order.
        depth: factor on the optical depth.
        without: names of optional channels to call unknown.

    Returns:
        ``(N, C, R, R, R)`` float32 in [-1, 1].
    """

    def opacity(stored: NDArray[np.uint8]) -> NDArray[np.float32]:
        signed = dequantize_signed(stored[index])
        return signed if depth == 1.0 else scale_depth(signed, depth)

    def told(name: str) -> Any:
        stored = getattr(shard, name)
        return None if stored is None or name not in names or name in without else stored

    about, views, light = told(SURROUNDINGS), told(VIEW_COUNT), told(TRANSMITTANCE)
    support, crossings = told(SUPPORT), told(CROSSINGS)
    known = encode_known(
        surroundings=None if about is None else opacity(about),
        view_count=None if views is None else views[index],
        transmittance=None if light is None else dequantize_share(light[index]) ** np.float32(depth),
        support=None if support is None else dequantize_share(support[index]),
        crossings=None if crossings is None else dequantize_share(crossings[index]),
    )
    return stack_channels(names, opacity(shard.inputs), known)


def timesteps(severity: NDArray[Any], position: NDArray[np.float64]) -> NDArray[np.int64]:
    """``round(999 u)`` with ``u`` at ``position`` in [0, 1] between min(severity, ``BLIND_SEVERITY``) and 1."""
    least = np.minimum(np.asarray(severity, dtype=np.float64), BLIND_SEVERITY)
    return timestep_from_severity(least + (1.0 - least) * position)


class Mixture:
    """Random access to an endless weighted mixture of shards.

    Sample i draws, from a generator seeded by (seed, i): its shard (by weight), its cube, one of the 48 symmetries, of
    harvested cubes also a factor on the optical depth (the surroundings' too), ``t = round(999 u)``, ``u`` uniform in
    [min(severity, BLIND_SEVERITY), 1], and which optional channels are dropped: the timestep says "at most this much
    corruption", from ``BLIND_SEVERITY`` on "any amount"; a clean cube is seen at every timestep.

    Curated cubes belong to no scene, and harvested ones are larger parts of theirs: as it stands, the edge fraction
    would tell them apart, and nothing learned from the curated ones would be of use in a field. So that of curated
    cubes is drawn anew, log-uniform over ``ANY_EDGE``, and that of harvested ones divided by 1 to ``FINER``.

    Args:
        shards: folders and their weights.
        seed: see above.
        channels: of the batches.
        drop_channels: probability that an optional channel of a cube is made unknown, in [0, 1].
        redraw_edges: as above; False leaves all edge fractions as they are.
    """

    def __init__(
        self,
        shards: Sequence[tuple[str | Path, float]],
        *,
        seed: int,
        channels: Sequence[str] = (SIGNED_OPACITY,),
        drop_channels: float = 0.0,
        redraw_edges: bool = True,
    ) -> None:
        if not shards:
            raise InvalidArgument("Mixture: at least one training shard is needed")
        weights = np.array([weight for _, weight in shards], dtype=np.float64)
        if not (np.isfinite(weights).all() and (weights > 0).all()):
            raise InvalidArgument(f"Mixture: weights must be finite and > 0, got {weights.tolist()}")
        if not 0.0 <= drop_channels <= 1.0:
            raise InvalidArgument(f"Mixture: drop_channels must lie in [0, 1], got {drop_channels}")
        self.channels = check_channels(channels, caller="Mixture")
        self.shards: list[Shard] = [read_shard(path) for path, _ in shards]
        for (path, _), shard in zip(shards, self.shards):
            if not len(shard):
                raise InvalidFile(f"Mixture: {path} holds no cubes")
        self.seed, self.drop_channels, self.redraw_edges = seed, drop_channels, redraw_edges
        self._cumulative = np.cumsum(weights) / weights.sum()

    def _draw(self, index: int) -> _Draw:
        rng = np.random.default_rng([self.seed, index])
        choice = int(np.searchsorted(self._cumulative, rng.random(), side="right"))
        shard = self.shards[min(choice, len(self.shards) - 1)]
        cube, symmetry, position = int(rng.integers(len(shard))), int(rng.integers(len(SYMMETRIES))), rng.random()
        depth = float(np.exp(rng.uniform(-DEPTH_JITTER, DEPTH_JITTER)))
        chances = rng.random(len(OPTIONAL_CHANNELS))  # by name: the order of channels is the caller's
        chance = dict(zip(OPTIONAL_CHANNELS, chances))
        if chance[SUPPORT] < self.drop_channels:
            chance[CROSSINGS] = 0.0  # without points there are no sight lines; points without tracks do exist
        dropped = frozenset(name for name, value in chance.items() if value < self.drop_channels)
        harvested, edge, anew = _harvested(shard), float(shard.edge_fraction[cube]), any_edge(rng)
        if self.redraw_edges:
            edge = edge * float(np.exp(-rng.uniform(0.0, np.log(FINER)))) if harvested else anew
        return _Draw(shard, cube, symmetry, float(position), depth if harvested else 1.0, dropped, edge)

    def _channels(self, draw: _Draw) -> NDArray[np.float32]:
        """``(C, R, R, R)`` of one sample, its symmetry applied to all alike."""
        stored = stored_channels(draw.shard, [draw.cube], self.channels, depth=draw.depth, without=draw.dropped)[0]
        return np.stack([apply_symmetry(grid, draw.symmetry) for grid in stored])

    def batch(self, step: int, batch_size: int) -> Batch:
        """Samples ``step * batch_size`` to ``(step + 1) * batch_size``."""
        draws = [self._draw(index) for index in range(step * batch_size, (step + 1) * batch_size)]
        labels = [apply_symmetry(unpack_labels(d.shard.labels[d.cube : d.cube + 1])[0], d.symmetry) for d in draws]
        severity = np.array([d.shard.severity[d.cube] for d in draws])
        return Batch(
            np.stack([self._channels(d) for d in draws]),
            np.stack(labels),
            timesteps(severity, np.array([d.position for d in draws])),
            np.array([d.edge_fraction for d in draws], dtype=np.float32),
            np.array([_harvested(d.shard) for d in draws]),
        )

    def stream(self, first_step: int, batch_size: int, *, ahead: int = 2) -> Generator[Batch, None, None]:
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
