"""A backbone as a diffusion model: what its last layer means, the loss it is trained by, and x0 in a single step.

==========  =====================  ==========================================================  =====================
objective   the noise              what the network says, ``F`` being its last layer           the loss
==========  =====================  ==========================================================  =====================
epsilon     Gaussian               ``epsilon = F``: the paper, eq. 1                           ``|noise - epsilon|^2``
  shortcut                         ``epsilon = sqrt(1 - a) xt + sqrt(a) F``                    the same
x0          Gaussian               ``x0 = F``                                                  ``|x0 - F|^2``
bernoulli   flipped bits           ``logit(x0 = +1) = F + log((1 - f) / f) xt``                cross-entropy
==========  =====================  ==========================================================  =====================

The shortcut takes from the network what follows from xt alone: ``sqrt(1 - a) xt`` is the best linear guess of the
noise, and ``x0 = sqrt(a) xt - sqrt(1 - a) F`` then needs no division by ``sqrt(a)``, by which the plain form magnifies
its errors, 5e5 times at t = 999. The compact network has it; the paper's U-Net predicts the noise itself, as published.
A bit that is flipped with probability ``f`` says ``log((1 - f) / f) xt`` about its own x0 and nothing about others
(Bayes), so ``F`` is what the other voxels say of it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from ...core.config import from_dict, to_dict
from ...core.errors import InvalidArgument
from ...core.occupancy import EMPTY, OCCUPIED
from ...core.schedule import flip_log_odds
from ..networks.restoration import NetworkConfig, RestorationNet
from ..networks.unet import UNet, UNetConfig
from .formulas import kept_share, q_flip, q_sample, x0_from_epsilon

KIND = "diffusion"
OBJECTIVES = ("epsilon", "x0", "bernoulli")
Objective = Literal["epsilon", "x0", "bernoulli"]


@dataclass(frozen=True)
class DiffusionConfig:
    """What is diffused, and by which backbone.

    Attributes:
        objective: ``"epsilon"``, ``"x0"`` or ``"bernoulli"``.
        network: the compact pyramid or the paper's U-Net, of one channel.
        shortcut: of the epsilon objective, see the module's docstring; None for yes with the compact network and no
            with the U-Net. The others do not have the choice.
        kind: tells this from other networks in a file; always ``"diffusion"``.

    Example:
        >>> from unghost.prior.networks.restoration import SIZES
        >>> DiffusionConfig("epsilon", SIZES["xs"]).channels
        ('signed_opacity',)
    """

    objective: Objective
    network: NetworkConfig | UNetConfig
    shortcut: bool | None = None
    kind: str = KIND

    def __post_init__(self) -> None:
        if self.objective not in OBJECTIVES:
            raise InvalidArgument(f"DiffusionConfig: objective must be one of {OBJECTIVES}, got {self.objective!r}")
        if self.kind != KIND:
            raise InvalidArgument(f"DiffusionConfig: kind must be {KIND!r}, got {self.kind!r}")
        if self.network.channels != NetworkConfig().channels:
            raise InvalidArgument(
                f"DiffusionConfig: network must take signed opacity alone, got {self.network.channels}"
            )
        if self.shortcut is None:
            compact = isinstance(self.network, NetworkConfig)
            object.__setattr__(self, "shortcut", self.objective == "epsilon" and compact)
        if self.shortcut and self.objective != "epsilon":
            raise InvalidArgument(f"DiffusionConfig: shortcut is of objective 'epsilon', got {self.objective!r}")

    @property
    def channels(self) -> Any:
        """Input channels."""
        return self.network.channels

    def to_dict(self) -> dict[str, Any]:
        """JSON-able."""
        return to_dict(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> DiffusionConfig:
        """Inverse of :meth:`to_dict`; unknown keys are refused."""
        return from_dict(cls, values, nested={"network": _backbone})


def _backbone(values: Any) -> NetworkConfig | UNetConfig:
    if not isinstance(values, Mapping):
        raise InvalidArgument("DiffusionConfig: network must be a table")
    return (UNetConfig if values.get("kind") == UNetConfig.kind else NetworkConfig).from_dict(values)


class DiffusionNet(nn.Module):
    """A backbone and what it predicts; as a denoiser it takes its input for ``xt`` as it stands.

    Example:
        >>> from unghost.prior.networks.restoration import SIZES
        >>> network = DiffusionNet(DiffusionConfig("x0", SIZES["xs"])).eval()
        >>> x0, timestep = torch.full((1, 1, 32, 32, 32), -1.0), torch.tensor([50])
        >>> xt = network.noised(x0, timestep, torch.zeros_like(x0))
        >>> with torch.no_grad():
        ...     network(xt, timestep, torch.tensor([0.1])).shape
        torch.Size([1, 1, 32, 32, 32])
    """

    log_odds: Tensor

    def __init__(self, config: DiffusionConfig) -> None:
        super().__init__()
        self.config = config
        self.backbone: RestorationNet | UNet
        if isinstance(config.network, UNetConfig):
            self.backbone = UNet(config.network)
        else:
            self.backbone = RestorationNet(config.network)
            with torch.no_grad():
                self.backbone.gain.zero_()  # its shortcut is meant for logits of restoration; here it is learned
        table = torch.from_numpy(flip_log_odds()).float()
        self.register_buffer("log_odds", table, persistent=False)

    def raw(self, xt: Tensor, timestep: Tensor, edge_fraction: Tensor) -> Tensor:
        """The prediction in the objective's own terms: epsilon, x0 or a logit, unbounded, ``(N, 1, 32, 32, 32)``."""
        raw: Tensor = self.backbone.raw(xt, timestep, edge_fraction)
        xt = xt.float()
        if self.config.shortcut:
            kept = kept_share(timestep, xt)
            return (1.0 - kept).sqrt().float() * xt + kept.sqrt().float() * raw
        if self.config.objective == "bernoulli":
            return raw + self.log_odds[timestep].view(-1, 1, 1, 1, 1) * xt
        return raw

    def forward(self, xt: Tensor, timestep: Tensor, edge_fraction: Tensor) -> Tensor:
        """x0 in a single step.

        Args:
            xt: ``(N, 1, 32, 32, 32)``; bits for the Bernoulli objective (a soft value counts as a weaker bit).
            timestep: ``(N,)`` integers in [0, 1000): how noisy ``xt`` is taken to be.
            edge_fraction: ``(N,)`` > 0.

        Returns:
            ``x0_pred (N, 1, 32, 32, 32)`` in [-1, 1]: the posterior mean as the network sees it, clamped for the
            Gaussian objectives, ``tanh(logit / 2)`` for the Bernoulli one.
        """
        if self.config.shortcut:  # x0 without the detour over epsilon
            kept = kept_share(timestep, xt)
            raw = self.backbone.raw(xt, timestep, edge_fraction)
            x0 = kept.sqrt().float() * xt.float() - (1.0 - kept).sqrt().float() * raw
            return x0.clamp(EMPTY, OCCUPIED)
        said = self.raw(xt, timestep, edge_fraction)
        return _READOUTS[self.config.objective](said, xt.float(), timestep)

    def noised(self, x0: Tensor, timestep: Tensor, draws: Tensor) -> Tensor:
        """``xt`` from ``x0`` and standard normal draws of its shape, in the objective's own diffusion."""
        if self.config.objective == "bernoulli":
            return q_flip(x0, timestep, torch.special.ndtr(draws.double()).to(x0.dtype))
        return q_sample(x0, timestep, draws)

    def loss(self, x0: Tensor, timestep: Tensor, edge_fraction: Tensor, draws: Tensor) -> Tensor:
        """The training loss of each cube ``(N,)``, a mean over its voxels.

        Args:
            x0: clean signed occupancy ``(N, 1, 32, 32, 32)`` in {-1, +1}.
            timestep: ``(N,)``, uniform in [0, 1000) in training.
            edge_fraction: ``(N,)`` > 0.
            draws: standard normal, of x0's shape.
        """
        said = self.raw(self.noised(x0, timestep, draws), timestep, edge_fraction)
        return _LOSSES[self.config.objective](said, x0, draws).flatten(1).mean(1)


_READOUTS: dict[str, Callable[[Tensor, Tensor, Tensor], Tensor]] = {
    "epsilon": lambda said, xt, timestep: x0_from_epsilon(xt, timestep, said),
    "x0": lambda said, xt, timestep: said.clamp(EMPTY, OCCUPIED),
    "bernoulli": lambda said, xt, timestep: torch.tanh(said / 2.0),
}
_LOSSES: dict[str, Callable[[Tensor, Tensor, Tensor], Tensor]] = {
    "epsilon": lambda said, x0, draws: (said - draws) ** 2,
    "x0": lambda said, x0, draws: (said - x0) ** 2,
    "bernoulli": lambda said, x0, draws: functional.binary_cross_entropy_with_logits(
        said, (x0 > 0).to(said), reduction="none"
    ),
}
