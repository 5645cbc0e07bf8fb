"""Does training wait for its data? Cubes a second of the loader alone, of the network alone, and of both together.

    python -m benchmarks.release.training_speed out/harvest out/procedural

The loader reads shards, draws symmetries and optical depths, unpacks labels and stacks the channels, as in
``unghost train``; the network learns from one batch again and again (forward, backward, AdamW, average). Each size is
timed with the cube alone and with all channels, the first of them also before freed memory is kept
(``prior/training/allocator.py``, as ``unghost train`` does). Writes docs/results/training_speed.json.
"""

from __future__ import annotations

import dataclasses
import itertools
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
import tyro

from unghost.core.channels import CHANNEL_NAMES
from unghost.core.results import build_results, write_results
from unghost.core.shards.finding import expand_shards
from unghost.prior.networks.restoration import SIZES
from unghost.prior.training.allocator import keep_freed_memory
from unghost.prior.training.batches import Mixture
from unghost.prior.training.config import TrainConfig
from unghost.prior.training.run_state import Trainer

from ..options import SAMPLE, SHARDS, BenchmarkOptions, parse
from ..progress import Plan, say, wrote
from ..timing import median_seconds

WARM_UP = 3


@dataclass(frozen=True)
class Options(BenchmarkOptions):
    """What to time.

    Attributes:
        shards: FOLDER or FOLDER=WEIGHT, as ``unghost train`` takes them.
        sizes: of the network.
        batch_size: cubes a step.
        batches: that are timed, for the median.
    """

    SHORT: ClassVar[dict[str, Any]] = {"shards": (str(SAMPLE),), "sizes": ("xs",), "batch_size": 8, "batches": 2}
    DATA: ClassVar[dict[str, str]] = {"shards": SHARDS}

    shards: tyro.conf.Positional[tuple[str, ...]] = ()
    sizes: tuple[str, ...] = ("xs", "s", "m")
    batch_size: int = 48
    batches: int = 15


def per_second(work: Callable[[], Any], options: Options) -> float:
    """Cubes a second, from the median call."""
    return options.batch_size / median_seconds(work, options.batches, warm_up=WARM_UP)[0]


def loader_speed(mixture: Mixture, options: Options) -> float:
    """Of the stream alone, as fast as it comes: over all batches, because it works ahead."""
    with closing(mixture.stream(0, options.batch_size)) as stream:
        for _ in range(WARM_UP):
            next(stream)
        begun = time.perf_counter()
        for batch in itertools.islice(stream, options.batches):
            if batch.channels.shape[:2] != (options.batch_size, len(mixture.channels)):
                raise ValueError(f"loader_speed: a batch of shape {batch.channels.shape}")
        return options.batch_size * options.batches / (time.perf_counter() - begun)


def row_of(size: str, channels: Sequence[str], options: Options) -> dict[str, Any]:
    """Loader, network, both together."""
    network = dataclasses.replace(SIZES[size], channels=tuple(channels))
    trainer = Trainer(TrainConfig(network=network, batch_size=options.batch_size))
    shards = [pair for spec in options.shards for pair in expand_shards(spec)]
    mixture = Mixture(shards, seed=0, channels=channels, drop_channels=trainer.config.drop_channels)
    batch = mixture.batch(0, options.batch_size)
    loader, alone = loader_speed(mixture, options), per_second(lambda: trainer.learn(batch), options)
    with closing(mixture.stream(0, options.batch_size)) as stream:
        both = per_second(lambda: trainer.learn(next(stream)), options)
    row = {
        "method": size,
        "channels": list(channels),
        "loader_cubes_per_second": loader,
        "network_cubes_per_second": alone,
        "training_cubes_per_second": both,
        "loader_over_network": loader / alone,
        "precision": "bf16" if trainer.bf16 else "fp32",
    }
    say(f"{size:2s} {len(channels)} channels: loader {loader:.0f}, network {alone:.0f}, together {both:.0f} cubes/s")
    return row


def main() -> None:
    options = parse(Options, __doc__)
    torch.set_num_threads(options.threads)
    sets = (CHANNEL_NAMES[:1], CHANNEL_NAMES)
    plan, rows = Plan([*options.sizes] * 3, dict.fromkeys(options.sizes, 60.0)), list[dict[str, Any]]()

    def measure(size: str, channels: Sequence[str], memory: str) -> None:
        plan.begin(size, f"{size}, {len(channels)} channels, freed memory {memory}")
        rows.append(row_of(size, channels, options) | {"memory": memory})

    for size in options.sizes:
        measure(size, sets[0], "returned")
    memory = "kept" if keep_freed_memory() else "returned"
    for size in options.sizes:
        for channels in sets:
            measure(size, channels, memory)
    results = build_results(
        rows, command=options.command(), seeds=[0], threads=options.threads, batch_size=options.batch_size
    )
    write_results(options.out / "training_speed.json", results)
    wrote(options.out / "training_speed.json")


if __name__ == "__main__":
    main()
