"""What fields share that are an encoding followed by small networks: hash grids, frequency-encoded MLPs.

positions -> contraction -> encoding -> trunk -> raw density, features
                                        features, view direction -> head -> colour
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from ..core.errors import InvalidArgument
from .radiance import CONTRACTED, Shade, contract

FEATURES = 15  # what the trunk tells the colour head, besides the density
LOOKS = 48  # nodes along an axis of the grid that knows where the field is empty
FADE = 0.95  # of that grid's memory, a look


class EncodedConfig(Protocol):
    """What :class:`EncodedField` needs to know."""

    @property
    def resolution(self) -> int:
        """Cells along an axis of the contracted cube (or of the box)."""

    @property
    def width(self) -> int:
        """Of hidden layers."""

    @property
    def hidden(self) -> int:
        """Hidden layers of the trunk."""

    @property
    def initial_opacity(self) -> float:
        """Opacity of one cell before training."""

    @property
    def contract(self) -> bool:
        """False for a scene that lies wholly in [-1, 1]^3."""

    @property
    def seed(self) -> int:
        """Of the start values."""


def check_encoded(config: EncodedConfig) -> None:
    """Raise a ``ValueError`` that names the field which is out of range."""
    name = type(config).__name__
    if config.resolution < 4:
        raise InvalidArgument(f"{name}: resolution must be >= 4, got {config.resolution}")
    if min(config.width, config.hidden) < 1:
        raise InvalidArgument(f"{name}: width and hidden must be >= 1, got {config.width} and {config.hidden}")
    if not 0.0 < config.initial_opacity < 1.0:
        raise InvalidArgument(f"{name}: initial_opacity must lie in (0, 1), got {config.initial_opacity}")


def network(sizes: list[int], generator: torch.Generator) -> nn.Sequential:
    """Linear layers of ``sizes`` with rectifiers between; He's uniform start from ``generator``, biases 0.

    The last layer starts at a tenth of that: the density nearly even, colours grey.
    """
    layers: list[nn.Module] = []
    for number, (inputs, outputs) in enumerate(pairwise(sizes), start=2):
        layer = nn.utils.skip_init(nn.Linear, inputs, outputs)
        bound = math.sqrt(6.0 / inputs) * (0.1 if number == len(sizes) else 1.0)
        with torch.no_grad():
            layer.weight.uniform_(-bound, bound, generator=generator)
            layer.bias.zero_()
        layers += [layer, nn.ReLU(inplace=True)]
    return nn.Sequential(*layers[:-1])


class EncodedField(nn.Module):
    """Density and view-dependent colour from an encoding and two small networks.

    A subclass gives :meth:`encode` and the number of its channels. ``density = softplus(raw) / field_pitch``, as in
    :class:`~.radiance.RadianceField`, so that a raw value means the same opacity of a cell at any resolution.

    Where the field is nearly empty is remembered on a grid (Müller et al. 2022, section C of the appendix):
    every look evaluates the density at one random point near each node and keeps the faded maximum.
    """

    peak: Tensor
    looks: Tensor

    def __init__(self, config: EncodedConfig, channels: int) -> None:
        super().__init__()
        self._config = config
        generator = torch.Generator().manual_seed(config.seed)
        self.trunk = network([channels, *[config.width] * config.hidden, 1 + FEATURES], generator)
        self.head = network([FEATURES + 3, config.width, 3], generator)
        self.start = math.log(math.expm1(-math.log1p(-config.initial_opacity)))
        self.register_buffer("peak", torch.zeros(LOOKS**3), persistent=False)
        self.register_buffer("looks", torch.zeros((), dtype=torch.int64), persistent=False)

    def encode(self, local: Tensor) -> Tensor:
        """Encoding ``(N, channels)`` of ``local (N, 3)`` in [-half_side, half_side]."""
        raise NotImplementedError("EncodedField: a kind of field must say how it encodes")

    @property
    def aabb(self) -> NDArray[np.float64]:
        """``(2, 3)``: the box that is not contracted."""
        return np.array([[-1.0] * 3, [1.0] * 3])

    @property
    def half_side(self) -> float:
        """Half side of the cube that the encoding covers."""
        return CONTRACTED if self._config.contract else 1.0

    @property
    def field_pitch(self) -> float:
        """Side of a cell inside the aabb, scene units; what a cell is, the kind of field says."""
        return 2.0 * self.half_side / self._config.resolution

    def _local(self, positions: Tensor) -> Tensor:
        return contract(positions) if self._config.contract else positions.clamp(-self.half_side, self.half_side)

    def density_fn(self, positions: Tensor) -> Tensor:
        """Density per scene unit at ``positions (..., 3)``: ``(..., 1)``, >= 0; 0 outside an uncontracted box.

        Positions that are NaN, or infinite in a contracted field, give NaN. No gradient flows to positions.
        """
        return self.query(positions.reshape(-1, 3))[0].reshape(*positions.shape[:-1], 1)

    def query(self, positions: Tensor) -> tuple[Tensor, Shade]:
        """Density ``(M,)`` at ``positions (M, 3)``, and colours of rows of them: :class:`~.kinds.TrainableField`."""
        flat = positions.detach().float()
        known = self.trunk(self.encode(self._local(flat)))
        density = nn.functional.softplus(known[:, 0] + self.start) / self.field_pitch
        if not self._config.contract:
            density = density * (flat.abs().amax(dim=-1) <= 1.0)

        def shade(rows: Tensor, directions: Tensor) -> Tensor:
            return torch.sigmoid(self.head(torch.cat([known[rows, 1:], directions], dim=1)))

        return density, shade

    def color(self, positions: Tensor, directions: Tensor) -> Tensor:
        """RGB in (0, 1) at ``positions (N, 3)`` seen along unit ``directions (N, 3)``: ``(N, 3)``."""
        return self.query(positions)[1](torch.arange(len(positions)), directions)

    def refine(self, share: float) -> bool:
        """Nothing to do: the resolution is the same from the first step to the last."""
        return False

    @torch.no_grad()
    def occupied_nodes(self, minimal_opacity: float) -> Tensor:
        """Nodes ``(LOOKS^3,)`` of the memory that are, or touch one that is, above ``minimal_opacity`` a cell.

        Every call looks at the field once more, at other random points; the first remembers nothing yet.
        """
        generator = torch.Generator().manual_seed(self._config.seed + 1_000_003 * (1 + int(self.looks)))
        cell = 2.0 * self.half_side / (LOOKS - 1)
        axis = torch.arange(LOOKS, dtype=torch.float32)
        nodes = torch.cartesian_prod(axis, axis, axis) + torch.rand(LOOKS**3, 3, generator=generator) - 0.5
        local = (nodes * cell - self.half_side).clamp_(-self.half_side, self.half_side)
        depth = [
            nn.functional.softplus(self.trunk(self.encode(part))[:, 0] + self.start)
            for part in torch.split(local, 16384)
        ]
        self.peak.mul_(FADE).copy_(torch.maximum(self.peak, -torch.expm1(-torch.cat(depth))))
        self.looks += 1
        dilated = nn.functional.max_pool3d(self.peak.view(1, 1, LOOKS, LOOKS, LOOKS), 3, stride=1, padding=1)
        return (dilated > minimal_opacity).reshape(-1)

    @torch.no_grad()
    def nearest_nodes(self, positions: Tensor) -> Tensor:
        """Row of the memory's node nearest to each of ``positions (N, 3)``: ``(N,)`` int64."""
        local = (self._local(positions) + self.half_side) * ((LOOKS - 1) / (2.0 * self.half_side))
        node = (local + 0.5).to(torch.int64).clamp_(0, LOOKS - 1)
        return (node[:, 0] * LOOKS + node[:, 1]) * LOOKS + node[:, 2]
