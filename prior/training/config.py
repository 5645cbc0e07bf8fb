"""How to train: one frozen dataclass, dumped with every run."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from ...core.config import from_dict, to_dict
from ...core.errors import InvalidArgument
from ..networks.registry import BackboneConfig, backbone_from_dict, network_for
from ..networks.restoration import NetworkConfig


@dataclass(frozen=True)
class TrainConfig:
    """Everything that determines a run, shards aside.

    Attributes:
        name: of the model, for its manifest.
        network: channels, widths and depths; a UNetConfig for the paper's U-Net.
        objective: ``restoration``, or a diffusion: ``epsilon`` (the paper), ``x0``, ``bernoulli``. A diffusion learns
            the labels (surface or not; "ignore" is not) and leaves the corrupted inputs aside.
        seed: of the initial weights and of the stream of samples.
        steps: optimiser steps; with ``max_seconds`` whichever is over first.
        max_seconds: time budget, or None. The learning rate follows ``max(step / steps, elapsed / max_seconds)``,
            so a run that ends by time ends with a decayed rate; only without it is a resumed run bit-exact.
        batch_size: cubes a step.
        learning_rate: peak, of AdamW.
        final_rate: of the peak, at the end of the cosine.
        weight_decay: on matrices and kernels, not on biases or the gain.
        warmup_steps: of linear warm-up.
        gradient_clip: largest norm of the gradient.
        ema_decay: of the averaged weights, which are the ones kept.
        drop_channels: share of the cubes of which an optional channel is made unknown, channel by channel: the model
            then serves callers who cannot supply it.
        interesting_weight: of voxels that are opaque, surface or beside such, in the loss.
        keep_weight: of true surface in harvested cubes, on top. In fog the odds of a voxel being surface are seldom
            even; with 8, the decision ``x0_pred < 0`` removes only what is ghost at more than 8 : 1.
        precision: ``auto`` is bf16 where the processor multiplies it natively, else fp32.
        device: as torch names it.
        threads: of torch; 0 leaves it alone.
        checkpoint_seconds: between checkpoints.
        checkpoint_steps: the same in steps; 0 for by time only.
        validate_seconds: between validations; 0 for at the end only.
        validate_cubes: at most so many of each validation shard while training (all of them at the end).
        default_timestep: of the manifest; None for 900, or 50 for a diffusion (the paper's range is 10 to 50).
        threshold_from: validation shards, joined by commas; the mean of their thresholds at .98 of the surface kept
            goes to the manifest; "" for 0.
        init_from: checkpoint (``model.safetensors``) to start from, or ""; it may see other channels.
    """

    name: str = "unghost-restoration"
    network: BackboneConfig = field(default_factory=NetworkConfig)
    objective: Literal["restoration", "epsilon", "x0", "bernoulli"] = "restoration"
    seed: int = 0
    steps: int = 30_000
    max_seconds: float | None = None
    batch_size: int = 48
    learning_rate: float = 1e-3
    final_rate: float = 0.01
    weight_decay: float = 0.01
    warmup_steps: int = 200
    gradient_clip: float = 1.0
    ema_decay: float = 0.999
    drop_channels: float = 0.15
    interesting_weight: float = 4.0
    keep_weight: float = 8.0
    precision: Literal["auto", "bf16", "fp32"] = "auto"
    device: str = "cpu"
    threads: int = 0
    checkpoint_seconds: float = 120.0
    checkpoint_steps: int = 0
    validate_seconds: float = 300.0
    validate_cubes: int = 512
    default_timestep: int | None = None
    threshold_from: str = ""
    init_from: str = ""

    def __post_init__(self) -> None:
        positive = (
            "steps",
            "batch_size",
            "learning_rate",
            "gradient_clip",
            "interesting_weight",
            "keep_weight",
            "validate_cubes",
        )
        for name in (*positive, "checkpoint_seconds"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise InvalidArgument(f"TrainConfig: {name} must be finite and > 0, got {value}")
        for name in ("weight_decay", "warmup_steps", "final_rate", "threads", "checkpoint_steps", "validate_seconds"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise InvalidArgument(f"TrainConfig: {name} must be finite and >= 0, got {value}")
        if self.max_seconds is not None and not self.max_seconds > 0:
            raise InvalidArgument(f"TrainConfig: max_seconds must be > 0 or None, got {self.max_seconds}")
        if not 0.0 <= self.drop_channels <= 1.0:
            raise InvalidArgument(f"TrainConfig: drop_channels must lie in [0, 1], got {self.drop_channels}")
        if not 0.0 <= self.ema_decay < 1.0:
            raise InvalidArgument(f"TrainConfig: ema_decay must lie in [0, 1), got {self.ema_decay}")
        if self.precision not in ("auto", "bf16", "fp32"):
            raise InvalidArgument(f"TrainConfig: precision must be 'auto', 'bf16' or 'fp32', got {self.precision!r}")
        network_for(self.objective, self.network)  # refuses an unknown objective

    def to_json(self) -> str:
        """One JSON object."""
        return json.dumps(to_dict(self), indent=1, sort_keys=True)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> TrainConfig:
        """From parsed JSON or TOML; unknown keys are refused."""
        return from_dict(cls, values, nested={"network": backbone_from_dict})

    def learning_rate_at(self, step: int, progress: float) -> float:
        """Linear warm-up over ``warmup_steps``, then a cosine over ``progress`` in [0, 1] down to ``final_rate``."""
        warm = min(1.0, (step + 1) / (self.warmup_steps + 1))
        cosine = 0.5 * (1.0 + math.cos(math.pi * min(1.0, max(0.0, progress))))
        return self.learning_rate * warm * (self.final_rate + (1.0 - self.final_rate) * cosine)
