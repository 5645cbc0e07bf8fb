"""Train the diffusions that the comparison needs, one after the other, each for the same time or number of steps.

python -m benchmarks.release.train_diffusion SHARDS [SHARDS ...] --out RUNS --minutes 60
python -m benchmarks.release.train_diffusion SHARDS --out RUNS --minutes 240 --which unet-epsilon --device cuda
python -m benchmarks.release.train_diffusion SHARDS --out RUNS --steps 40 --batch-size 4        a look at whether they
learn

SHARDS is FOLDER or FOLDER=WEIGHT, a shard or a folder of shards. The compact runs differ from ``unghost train`` in
nothing but the objective: network, batches, optimiser and budget are those of the restoration priors. A run that was
killed goes on with ``--resume``. Each leaves RUNS/NAME/model.safetensors and RUNS/NAME/config.json, from which
``unghost train SHARDS --config RUNS/NAME/config.json`` trains it again.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from unghost.core.shards.finding import expand_shards
from unghost.prior.networks.restoration import SIZES
from unghost.prior.networks.unet import UNetConfig
from unghost.prior.training.config import TrainConfig
from unghost.prior.training.loop import train

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


def configured(name: str, options: argparse.Namespace) -> TrainConfig:
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


def run(name: str, options: argparse.Namespace) -> str:
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
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("shards", nargs="+")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--which", nargs="+", choices=sorted(RUNS), default=list(DEFAULT))
    parser.add_argument("--minutes", type=float, default=0.0, help="for each run")
    parser.add_argument("--steps", type=int, default=0, help="for each run")
    parser.add_argument("--batch-size", type=int, default=0)
    parser.add_argument("--validation", nargs="*", default=[], metavar="NAME=SHARD")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--precision", choices=("auto", "bf16", "fp32"), default="auto")
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--resume", action="store_true")
    options = parser.parse_args(argv)
    if not (options.minutes or options.steps):
        parser.error("give --minutes or --steps")
    print("\n".join([run(name, options) for name in options.which]))


if __name__ == "__main__":
    main()
