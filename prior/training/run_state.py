"""One run's state: network, optimiser, average, step; saved and restored whole."""

from __future__ import annotations

import copy
import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from ...core.errors import InvalidArgument, InvalidFile, UnghostError
from ..checkpoint import CONFIG_KEY, load_model, read_tensors, write_tensors
from ..diffusion.model import DiffusionNet
from ..diffusion.objective import diffusion_losses
from ..networks.registry import AnyNetwork, build_network, network_for
from ..networks.rewire import can_rewire, rewire
from .batches import Batch
from .config import TrainConfig
from .distributed import Group
from .ema import ExponentialMovingAverage
from .objective import restoration_loss


class TrainingDiverged(UnghostError, RuntimeError):
    """The loss or the gradient stopped being finite; the last checkpoint is good."""


def use_bf16(precision: str, device: torch.device) -> bool:
    """Resolve ``"auto"``: True where bfloat16 is multiplied natively (AMX, avx512_bf16, CUDA)."""
    if precision != "auto":
        return precision == "bf16"
    if device.type == "cuda":
        return bool(torch.cuda.is_bf16_supported())
    try:
        flags = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return False
    return device.type == "cpu" and ("amx_bf16" in flags or "avx512_bf16" in flags)


def _optimizer(network: nn.Module, config: TrainConfig) -> torch.optim.AdamW:
    decayed = [value for value in network.parameters() if value.ndim > 1]
    others = [value for value in network.parameters() if value.ndim <= 1]
    groups = [{"params": decayed, "weight_decay": config.weight_decay}, {"params": others, "weight_decay": 0.0}]
    return torch.optim.AdamW(groups, lr=config.learning_rate, betas=(0.9, 0.99))


class Trainer:
    """Steps a network; ``step`` and ``elapsed`` survive :meth:`save` and :meth:`restore`.

    Of several processes (``group``) each learns from its part of every batch. ``started_from`` is the provenance of
    the weights of ``config.init_from``, or None.
    """

    def __init__(self, config: TrainConfig, *, group: Group | None = None) -> None:
        self.config = config
        self.group = group or Group()
        self.device = torch.device(config.device)
        self.bf16 = use_bf16(config.precision, self.device)
        with torch.random.fork_rng(devices=[]):  # the initial weights depend on the seed alone
            torch.manual_seed(config.seed)
            network = build_network(network_for(config.objective, config.network))
        self.started_from: dict[str, Any] | None = None
        if config.init_from:
            start = load_model(config.init_from)
            if start.network.config == network.config:
                network.load_state_dict(start.network.state_dict())
            elif can_rewire(start.network, network):
                rewire(start.network, network)
            else:
                raise InvalidArgument(
                    f"Trainer: init_from {config.init_from} has another network: {start.network.config}"
                )
            kept = (
                "seed",
                "steps",
                "seconds",
                "batch_size",
                "learning_rate",
                "commit",
                "shards",
                "started_from",
                "drop_channels",
                "keep_weight",
            )
            digest = hashlib.sha256(Path(config.init_from).read_bytes()).hexdigest()
            earlier = {key: value for key, value in start.manifest.training.items() if key in kept}
            seen = list(start.manifest.channels)
            self.started_from = {"name": start.manifest.name, "sha256": digest, "channels": seen, **earlier}
        self.network: AnyNetwork = network.to(self.device).to(memory_format=torch.channels_last_3d)  # type: ignore[call-overload]
        self.optimizer = _optimizer(self.network, config)
        self.average = ExponentialMovingAverage(self.network, decay=config.ema_decay)
        self.step = 0
        self.elapsed = 0.0

    @property
    def progress(self) -> float:
        """The part of the budget that is used, in [0, 1]: of the steps or of the seconds, whichever is more."""
        by_time = self.elapsed / self.config.max_seconds if self.config.max_seconds else 0.0
        return min(1.0, max(self.step / self.config.steps, by_time))

    def learn(self, batch: Batch) -> dict[str, float]:
        """One optimiser step.

        Returns:
            ``loss``, ``gradient_norm``, ``learning_rate``.

        Raises:
            TrainingDiverged: the loss or the gradient is not finite; weights are as before the step.
            RankLost: another process of the run is gone.
        """
        rate = self.config.learning_rate_at(self.step, self.progress)
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        loss = self._losses(batch).mean()
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        loss = self.group.average(self.network, loss)
        norm = nn.utils.clip_grad_norm_(self.network.parameters(), self.config.gradient_clip)
        values = {"loss": loss.item(), "gradient_norm": float(norm), "learning_rate": rate}
        if not bool(torch.isfinite(loss.detach()) & torch.isfinite(norm)):
            raise TrainingDiverged(f"train: step {self.step}: loss {values['loss']}, gradient norm {float(norm)}")
        self.optimizer.step()
        self.average.update(self.network)
        self.step += 1
        return values

    def _losses(self, batch: Batch) -> Tensor:
        """``(N,)`` float32, in the training's precision."""
        labels = torch.from_numpy(batch.labels).to(self.device)
        times, edges = (torch.from_numpy(v).to(self.device) for v in (batch.timestep, batch.edge_fraction))
        with torch.autocast(self.device.type, dtype=torch.bfloat16, enabled=self.bf16):
            if isinstance(self.network, DiffusionNet):
                first = self.step * self.config.batch_size + self.group.rank * len(labels)
                index = np.arange(first, first + len(labels))
                return diffusion_losses(self.network, labels, edges, index=index, seed=self.config.seed)
            channels = torch.from_numpy(batch.channels).to(self.device)
            logits = self.network.logits(channels, times, edges)
        kept = torch.from_numpy(np.where(batch.harvested, self.config.keep_weight, 1.0)).to(channels)
        return restoration_loss(
            logits, labels, channels[:, :1], interesting_weight=self.config.interesting_weight, keep_weight=kept
        )

    def averaged_network(self) -> AnyNetwork:
        """A separate network holding the averaged weights."""
        network: AnyNetwork = copy.deepcopy(self.network)
        network.load_state_dict(self.average.shadow)
        return network

    def save(self, path: Path) -> None:
        """Everything needed to go on, in one safetensors file, atomically."""
        tensors: dict[str, Tensor] = {f"live.{k}": v for k, v in self.network.state_dict().items()}
        tensors |= {f"average.{k}": v for k, v in self.average.shadow.items()}
        for index, slots in self.optimizer.state_dict()["state"].items():
            tensors |= {f"optimizer.{index}.{name}": torch.as_tensor(value) for name, value in slots.items()}
        metadata = {
            "step": str(self.step),
            "elapsed": repr(self.elapsed),
            "updates": str(self.average.updates),
            "config": self.config.to_json(),
            CONFIG_KEY: "state",
        }
        write_tensors(path, tensors, metadata)

    def restore(self, path: Path) -> None:
        """Continue from :meth:`save`.

        Raises:
            ValueError: unreadable file, or one of another network.
        """
        tensors, metadata = read_tensors(path)
        if not {"step", "elapsed", "updates"} <= set(metadata):
            raise InvalidFile(f"Trainer.restore: {path} is not a training state")

        def part(prefix: str) -> dict[str, Tensor]:
            return {k[len(prefix) :]: v.to(self.device) for k, v in tensors.items() if k.startswith(prefix)}

        try:
            self.network.load_state_dict(part("live."))
            self.average.load(part("average."), updates=int(metadata["updates"]))
        except (RuntimeError, KeyError) as error:
            raise InvalidFile(f"Trainer.restore: {path} holds another network ({error})") from None
        state: dict[int, dict[str, Any]] = {}
        for key, value in part("optimizer.").items():
            index, name = key.split(".", 1)
            state.setdefault(int(index), {})[name] = value.cpu() if name == "step" else value
        self.optimizer.load_state_dict({"state": state, "param_groups": self.optimizer.state_dict()["param_groups"]})
        self.step, self.elapsed = int(metadata["step"]), float(metadata["elapsed"])
