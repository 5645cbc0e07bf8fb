"""The paper's backbone: a small 3D U-Net on all 32^3 voxels, with group norm, attention at 8^3 and embedded conditions.

    32^3   in -> block ---------------------------------------------- block, block -> out
                   \\ down                                        up /
    16^3                block ------------------------ block, block
                            \\ down                  up /
    8^3                          block, attention ------- (block, attention) x 2
                                             \\ block, attention, block /

The paper gives 7.2 M parameters and 28 MB; the widths (32 times 1, 2, 4), one residual block a level, and attention at
the coarsest level follow from its released configuration. The decoder has one block more at each level, as every
input of the encoder is joined to it again. What is ours: eight norm groups, and the embedding of ``edge_fraction``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from ...core.config import from_dict, to_dict
from ...core.errors import InvalidArgument
from ...core.frames import RESOLUTION
from .restoration import NetworkConfig

KIND = "unet"
EDGE_FRACTION_LEAST, EDGE_FRACTION_MOST = 0.005, 1.0  # the embedding varies between them, evenly in the logarithm
EDGE_WAVES = 6
MAX_PERIOD = 10_000.0  # of the timestep's sinusoids


@dataclass(frozen=True)
class UNetConfig:
    """The published sizes are the defaults.

    Attributes:
        kind: tells this from other networks in a file; always ``"unet"``.
        base_width: feature channels at 32^3.
        multipliers: of ``base_width``, at 32^3, 16^3, 8^3, …
        blocks: residual blocks a level in the encoder; the decoder has one more.
        heads: of the attention at the coarsest level.
        groups: of the group norms; divide every width.

    Example:
        >>> UNetConfig(base_width=16).multipliers
        (1, 2, 4)
    """

    kind: str = KIND
    base_width: int = 32
    multipliers: tuple[int, ...] = (1, 2, 4)
    blocks: int = 1
    heads: int = 4
    groups: int = 8

    def __post_init__(self) -> None:
        object.__setattr__(self, "multipliers", tuple(self.multipliers))
        if self.kind != KIND:
            raise InvalidArgument(f"UNetConfig: kind must be {KIND!r}, got {self.kind!r}")
        for name in ("base_width", "blocks", "heads", "groups"):
            if getattr(self, name) < 1:
                raise InvalidArgument(f"UNetConfig: {name} must be >= 1, got {getattr(self, name)}")
        if not self.multipliers or min(self.multipliers) < 1 or len(self.multipliers) > 5:
            raise InvalidArgument(f"UNetConfig: multipliers must be one to five integers >= 1, got {self.multipliers}")
        if self.base_width % self.groups or self.base_width % 2:
            raise InvalidArgument(
                f"UNetConfig: base_width must be even and a multiple of groups = {self.groups}, got {self.base_width}"
            )
        if self.widths[-1] % self.heads:
            raise InvalidArgument(
                f"UNetConfig: heads must divide the coarsest width {self.widths[-1]}, got {self.heads}"
            )

    @property
    def channels(self) -> Any:
        """Input channels, as :class:`unghost.prior.networks.restoration.NetworkConfig` says it: signed opacity
        alone."""
        return NetworkConfig().channels

    @property
    def widths(self) -> tuple[int, ...]:
        """Feature channels of each level, finest first."""
        return tuple(self.base_width * multiplier for multiplier in self.multipliers)

    @property
    def embedding_width(self) -> int:
        """Of the vector that carries timestep and edge fraction to every block."""
        return 4 * self.base_width

    def to_dict(self) -> dict[str, Any]:
        """JSON-able."""
        return to_dict(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> UNetConfig:
        """Inverse of :meth:`to_dict`; unknown keys are refused."""
        return from_dict(cls, values)


def timestep_features(timestep: Tensor, width: int) -> Tensor:
    """``(N,)`` to ``(N, width)``: cosines and sines of t at periods from 2 pi to 2 pi 10^4 (Ho et al. 2020).

    Example:
        >>> timestep_features(torch.tensor([0, 999]), 8).shape
        torch.Size([2, 8])
    """
    half = width // 2
    rates = torch.exp(-math.log(MAX_PERIOD) * torch.arange(half, device=timestep.device, dtype=torch.float32) / half)
    angles = timestep.float()[:, None] * rates
    return torch.cat([torch.cos(angles), torch.sin(angles)], dim=1)


def edge_features(edge_fraction: Tensor) -> Tensor:
    """``(N,)`` > 0 to ``(N, 13)``: the log edge fraction in [-1, 1] and its cosines and sines at six octaves.

    Half a turn of the slowest wave spans 0.5 % to 100 % of the scene, so that 1 % and 20 %, the sizes of the paper's
    cubes, lie more than half of the range apart, and steps of a few per cent of their size are told apart by the
    fastest. (The published embedding takes two values over that range.) Beyond the range the nearest end counts.
    """
    low, high = math.log(EDGE_FRACTION_LEAST), math.log(EDGE_FRACTION_MOST)
    place = ((torch.log(edge_fraction.float()) - low) / (high - low)).clamp(0.0, 1.0)
    waves = math.pi * 2.0 ** torch.arange(EDGE_WAVES, device=place.device, dtype=torch.float32)
    angles = place[:, None] * waves
    return torch.cat([2.0 * place[:, None] - 1.0, torch.cos(angles), torch.sin(angles)], dim=1)


def _zeroed(layer: nn.Conv3d) -> nn.Conv3d:
    """The layer, starting from zero: a new block is the identity."""
    nn.init.zeros_(layer.weight)
    if layer.bias is not None:
        nn.init.zeros_(layer.bias)
    return layer


class Block(nn.Module):
    """``skip(x) + conv2(silu(norm2(conv1(silu(norm1(x))) + bias)))``, the bias coming from the embedding."""

    def __init__(self, config: UNetConfig, width: int, out: int) -> None:
        super().__init__()
        self.norm1 = nn.GroupNorm(config.groups, width)
        self.conv1 = nn.Conv3d(width, out, 3, padding=1)
        self.bias = nn.Linear(config.embedding_width, out)
        self.norm2 = nn.GroupNorm(config.groups, out)
        self.conv2 = _zeroed(nn.Conv3d(out, out, 3, padding=1))
        self.skip = nn.Conv3d(width, out, 1) if width != out else nn.Identity()

    def forward(self, grid: Tensor, embedding: Tensor) -> Tensor:
        """``grid (N, width, D, D, D)``, ``embedding (N, E)``, after its activation, to ``(N, out, D, D, D)``."""
        hidden = self.conv1(functional.silu(self.norm1(grid))) + self.bias(embedding)[:, :, None, None, None]
        return torch.add(self.skip(grid), self.conv2(functional.silu(self.norm2(hidden))))


class Attention(nn.Module):
    """Self-attention over all voxels of a coarse grid, added to it."""

    def __init__(self, config: UNetConfig, width: int) -> None:
        super().__init__()
        self.heads = config.heads
        self.norm = nn.GroupNorm(config.groups, width)
        self.query_key_value = nn.Conv3d(width, 3 * width, 1)
        self.out = _zeroed(nn.Conv3d(width, width, 1))

    def forward(self, grid: Tensor, embedding: Tensor) -> Tensor:
        """``(N, width, D, D, D)`` to the same; the embedding is not used."""
        count, width = grid.shape[:2]
        shape = (count, 3, self.heads, width // self.heads, grid.shape[2:].numel())
        parts = self.query_key_value(self.norm(grid)).reshape(shape)
        query, key, value = parts.transpose(3, 4).unbind(1)  # (N, heads, voxels, width / heads)
        mixed = functional.scaled_dot_product_attention(query, key, value)
        return torch.add(grid, self.out(mixed.transpose(2, 3).reshape(grid.shape)))


class Down(nn.Module):
    """Half the resolution by a strided convolution."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.conv = nn.Conv3d(width, width, 3, stride=2, padding=1)

    def forward(self, grid: Tensor, embedding: Tensor) -> Tensor:
        """``(N, width, D, D, D)`` to ``(N, width, D / 2, D / 2, D / 2)``."""
        out: Tensor = self.conv(grid)
        return out


class Up(nn.Module):
    """Twice the resolution: nearest neighbour, then a convolution."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.conv = nn.Conv3d(width, width, 3, padding=1)

    def forward(self, grid: Tensor, embedding: Tensor) -> Tensor:
        """``(N, width, D, D, D)`` to ``(N, width, 2 D, 2 D, 2 D)``."""
        out: Tensor = self.conv(functional.interpolate(grid, scale_factor=2.0, mode="nearest"))
        return out


class Stage(nn.ModuleList):
    """Layers that share the embedding, one after the other."""

    def forward(self, grid: Tensor, embedding: Tensor) -> Tensor:
        """Run all."""
        for layer in self:
            grid = layer(grid, embedding)
        return grid


class UNet(nn.Module):
    """See the module's docstring; ``encoder`` yields one skip a stage, ``decoder`` takes them back last first.

    Example:
        >>> network = UNet(UNetConfig(base_width=8, multipliers=(1, 1, 1))).eval()
        >>> with torch.no_grad():
        ...     network(torch.zeros(1, 1, 32, 32, 32), torch.tensor([30]), torch.tensor([0.1])).shape
        torch.Size([1, 1, 32, 32, 32])
    """

    def __init__(self, config: UNetConfig) -> None:
        super().__init__()
        self.config = config
        widths, last = config.widths, len(config.widths) - 1
        self.time = self._embedder(config.base_width)
        self.edge = self._embedder(1 + 2 * EDGE_WAVES)
        self.first = nn.Conv3d(1, widths[0], 3, padding=1)
        self.encoder, kept, width = nn.ModuleList(), [widths[0]], widths[0]
        for level, out in enumerate(widths):
            for _ in range(config.blocks):
                self.encoder.append(self._stage(width, out, attend=level == last))
                width = out
                kept.append(width)
            if level < last:
                self.encoder.append(Stage([Down(width)]))
                kept.append(width)
        self.middle = Stage([Block(config, width, width), Attention(config, width), Block(config, width, width)])
        self.decoder = nn.ModuleList()
        for level in range(last, -1, -1):
            for index in range(config.blocks + 1):
                stage = self._stage(width + kept.pop(), widths[level], attend=level == last)
                width = widths[level]
                if level and index == config.blocks:
                    stage.append(Up(width))
                self.decoder.append(stage)
        self.norm = nn.GroupNorm(config.groups, width)
        self.last = _zeroed(nn.Conv3d(width, 1, 3, padding=1))

    def _embedder(self, features: int) -> nn.Sequential:
        width = self.config.embedding_width
        return nn.Sequential(nn.Linear(features, width), nn.SiLU(), nn.Linear(width, width))

    def _stage(self, width: int, out: int, *, attend: bool) -> Stage:
        block = Block(self.config, width, out)
        return Stage([block, Attention(self.config, out)] if attend else [block])

    def embedding(self, timestep: Tensor, edge_fraction: Tensor) -> Tensor:
        """``(N,)`` and ``(N,)`` to ``(N, 4 base_width)``, before its activation."""
        time = self.time(timestep_features(timestep, self.config.base_width))
        return torch.add(time, self.edge(edge_features(edge_fraction)))

    def raw(self, channels: Tensor, timestep: Tensor, edge_fraction: Tensor) -> Tensor:
        """The network's last layer, whatever it was trained to mean.

        Args:
            channels: ``(N, 1, 32, 32, 32)``, unbounded.
            timestep: ``(N,)`` integers in [0, 1000).
            edge_fraction: ``(N,)`` > 0, the cube's edge over the scene's extent.

        Returns:
            ``(N, 1, 32, 32, 32)`` float32.
        """
        _check_shapes(channels, timestep, edge_fraction)
        embedding = functional.silu(self.embedding(timestep, edge_fraction))
        grid = self.first(channels)
        kept = [grid]
        for stage in self.encoder:
            grid = stage(grid, embedding)
            kept.append(grid)
        grid = self.middle(grid, embedding)
        for stage in self.decoder:
            grid = stage(torch.cat([grid, kept.pop()], dim=1), embedding)
        out: Tensor = self.last(functional.silu(self.norm(grid))).float()
        return out

    def logits(self, channels: Tensor, timestep: Tensor, edge_fraction: Tensor) -> Tensor:
        """As a restoration network: log-odds of "surface" ``(N, 1, 32, 32, 32)``."""
        return self.raw(channels, timestep, edge_fraction)

    def forward(self, channels: Tensor, timestep: Tensor, edge_fraction: Tensor) -> Tensor:
        """As a restoration network: ``x0_pred (N, 1, 32, 32, 32)`` in [-1, 1], ``tanh(logits / 2)``."""
        return torch.tanh(self.logits(channels, timestep, edge_fraction) / 2.0)


def _check_shapes(channels: Tensor, timestep: Tensor, edge_fraction: Tensor) -> None:
    count, cube = len(channels), (1, *(RESOLUTION,) * 3)
    if tuple(channels.shape) != (count, *cube):
        raise InvalidArgument(f"UNet: channels must have shape (N, *{cube}), got {tuple(channels.shape)}")
    for name, value in (("timestep", timestep), ("edge_fraction", edge_fraction)):
        if tuple(value.shape) != (count,):
            raise InvalidArgument(f"UNet: {name} must have shape ({count},), got {tuple(value.shape)}")


def unet_gflop(config: UNetConfig) -> float:
    """Convolutions, linear layers and attention for one cube in 10^9 operations (a multiply-add is two).

    Counted by torch while the network runs on tensors without data.
    """
    from torch.utils.flop_counter import FlopCounterMode

    with torch.device("meta"):
        network = UNet(config)
        inputs = (torch.empty(1, 1, *(RESOLUTION,) * 3), torch.zeros(1, dtype=torch.long), torch.ones(1))
        with FlopCounterMode(display=False) as counter, torch.no_grad():
            network.raw(*inputs)
    return float(counter.get_total_flops()) / 1e9
