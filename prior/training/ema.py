"""An exponential moving average of weights, kept beside the live ones."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from ...core.errors import InvalidArgument


class ExponentialMovingAverage:
    """``shadow <- d shadow + (1 - d) weights`` with ``d = min(decay, (1 + n) / (10 + n))`` at the n-th update.

    Reads the live weights, never writes them; the warm-up of the decay lets short runs forget their start.
    """

    def __init__(self, network: nn.Module, *, decay: float) -> None:
        if not 0.0 <= decay < 1.0:
            raise InvalidArgument(f"ExponentialMovingAverage: decay must lie in [0, 1), got {decay}")
        self.decay = decay
        self.updates = 0
        self.shadow: dict[str, Tensor] = {name: value.detach().clone() for name, value in network.state_dict().items()}

    @torch.no_grad()
    def update(self, network: nn.Module) -> None:
        """Blend in the live weights."""
        decay = min(self.decay, (1.0 + self.updates) / (10.0 + self.updates))
        self.updates += 1
        for name, value in network.state_dict().items():
            self.shadow[name].lerp_(value, 1.0 - decay)

    @torch.no_grad()
    def load(self, shadow: Mapping[str, Tensor], *, updates: int) -> None:
        """Continue from saved averages."""
        for name, value in self.shadow.items():
            value.copy_(shadow[name])
        self.updates = updates
