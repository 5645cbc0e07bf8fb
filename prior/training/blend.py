"""Batches of which a fixed part comes from shards and the rest from endless sources, made while the network trains."""

from __future__ import annotations

import itertools
from collections.abc import Generator, Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ...core.channels import stack_channels
from ...core.errors import InvalidArgument
from .batches import Batch, Mixture, any_edge, timesteps

STREAM = 0x6F6E6C  # keeps the timesteps of online samples apart from the draws of the mixture


class Pairs(Protocol):
    """Some pairs: ``channels (N, 1, R, R, R)`` signed opacity, ``labels (N, R, R, R)``, the rest ``(N,)``."""

    channels: NDArray[np.float32]
    labels: NDArray[np.uint8]
    severity: NDArray[np.float32]
    edge_fraction: NDArray[np.float32]


class PairSource(Protocol):
    """Something that makes pairs for ever: batch s of size n holds its samples ``s n`` to ``(s + 1) n - 1``."""

    def stream(self, first_step: int, batch_size: int) -> Generator[Any, None, None]:
        """Batches ``first_step``, ``first_step + 1``, …, each one :class:`Pairs`; closing it ends its workers."""


@dataclass(frozen=True)
class Online:
    """A source of pairs, its name for the record, and its share of each batch, in (0, 1]."""

    name: str
    share: float
    source: PairSource


def split_batch(batch_size: int, shares: Sequence[float]) -> list[int]:
    """Cubes of a batch for the shards, then for each online source: rounded, but at least one.

    Raises:
        ValueError: a share out of range, or more than there is.
    """
    if not all(0.0 < share <= 1.0 for share in shares):
        raise InvalidArgument(f"split_batch: the share of an online source must lie in (0, 1], got {list(shares)}")
    counts = [max(1, round(share * batch_size)) for share in shares]
    rest = batch_size - sum(counts)
    if rest < 0 or sum(shares) > 1.0 + 1e-9:
        raise InvalidArgument(f"split_batch: online shares {list(shares)} are more than a batch of {batch_size} cubes")
    return [rest, *counts]


class Blend:
    """Joins a :class:`Mixture` and online sources; batch s depends on their seeds and s alone.

    Args:
        mixture: of shards; None where the online sources fill the batch.
        online: the sources. Their optional channels are unknown: they make cubes, not scenes.
        batch_size: cubes a step.
        channels: of the batches.
        seed: of the timesteps and the edge fractions of online samples, drawn as the mixture does.
        redraw_edges: of online samples, as the mixture does.

    Raises:
        ValueError: shares that do not fit, shards without a part of the batch, or a part without shards.
    """

    def __init__(
        self,
        mixture: Mixture | None,
        online: Sequence[Online],
        *,
        batch_size: int,
        channels: Sequence[str],
        seed: int,
        redraw_edges: bool = True,
    ) -> None:
        self.mixture, self.online, self.channels, self.seed = mixture, list(online), tuple(channels), seed
        self.redraw_edges = redraw_edges
        self.counts = split_batch(batch_size, [part.share for part in online])
        if (mixture is None) == bool(self.counts[0]):
            have = "no shards" if mixture is None else "shards"
            raise InvalidArgument(f"Blend: {have}, and {self.counts[0]} of {batch_size} cubes a step are left for them")

    def _completed(self, pairs: Pairs, step: int, number: int) -> Batch:
        """What a source gave, with timesteps, and with channels that say "unknown"."""
        count = len(pairs.labels)
        rows = range(step * count, (step + 1) * count)
        rngs = [np.random.default_rng([self.seed, row, STREAM, number]) for row in rows]
        position = np.array([rng.random() for rng in rngs])
        edges = [any_edge(rng) for rng in rngs] if self.redraw_edges else pairs.edge_fraction
        return Batch(
            stack_channels(self.channels, pairs.channels[:, 0], {}),
            pairs.labels,
            timesteps(pairs.severity, position),
            np.asarray(edges, dtype=np.float32),
            np.zeros(count, dtype=bool),
        )

    def stream(self, first_step: int) -> Iterator[Batch]:
        """Batches ``first_step``, ``first_step + 1``, … for ever; closing it ends threads and workers."""
        if self.mixture is not None and not self.online:
            yield from self.mixture.stream(first_step, self.counts[0])
            return
        with ExitStack() as stack:
            parts = [part.source.stream(first_step, count) for part, count in zip(self.online, self.counts[1:])]
            shards = None if self.mixture is None else self.mixture.stream(first_step, self.counts[0])
            for part in (*parts, *([] if shards is None else [shards])):
                stack.enter_context(closing(part))
            for step in itertools.count(first_step):
                made = [self._completed(next(part), step, number) for number, part in enumerate(parts, 1)]
                yield join_batches([*([] if shards is None else [next(shards)]), *made])


def join_batches(batches: Sequence[Batch]) -> Batch:
    """One batch after the other."""
    names = ("channels", "labels", "timestep", "edge_fraction", "harvested")
    return Batch(*(np.concatenate([getattr(batch, name) for batch in batches]) for name in names))
