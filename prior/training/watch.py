"""Is a run still learning? Two cheap looks: does the network see its input, and does the loss stay near its best?

Without norm layers, plain rectifiers were seen to die for good within 900 steps: the network then answers alike
whatever it is asked, and the shortcut from input to output keeps the loss finite and unsuspicious.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from ...core.errors import InvalidArgument
from ...core.frames import unit_lattice

WATCH_STEPS = 100  # between looks at the network, beside one before each checkpoint
DEAD = 1e-5  # float32 rounding gives about 1e-7
SMOOTHING = 0.98  # of the running loss
SETTLED_STEPS = 50  # before which the running loss says nothing
EXPLODED = 20.0  # times its lowest


def _probes() -> Tensor:
    """A ball and a wall, ``(2, 1, 32, 32, 32)``, -1 and +1."""
    lattice = torch.from_numpy(unit_lattice()).float()
    ball, wall = lattice.norm(dim=-1) < 0.3, lattice[..., 0].abs() < 0.06
    return torch.stack([ball, wall])[:, None].float() * 2.0 - 1.0


@torch.no_grad()
def input_dependence(network: nn.Module) -> float:
    """How much what the last convolution gives depends on the input.

    A ball and a wall are asked at the same timestep and edge fraction: the root mean square of the difference of the
    two outputs over that of the outputs themselves. 0 for a network that does not see its input (or whose last layer
    is zero), of order 1 for one that does. The shortcut around the network has no part in it. In float32.

    Args:
        network: called as ``network(channels, timestep, edge_fraction)``; ``config.channels`` names the
            channels.

    Raises:
        ValueError: a network without a 3D convolution.
    """
    given: list[Tensor] = []
    hooks = [
        module.register_forward_hook(lambda _module, _inputs, output: given.append(output.float()))
        for module in network.modules()
        if isinstance(module, nn.Conv3d)
    ]
    device = next(network.parameters()).device
    probes = _probes().to(device)
    channels: Any = network.config.channels  # type: ignore[union-attr]
    count = len(channels)
    others = probes.new_zeros(2, count - 1, *probes.shape[2:])
    times, edges = torch.full((2,), 500, device=device), torch.full((2,), 0.1, device=device)
    try:
        with torch.autocast(device.type, enabled=False):
            network(torch.cat([probes, others], dim=1), times, edges)
    finally:
        for hook in hooks:
            hook.remove()
    if not given:
        raise InvalidArgument(f"input_dependence: {type(network).__name__} has no 3D convolution")
    first, second = given[-1]
    level = torch.sqrt(0.5 * (first.square().mean() + second.square().mean()))
    return float((first - second).square().mean().sqrt() / level) if bool(level > 0) else 0.0


class LossWatch:
    """The running mean of a loss, and whether it has left its lowest far behind."""

    def __init__(self) -> None:
        self.running, self.lowest, self.count = 0.0, float("inf"), 0

    def add(self, loss: float) -> None:
        """The loss of one more step."""
        self.running = loss if not self.count else SMOOTHING * self.running + (1.0 - SMOOTHING) * loss
        self.count += 1
        if self.count >= SETTLED_STEPS:
            self.lowest = min(self.lowest, self.running)

    @property
    def exploded(self) -> bool:
        """Whether the running loss is more than ``EXPLODED`` times its lowest."""
        return self.running > EXPLODED * self.lowest


def complaint(network: nn.Module, losses: LossWatch) -> str | None:
    """Why a run should stop, or None."""
    if losses.exploded:
        return f"the running loss is {losses.running:.4g}, its lowest was {losses.lowest:.4g}"
    dependence = input_dependence(network)
    if not dependence > DEAD:
        return f"the network is dead: its output does not depend on its input ({dependence:.1e})"
    return None
