"""Train the diffusions that the comparison needs, one after the other, each for the same time or number of steps.

python -m benchmarks.release.train_diffusion SHARDS [SHARDS ...] --out RUNS --minutes 60
python -m benchmarks.release.train_diffusion SHARDS --out RUNS --minutes 240 --which unet-epsilon --device cuda
python -m benchmarks.release.train_diffusion --short        a few steps, into out/short/diffusion

SHARDS is FOLDER or FOLDER=WEIGHT, a shard or a folder of shards. The compact runs differ from ``unghost train`` in
nothing but the objective: network, batches, optimiser and budget are those of the restoration priors. A run that was
killed goes on with ``--resume``. Each leaves RUNS/NAME/model.safetensors and RUNS/NAME/config.json, from which
``unghost train SHARDS --config RUNS/NAME/config.json`` trains it again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

import tyro

from unghost.core.shards.finding import expand_shards
from unghost.prior.networks.restoration import SIZES
from unghost.prior.networks.unet import UNetConfig
from unghost.prior.training.config import TrainConfig
from unghost.prior.training.loop import train

from ..options import ROOT, SAMPLE, SHARDS, SHORT_RESULTS, BenchmarkOptions, give_up, parse
from ..progress import Plan, say, wrote

ENDLESS = 10_000_000  # steps, where the time decides
RUNS = {
    "compact-epsilon": TrainConfig(objective="epsilon"),
    "small-epsilon": TrainConfig(objective="epsilon", network=SIZES["xs"]),  # what the two-trajectory benchmark uses
    "compact-x0": TrainConfig(objective="x0"),
    "compact-bernoulli": TrainConfig(objective="bernoulli"),
    "unet-epsilon": TrainConfig(objective="epsilon", network=UNetConfig(), batch_size=16, learning_rate=2e-4),
    "unet-x0": TrainConfig(objective="x0", network=UNetConfig(), batch_size=16, learning_rate=2e-4),
}
DEFAULT = ("compact-epsilon", "compact-x0", "compact-bernoulli", "unet-epsilon")


@dataclass(frozen=True)
class Options(BenchmarkOptions):
    """What to train, and for how long.

    Attributes:
        shards: FOLDER or FOLDER=WEIGHT, as ``unghost train`` takes them.
        out: folder of the runs, one a diffusion.
        which: diffusions to train.
        minutes: of each run.
        steps: of each run, at most.
        batch_size: cubes a step; 0: each run's own.
        validation: NAME=SHARD, scored while it trains.
        device: of torch.
        precision: of the network while it trains.
        threads: of torch; 0: torch's own choice.
        seed: of the weights and of the stream of samples.
        resume: go on where a run was killed.
    """

    SHORT: ClassVar[dict[str, Any]] = {
        "shards": (str(SAMPLE),),
        "out": SHORT_RESULTS / "diffusion",
        "which": ("small-epsilon", "compact-x0", "compact-bernoulli"),
        "steps": 3,
        "batch_size": 2,
        "threads": 2,
    }
    DATA: ClassVar[dict[str, str]] = {"shards": SHARDS}

    shards: tyro.conf.Positional[tuple[str, ...]] = ()
    out: Path = ROOT / "out" / "diffusion"
    which: tuple[Literal[tuple(sorted(RUNS))], ...] = DEFAULT  # type: ignore[valid-type]
    minutes: float = 0.0
    steps: int = 0
    batch_size: int = 0
    validation: tuple[str, ...] = ()
    device: str = "cpu"
    precision: Literal["auto", "bf16", "fp32"] = "auto"
    threads: int = 0
    seed: int = 0
    resume: bool = False


def configured(name: str, options: Options) -> TrainConfig:
    """The run of that name with the options of the command line."""
    base = RUNS[name]
    return TrainConfig(
        name=f"unghost-{name}",
        objective=base.objective,
        network=base.network,
        seed=options.seed,
        steps=options.steps or ENDLESS,
        max_seconds=options.minutes * 60.0 if options.minutes else None,
        batch_size=options.batch_size or base.batch_size,
        learning_rate=base.learning_rate,
        device=options.device,
        threads=options.threads,
        precision=options.precision,
    )


def run(name: str, options: Options) -> str:
    """Train one; a line that says how its loss went."""
    losses: list[float] = []
    result = train(
        configured(name, options),
        train_shards=[pair for spec in options.shards for pair in expand_shards(spec)],
        validation_shards=dict(spec.split("=", 1) for spec in options.validation),
        out=options.out / name,
        resume=options.resume,
        on_step=lambda step, values: losses.append(values["loss"]),
    )
    part = max(1, len(losses) // 5)
    first, last = (sum(values) / part for values in (losses[:part], losses[-part:]))
    return f"{name}: {result.steps} steps in {result.seconds:.0f} s, loss {first:.4f} -> {last:.4f}, {result.model}"


def main(argv: Sequence[str] | None = None) -> None:
    options = parse(Options, __doc__, argv)
    if not (options.minutes or options.steps):
        give_up(Options, "give --minutes or --steps")
    guess = 60 * options.minutes or 3.0 * options.steps
    plan = Plan(options.which, dict.fromkeys(options.which, guess))
    for name in options.which:
        plan.begin(name, name)
        say(run(name, options))
    wrote(*(options.out / name / "model.safetensors" for name in options.which))


if __name__ == "__main__":
    main()
