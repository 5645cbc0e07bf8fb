"""The restoration network: opacity cubes in, logits of "this voxel is true surface" out.

No normalisation layers, all work on grids of 16^3 and coarser, where 3D convolutions are fast:

    channels 32^3 -> features -> space-to-depth -> stem 16^3 -> 8^3 -> 4^3 -> 8^3 -> 16^3 -> depth-to-space
                \\______________________________ gain * first channel _____________________________/

The surroundings, where a network has them, do not line up with the cube and enter by a branch of their own
(``prior/networks/context.py``) at 8^3.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from ...core.channels import SIGNED_OPACITY, SURROUNDINGS, check_channels
from ...core.config import from_dict, to_dict
from ...core.errors import InvalidArgument
from ...core.frames import RESOLUTION
from ...core.occupancy import opacity_from_signed
from ...core.schedule import TIMESTEPS
from .context import LEAK as LEAK
from .context import ContextBranch, activate, context_work

FREQUENCIES = 4
CONDITION_FEATURES = 2 * (2 * FREQUENCIES + 1)
EDGE_FRACTION_CENTER, EDGE_FRACTION_SPREAD = 0.1, 3.0  # log(edge_fraction) is squashed around the first
INITIAL_GAIN = 4.0


@dataclass(frozen=True)
class NetworkConfig:
    """Widths and depths; sizes XS to L differ in nothing else.

    Attributes:
        channels: names of the input channels (:mod:`unghost.core.channels`); the first is signed opacity.
        widths: feature channels at 16^3, 8^3 and 4^3; multiples of 8.
        blocks: residual blocks at 8^3 going down, at 4^3, and at 8^3 going up.
        condition_width: hidden units of the conditioning network.

    Example:
        >>> NetworkConfig(channels=("signed_opacity", "view_count")).channels
        ('signed_opacity', 'view_count')
    """

    channels: tuple[str, ...] = (SIGNED_OPACITY,)
    widths: tuple[int, int, int] = (32, 64, 80)
    blocks: tuple[int, int, int] = (1, 1, 1)
    condition_width: int = 64

    def __post_init__(self) -> None:
        object.__setattr__(self, "channels", check_channels(self.channels, caller="NetworkConfig"))
        object.__setattr__(self, "widths", tuple(self.widths))
        object.__setattr__(self, "blocks", tuple(self.blocks))
        if len(self.widths) != 3 or any(width < 8 or width % 8 for width in self.widths):
            raise InvalidArgument(f"NetworkConfig: widths must be three multiples of 8, got {self.widths}")
        if len(self.blocks) != 3 or any(count < 0 for count in self.blocks) or not sum(self.blocks):
            raise InvalidArgument(f"NetworkConfig: blocks must be three counts >= 0, not all 0, got {self.blocks}")
        if self.condition_width < 1:
            raise InvalidArgument(f"NetworkConfig: condition_width must be >= 1, got {self.condition_width}")

    @property
    def aligned(self) -> tuple[int, ...]:
        """Positions of the channels whose voxels are the cube's own: all but the surroundings."""
        return tuple(index for index, name in enumerate(self.channels) if name != SURROUNDINGS)

    @property
    def surroundings(self) -> int | None:
        """Position of the surroundings, or None."""
        return self.channels.index(SURROUNDINGS) if SURROUNDINGS in self.channels else None

    def to_dict(self) -> dict[str, Any]:
        """JSON-able."""
        return to_dict(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> NetworkConfig:
        """Inverse of :meth:`to_dict`; unknown keys are refused. ``channels`` may be 1, as it used to be written."""
        old = {"channels": (SIGNED_OPACITY,)} if values.get("channels") == 1 else {}
        return from_dict(cls, {**values, **old})


SIZES: dict[str, NetworkConfig] = {
    "xs": NetworkConfig(widths=(16, 32, 48)),
    "s": NetworkConfig(widths=(24, 48, 64)),
    "m": NetworkConfig(),
    "l": NetworkConfig(widths=(32, 80, 96), blocks=(2, 2, 2)),
}


def space_to_depth(grid: Tensor) -> Tensor:
    """``(N, C, 2a, 2b, 2c)`` to ``(N, 8C, a, b, c)``; channel ``c * 8 + dz * 4 + dy * 2 + dx``.

    Example:
        >>> space_to_depth(torch.zeros(1, 1, 32, 32, 32)).shape
        torch.Size([1, 8, 16, 16, 16])
    """
    count, channels, depth, height, width = grid.shape
    parts = grid.reshape(count, channels, depth // 2, 2, height // 2, 2, width // 2, 2)
    return parts.permute(0, 1, 3, 5, 7, 2, 4, 6).reshape(count, channels * 8, depth // 2, height // 2, width // 2)


def depth_to_space(grid: Tensor) -> Tensor:
    """Inverse of :func:`space_to_depth`.

    Example:
        >>> cubes = torch.arange(64.0).view(1, 1, 4, 4, 4)
        >>> bool((depth_to_space(space_to_depth(cubes)) == cubes).all())
        True
    """
    count, channels, depth, height, width = grid.shape
    parts = grid.reshape(count, channels // 8, 2, 2, 2, depth, height, width)
    return parts.permute(0, 1, 5, 2, 6, 3, 7, 4).reshape(count, channels // 8, depth * 2, height * 2, width * 2)


def voxel_features(channels: Tensor) -> Tensor:
    """Per-voxel inputs ``(N, C, R, R, R)``: the opacity ``o`` becomes ``2 sqrt(o) - 1``, other channels stay.

    The root spreads the low opacities, where fog lives, and keeps -1 and +1; opacities below 0 count as 0.
    """
    opacity = opacity_from_signed(channels[:, :1])
    spread = 2.0 * torch.sqrt(torch.relu(opacity)) - 1.0
    return torch.cat([spread, channels[:, 1:]], dim=1) if channels.shape[1] > 1 else spread


def condition_features(timestep: Tensor, edge_fraction: Tensor) -> Tensor:
    """``(N,)`` and ``(N,)`` to ``(N, 18)``: sines and cosines of t / 999 and of the squashed log edge fraction.

    ``tanh(log(edge_fraction / 0.1) / 3)`` keeps any positive edge fraction within the trained range.
    """
    time = timestep.float() / (TIMESTEPS - 1)
    edge = torch.tanh(torch.log(edge_fraction.float() / EDGE_FRACTION_CENTER) / EDGE_FRACTION_SPREAD)
    base = torch.stack([time, edge], dim=1)
    waves = math.pi * 2.0 ** torch.arange(-1, FREQUENCIES - 1, device=base.device, dtype=base.dtype)
    angles = (base[:, :, None] * waves).flatten(1)
    return torch.cat([base, torch.sin(angles), torch.cos(angles)], dim=1)


class ResidualBlock(nn.Module):
    """``x + conv2(leaky_relu(conv1(x) + bias))``, the bias coming from the conditioning; conv2 starts small."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first = nn.Conv3d(width, width, 3, padding=1, bias=False)
        self.second = nn.Conv3d(width, width, 3, padding=1)
        with torch.no_grad():
            self.second.weight.mul_(0.1)

    def forward(self, grid: Tensor, bias: Tensor) -> Tensor:
        """``grid (N, width, D, H, W)``, ``bias (N, width)``."""
        convolved = self.first(grid)
        hidden = activate(convolved + bias[:, :, None, None, None].to(convolved.dtype))
        return torch.add(grid, self.second(hidden))


class Upsample(nn.Module):
    """Twice the resolution: each voxel becomes 2x2x2, each of the eight by its own matrix, one bias for all.

    Equal to a 2x2x2 transposed convolution of stride 2, which torch runs many times slower on CPUs in
    bfloat16. Output channels of ``mix`` are ordered (dz, dy, dx, c), so that channels-last memory moves in runs.
    """

    def __init__(self, width: int, out: int) -> None:
        super().__init__()
        self.mix = nn.Conv3d(width, 8 * out, 1, bias=False)
        self.bias = nn.Parameter(torch.zeros(out))

    def forward(self, grid: Tensor) -> Tensor:
        """``(N, width, D, H, W)`` to ``(N, out, 2 D, 2 H, 2 W)``, channels last in memory."""
        mixed = functional.conv3d(grid, self.mix.weight, self.bias.repeat(8)).permute(0, 2, 3, 4, 1)
        count, depth, height, width, channels = mixed.shape
        parts = mixed.reshape(count, depth, height, width, 2, 2, 2, channels // 8).permute(0, 1, 4, 2, 5, 3, 6, 7)
        fine: Tensor = parts.reshape(count, 2 * depth, 2 * height, 2 * width, channels // 8)
        return fine.permute(0, 4, 1, 2, 3)


class RestorationNet(nn.Module):
    """Single-step denoiser with a 16^3, 8^3, 4^3 pyramid; see the module's docstring.

    Example:
        >>> network = RestorationNet(SIZES["xs"]).eval()
        >>> cubes = torch.full((2, 1, 32, 32, 32), -1.0)
        >>> with torch.no_grad():
        ...     x0_pred = network(cubes, torch.tensor([300, 300]), torch.full((2,), 0.1))
        >>> x0_pred.shape, bool(x0_pred.abs().max() <= 1)
        (torch.Size([2, 1, 32, 32, 32]), True)
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        fine, middle, coarse = config.widths
        self.stem = nn.Conv3d(8 * len(config.aligned), fine, 3, padding=1)
        self.down_middle = nn.Conv3d(fine, middle, 2, stride=2)
        self.down_coarse = nn.Conv3d(middle, coarse, 2, stride=2)
        self.up_middle = Upsample(coarse, middle)
        self.up_fine = Upsample(middle, fine)
        self.head = nn.Conv3d(fine, 8, 3, padding=1)
        self.gain = nn.Parameter(torch.tensor(INITIAL_GAIN))
        widths = [middle] * config.blocks[0] + [coarse] * config.blocks[1] + [middle] * config.blocks[2]
        self.blocks = nn.ModuleList(ResidualBlock(width) for width in widths)
        self.condition = nn.Sequential(
            nn.Linear(CONDITION_FEATURES + (0 if config.surroundings is None else fine), config.condition_width),
            nn.ReLU(),
            nn.Linear(config.condition_width, config.condition_width),
            nn.ReLU(),
            nn.Linear(config.condition_width, sum(widths)),
        )
        with torch.no_grad():
            self.head.weight.mul_(0.1)
        if config.surroundings is not None:
            self.context = ContextBranch(fine, middle)

    def logits(self, channels: Tensor, timestep: Tensor, edge_fraction: Tensor) -> Tensor:
        """Log-odds of "surface" for each voxel.

        Args:
            channels: ``(N, C, 32, 32, 32)`` in [-1, 1].
            timestep: ``(N,)`` integers in [0, 1000): at most this much corruption is in the cube.
            edge_fraction: ``(N,)`` > 0, the cube's edge over the scene's extent.

        Returns:
            ``(N, 1, 32, 32, 32)``, unbounded.
        """
        return self.raw(channels, timestep, edge_fraction, spread=True)

    def raw(self, channels: Tensor, timestep: Tensor, edge_fraction: Tensor, *, spread: bool = False) -> Tensor:
        """The last layer and the shortcut; of :func:`voxel_features` if ``spread``, else of the channels as they are.

        Diffusion takes the latter: its noisy cubes leave [-1, 1], and the features would cut that off.
        """
        config = self.config
        _check_shapes(channels, timestep, edge_fraction, len(config.channels))
        down, bottom, _ = config.blocks
        condition, aligned, beside = condition_features(timestep, edge_fraction), channels, None
        if config.surroundings is not None:
            aligned = channels[:, list(config.aligned)]
            beside, pooled = self.context(channels[:, config.surroundings : config.surroundings + 1])
            condition = torch.cat([condition, pooled.to(condition.dtype)], dim=1)
        features = voxel_features(aligned) if spread else aligned
        widths = [block.first.in_channels for block in self.blocks]  # type: ignore[union-attr]
        biases = self.condition(condition).split(widths, dim=1)
        steps = list(zip(self.blocks, biases))
        fine = activate(self.stem(space_to_depth(features)))
        middle = self.down_middle(fine)
        if beside is not None:
            middle = middle + beside
        for block, bias in steps[:down]:
            middle = block(middle, bias)
        coarse = self.down_coarse(middle)
        for block, bias in steps[down : down + bottom]:
            coarse = block(coarse, bias)
        middle = middle + self.up_middle(coarse)
        for block, bias in steps[down + bottom :]:
            middle = block(middle, bias)
        fine = activate(fine + self.up_fine(middle))
        return depth_to_space(self.head(fine)).float() + self.gain * channels[:, :1].float()

    def forward(self, channels: Tensor, timestep: Tensor, edge_fraction: Tensor) -> Tensor:
        """``x0_pred (N, 1, 32, 32, 32)`` in [-1, 1]: ``tanh(logits / 2)``, that is 2 p - 1."""
        return torch.tanh(self.logits(channels, timestep, edge_fraction) / 2.0)


def _check_shapes(channels: Tensor, timestep: Tensor, edge_fraction: Tensor, expected: int) -> None:
    count = len(channels)
    shape = (count, expected, *(RESOLUTION,) * 3)
    if tuple(channels.shape) != shape:
        raise InvalidArgument(
            f"RestorationNet: channels must have shape (N, {expected}, {RESOLUTION}, {RESOLUTION}, {RESOLUTION}), "
            f"got {tuple(channels.shape)}"
        )
    for name, value in (("timestep", timestep), ("edge_fraction", edge_fraction)):
        if tuple(value.shape) != (count,):
            raise InvalidArgument(f"RestorationNet: {name} must have shape ({count},), got {tuple(value.shape)}")


def parameter_count(network: nn.Module) -> int:
    """Number of weights.

    Example:
        >>> parameter_count(nn.Linear(3, 2))
        8
    """
    return sum(parameter.numel() for parameter in network.parameters())


def gflop(config: NetworkConfig) -> float:
    """Convolution work for one cube in 10^9 operations (a multiply-add is two).

    Example:
        >>> gflop(SIZES["xs"]) < gflop(SIZES["s"])
        True
    """
    fine, middle, coarse = config.widths
    down, bottom, up = config.blocks
    work = 16**3 * 27 * fine * (8 * len(config.aligned) + 8)  # stem and head
    work += 8**3 * (8 * fine * middle + 27 * 2 * middle**2 * (down + up) + 8 * middle * fine)
    work += 4**3 * (8 * middle * coarse + 27 * 2 * coarse**2 * bottom + 8 * coarse * middle)
    if config.surroundings is not None:
        work += context_work(fine, middle)
    return 2.0 * work / 1e9
