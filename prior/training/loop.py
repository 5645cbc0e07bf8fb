"""Train a prior from shards: checkpoints, validation, logs, a model at the end."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from ...core.errors import InvalidArgument
from ...core.io import write_text
from ...core.manifest import Manifest
from ...core.progress import progress_bar
from ...core.results import commit, versions
from ...core.shards.storage import Shard, read_shard
from ..checkpoint import TorchDenoiser, save_model
from ..networks.registry import DEFAULT_TIMESTEPS, family, network_gflop
from ..networks.restoration import parameter_count
from .batches import Mixture
from .blend import Blend, Online
from .config import TrainConfig
from .distributed import Group, joined
from .run_state import Trainer, TrainingDiverged
from .validation import evaluate
from .watch import WATCH_STEPS, LossWatch, complaint

MODEL_FILE, STATE_FILE, CONFIG_FILE, LOG_FILE = "model.safetensors", "state.safetensors", "config.json", "log.jsonl"

BAR_FORMAT = "{percentage:5.1f}% |{bar}| {elapsed} < {remaining}{postfix}"  # tqdm puts a comma first


@dataclass(frozen=True)
class TrainResult:
    """What a run left behind: the model's path, steps, seconds of training, why it ended, scores by shard."""

    model: Path
    steps: int
    seconds: float
    reason: str
    validation: dict[str, dict[str, Any]]


class _Log:
    """JSON lines, and TensorBoard where it is installed; nothing at all if not ``writes``."""

    def __init__(self, folder: Path, *, writes: bool = True) -> None:
        self._path, self._board, self._writes = folder / LOG_FILE, None, writes
        if not writes:
            return
        if self._path.is_file() and self._path.read_bytes()[-1:] not in (b"", b"\n"):
            self._append("")  # a run was killed while it wrote: what follows begins on a line of its own
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError:
            pass
        else:
            self._board = SummaryWriter(str(folder / "tensorboard"))

    def scalars(self, step: int, values: Mapping[str, float]) -> None:
        """To TensorBoard."""
        if self._board is not None:
            for name, value in values.items():
                self._board.add_scalar(name, value, step)

    def line(self, step: int, kind: str, values: Mapping[str, Any]) -> None:
        """To the log file."""
        if self._writes:
            self._append(json.dumps({"step": step, "kind": kind, **values}))

    def _append(self, text: str) -> None:
        with self._path.open("a", encoding="utf-8") as stream:
            stream.write(text + "\n")

    def close(self) -> None:
        if self._board is not None:
            self._board.close()


def _by_folder(shards: Sequence[tuple[str | Path, float]], lengths: Sequence[int]) -> list[dict[str, Any]]:
    """Shards of one folder as one entry: a manifest travels with every export, and a harvest has a shard a scene."""
    groups: dict[str, dict[str, Any]] = {}
    for (path, weight), cubes in zip(shards, lengths):
        name, source = Path(path).name, Path(path).parent.name
        entry = groups.setdefault(source, {"source": source, "first": name, "shards": 0, "cubes": 0, "weight": 0.0})
        entry |= {
            "last": name,
            "shards": entry["shards"] + 1,
            "cubes": entry["cubes"] + cubes,
            "weight": entry["weight"] + weight,
        }
    return [entry | {"weight": round(entry["weight"], 6)} for entry in groups.values()]


def _provenance(trainer: Trainer, shards: Sequence[tuple[str | Path, float]], blend: Blend) -> dict[str, Any]:
    config = trainer.config
    opened = [] if blend.mixture is None else blend.mixture.shards
    return {
        "seed": config.seed,
        "steps": trainer.step,
        "seconds": round(trainer.elapsed, 1),
        "batch_size": config.batch_size,
        "precision": "bf16" if trainer.bf16 else "fp32",
        "commit": commit(),
        "torch": versions().get("torch", ""),
        "gflop": round(network_gflop(config.network), 4),
        "objective": config.objective,
        "learning_rate": config.learning_rate,
        "keep_weight": config.keep_weight,
        "threshold_from": config.threshold_from,
        "started_from": trainer.started_from,
        "shards": _by_folder(shards, [len(shard) for shard in opened]),
        "drop_channels": config.drop_channels,
        "online": [{"name": part.name, "share": part.share} for part in blend.online],
    }


def _manifest(trainer: Trainer, training: dict[str, Any], threshold: float = 0.0) -> Manifest:
    kind, timestep = family(trainer.network.config), trainer.config.default_timestep
    return Manifest(
        name=trainer.config.name,
        family=kind,
        channels=trainer.config.network.channels,
        removal_threshold=threshold,
        default_timestep=DEFAULT_TIMESTEPS[kind] if timestep is None else timestep,
        parameters=parameter_count(trainer.network),
        training=training,
    )


def _validate(trainer: Trainer, shards: Mapping[str, Shard], limit: int | None) -> dict[str, dict[str, Any]]:
    """Scores of the averaged weights: quick and in the training's precision with a limit, else all and in fp32."""
    denoiser = TorchDenoiser(trainer.averaged_network(), _manifest(trainer, {}))
    with torch.autocast(trainer.device.type, dtype=torch.bfloat16, enabled=trainer.bf16 and limit is not None):
        return {name: evaluate(denoiser, shard, limit=limit) for name, shard in shards.items()}


def _log_validation(log: _Log, step: int, scores: Mapping[str, Mapping[str, Any]]) -> None:
    for name, row in scores.items():
        log.line(step, "validation", {"shard": name, **row})
        flat = {f"{name}/{key}": value for key, value in row.items() if isinstance(value, float)}
        log.scalars(step, flat)


def _threshold_names(config: TrainConfig) -> list[str]:
    return [name.strip() for name in config.threshold_from.split(",") if name.strip()]


def _finish(
    trainer: Trainer, out: Path, training: dict[str, Any], validation: Mapping[str, Shard]
) -> dict[str, dict[str, Any]]:
    """Score the averaged weights on all validation cubes and write the model with what was found."""
    scores = _validate(trainer, validation, None)
    found = [scores[name]["threshold_98"] for name in _threshold_names(trainer.config)]
    advised = [threshold for threshold in found if threshold is not None]
    headline = {
        name: {key: row[key] for key in ("cubes", "iou_before", "iou", "iou_clean", "ghosts_removed_98")}
        for name, row in scores.items()
    }
    manifest = _manifest(trainer, training | {"validation": headline}, sum(advised) / len(advised) if advised else 0.0)
    save_model(out / MODEL_FILE, trainer.averaged_network(), manifest)
    write_text(out / "validation.json", json.dumps(scores, indent=1) + "\n")
    return scores


def _prepare(config: TrainConfig, out: Path, resume: bool, group: Group) -> Trainer:
    """A trainer, fresh or restored; the configuration is on disk before the first step."""
    group.check(config)
    state = out / STATE_FILE
    if state.exists() and not resume:
        raise FileExistsError(f"train: {out} holds a run already; resume it, or name another folder")
    out.mkdir(parents=True, exist_ok=True)
    if group.first:
        write_text(out / CONFIG_FILE, config.to_json() + "\n")
    trainer = Trainer(config, group=group)
    if resume and state.exists():
        trainer.restore(state)
    return trainer


def _check(trainer: Trainer, losses: LossWatch) -> None:
    """Stop a run that is not learning any more, before its state is kept."""
    reason = complaint(trainer.network, losses)
    if reason is not None:
        raise TrainingDiverged(f"train: step {trainer.step}: {reason}")


def _run(
    trainer: Trainer,
    blend: Blend,
    out: Path,
    log: _Log,
    validation: Mapping[str, Shard],
    progress: bool,
    on_step: Callable[[int, Mapping[str, float]], None] | None,
) -> str:
    """Step until the budget is used; why it ended."""
    config, group, losses = trainer.config, trainer.group, LossWatch()
    shown = progress and group.first
    bar = progress_bar(1.0, unit="run", initial=trainer.progress, shown=shown, bar_format=BAR_FORMAT)
    begun, carried = time.monotonic(), trainer.elapsed
    first, saved, validated = trainer.step, begun, begun
    batches = blend.stream(trainer.step)
    try:
        while trainer.progress < 1.0:
            values = trainer.learn(group.share(next(batches)))
            now = time.monotonic()
            elapsed = carried + now - begun
            trainer.elapsed = group.agree(elapsed) if config.max_seconds else elapsed
            losses.add(values["loss"])
            rate = (trainer.step - first) * config.batch_size / max(now - begun, 1e-9)
            bar.set_postfix_str(f"step {trainer.step}, loss {losses.running:.4f}, {rate:.0f} cubes/s", refresh=False)
            bar.update(trainer.progress - bar.n)
            if trainer.step % 20 == 0 or trainer.step == 1:
                log.scalars(trainer.step, {f"train/{key}": value for key, value in values.items()})
                log.line(trainer.step, "train", {**values, "seconds": round(trainer.elapsed, 1)})
            due = config.checkpoint_steps and trainer.step % config.checkpoint_steps == 0
            due = group.first and (due or now - saved > config.checkpoint_seconds)
            if due or trainer.step % WATCH_STEPS == 0:
                _check(trainer, losses)
            if due:
                trainer.save(out / STATE_FILE)
                saved = time.monotonic()
            if group.first and config.validate_seconds and validation and now - validated > config.validate_seconds:
                _log_validation(log, trainer.step, _validate(trainer, validation, config.validate_cubes))
                validated = time.monotonic()
            if on_step is not None:
                on_step(trainer.step, values)
    finally:
        batches.close()  # type: ignore[attr-defined]
        bar.close()
    _check(trainer, losses)
    return "steps" if trainer.step >= config.steps else "max_seconds"


def _blend(config: TrainConfig, shards: Sequence[tuple[str | Path, float]], online: Sequence[Online]) -> Blend:
    """The stream of batches of a run."""
    names, redraw = (
        config.network.channels,
        config.objective == "restoration",
    )  # a diffusion learns scale, as in the paper
    mixture = None
    if shards or not online:
        mixture = Mixture(
            shards, seed=config.seed, channels=names, drop_channels=config.drop_channels, redraw_edges=redraw
        )
    return Blend(mixture, online, batch_size=config.batch_size, channels=names, seed=config.seed, redraw_edges=redraw)


def train(
    config: TrainConfig,
    *,
    train_shards: Sequence[tuple[str | Path, float]],
    validation_shards: Mapping[str, str | Path] | None = None,
    online: Sequence[Online] = (),
    out: str | Path,
    resume: bool = False,
    progress: bool = True,
    on_step: Callable[[int, Mapping[str, float]], None] | None = None,
) -> TrainResult:
    """Train, checkpoint, validate, and write ``out/model.safetensors`` (the averaged weights and a manifest).

    Also written: ``config.json`` before the first step, ``state.safetensors`` (everything needed to go on),
    ``log.jsonl``, ``tensorboard/``, ``validation.json``. On a CPU in fp32 with a budget of steps, a run that
    was killed and resumed ends with the same bits as one that was not. Under ``torchrun`` each process learns from its
    part of every batch and the first alone writes and validates (:mod:`.distributed`).

    Args:
        config: the run.
        train_shards: folders of :func:`unghost.core.shards.storage.write_shard` and their weights in the mixture; may
        be empty
            where online sources fill the batches.
        validation_shards: name to folder; held out.
        online: sources of pairs that are made meanwhile, each with its share of every batch. A run that is resumed with
            the same sources goes on with the samples that would have come.
        out: folder; must not hold a run unless ``resume``.
        resume: go on from ``out/state.safetensors`` (from the start if there is none).
        progress: a bar with loss, cubes per second and the part of the budget used.
        on_step: called after each step with its number and ``loss, gradient_norm, learning_rate``.

    Raises:
        TrainingDiverged: loss or gradient not finite, a running loss far above its lowest, or a network that does not
            see its input any more; the last checkpoint is kept.
        RankLost: another process of the run is gone.
        FileExistsError: ``out`` holds a run and ``resume`` is False.
        ValueError: an unreadable shard, an unknown ``threshold_from``.
    """
    named = dict(validation_shards or {})
    if not set(_threshold_names(config)) <= set(named):
        raise InvalidArgument(f"train: threshold_from {config.threshold_from!r} is not among {sorted(named)}")
    blend = _blend(config, train_shards, online)
    validation = {name: read_shard(path) for name, path in named.items()}
    if config.threads:
        torch.set_num_threads(config.threads)
    folder = Path(out)
    with joined(config.device) as group:
        trainer = _prepare(config, folder, resume, group)
        log, scores = _Log(folder, writes=group.first), {}
        try:
            reason = _run(trainer, blend, folder, log, validation, progress, on_step)
            if group.first:
                trainer.save(folder / STATE_FILE)
                scores = _finish(trainer, folder, _provenance(trainer, train_shards, blend), validation)
                _log_validation(log, trainer.step, scores)
        finally:
            log.close()
    return TrainResult(folder / MODEL_FILE, trainer.step, trainer.elapsed, reason, scores)
