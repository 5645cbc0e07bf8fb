"""A frequency-encoded MLP as a radiance field (Mildenhall et al. 2020, without its second, finer network)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from .implicit import EncodedField, check_encoded


@dataclass(frozen=True)
class FrequencyConfig:
    """Size and start of the field.

    Attributes:
        resolution: half wavelengths of the highest frequency along an axis of the contracted cube.
        width, hidden: of the network.
        initial_opacity: opacity of one cell (half the shortest wavelength) before training.
        contract: False for a scene that lies wholly in [-1, 1]^3.
        seed: of the start values.

    Example:
        >>> FrequencyConfig(resolution=64).octaves
        6
    """

    resolution: int = 128
    width: int = 64
    hidden: int = 3
    initial_opacity: float = 0.01
    contract: bool = True
    seed: int = 0

    def __post_init__(self) -> None:
        check_encoded(self)

    @property
    def octaves(self) -> int:
        """Frequencies an axis, each half the next, down to a period no longer than the cube."""
        return 1 + math.floor(math.log2(self.resolution / 2) + 1e-9)


def frequency_encode(positions: Tensor, frequencies: Tensor) -> Tensor:
    """``(N, 3 + 6 F)``: the position, then sines, then cosines of ``2 pi f x`` (Mildenhall et al. 2020, eq. 4).

    Args:
        positions: ``(N, 3)``.
        frequencies: ``(F,)`` in periods a unit of length.

    Example:
        >>> frequency_encode(torch.tensor([[0.5, 0.0, 0.0]]), torch.tensor([1.0, 2.0])).shape
        torch.Size([1, 15])
    """
    angle = (positions[:, :, None] * (2.0 * math.pi * frequencies)).flatten(1)
    return torch.cat([positions, angle.sin(), angle.cos()], dim=1)


class FrequencyField(EncodedField):
    """Positional encoding and a small MLP; see :class:`FrequencyConfig`.

    It has no cells. Its ``field_pitch`` is half the wavelength of its highest frequency: that is the distance
    between neighbouring extrema of its finest input, and the sampling distance at which a signal of that band
    is just determined (Nyquist), which is what a cell is to a grid. The layers behind can make harmonics and so
    finer detail, but an MLP learns low frequencies first: one that is trained for a few hundred steps stays
    coarser than its pitch, not finer.

    Example:
        >>> field = FrequencyField(FrequencyConfig(resolution=16))
        >>> field.density_fn(torch.zeros(5, 3)).shape
        torch.Size([5, 1])
    """

    frequencies: Tensor

    def __init__(self, config: FrequencyConfig | None = None) -> None:
        config = config or FrequencyConfig()
        octaves = config.octaves
        super().__init__(config, 3 + 6 * octaves)
        self.config = config
        highest = 0.5 / self.field_pitch
        self.register_buffer("frequencies", highest * 0.5 ** torch.arange(octaves - 1, -1, -1.0), persistent=False)

    def encode(self, local: Tensor) -> Tensor:
        """``(N, 3 + 6 * octaves)`` of ``local (N, 3)`` in [-half_side, half_side]."""
        return frequency_encode(local, self.frequencies)

    def parameter_groups(self) -> list[tuple[list[torch.nn.Parameter], float]]:
        """Parameters and their learning rates relative to a dense grid's."""
        return [(list(self.parameters()), 0.1)]
