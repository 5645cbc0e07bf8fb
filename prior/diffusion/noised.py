"""A diffusion checkpoint as a denoiser that adds the noise of its timestep first, as score distillation does.

Without this a diffusion takes the cube for ``xt`` as it stands: binarised densities, -1 and +1, no noise added and
nothing scaled, at a small timestep. That is the paper's single step ("our DSDS loss does not add noise to the original
sampled occupancy"), and what :class:`unghost.prior.checkpoint.TorchDenoiser` does. It is far from what the network was
trained on, whose xt at t has noise in it; this is the other way, in which the cube counts as x0.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ...core.errors import InvalidArgument
from ..checkpoint import TorchDenoiser
from .model import DiffusionNet


class NoisedDenoiser:
    """``x0_pred`` of ``q(x_t | x0 = channels)``: another answer at each call, from an explicit generator.

    Args of the constructor: a denoiser of family ``"diffusion"``, and the generator, on any device.

    Raises:
        ValueError: a denoiser of another family, which adds no noise in its training.

    Example:
        >>> from unghost.core.manifest import Manifest
        >>> from unghost.prior.diffusion.model import DiffusionConfig
        >>> from unghost.prior.networks.restoration import SIZES
        >>> network = DiffusionNet(DiffusionConfig("x0", SIZES["xs"]))
        >>> manifest = Manifest(name="example", family="diffusion")
        >>> noised = NoisedDenoiser(TorchDenoiser(network, manifest), torch.Generator().manual_seed(0))
        >>> noised(torch.full((1, 1, 32, 32, 32), -1.0), 50, torch.tensor([0.1])).shape
        torch.Size([1, 1, 32, 32, 32])
    """

    kind = "torch"

    def __init__(self, denoiser: TorchDenoiser, generator: torch.Generator) -> None:
        if not isinstance(denoiser.network, DiffusionNet):
            raise InvalidArgument(
                f"NoisedDenoiser: denoiser must be of family 'diffusion', got {denoiser.manifest.family!r}"
            )
        self.denoiser = denoiser
        self.network: DiffusionNet = denoiser.network
        self.manifest = denoiser.manifest
        self.generator = generator

    @torch.no_grad()
    def __call__(self, channels: Tensor, timestep: Any, edge_fraction: Any) -> Tensor:
        """As the denoiser inside, of ``channels`` noised to ``timestep``."""
        times = torch.as_tensor(timestep, device=channels.device)
        times = times.expand(len(channels)) if times.ndim == 0 else times
        draws = torch.randn(channels.shape, generator=self.generator, device=self.generator.device)
        xt = self.network.noised(channels.float(), times, draws.to(channels.device))
        return self.denoiser(xt, times, edge_fraction)
