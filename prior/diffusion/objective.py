"""A diffusion's share in training: the draws of each sample, and its loss."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...core.frames import RESOLUTION
from ...core.schedule import TIMESTEPS
from .formulas import clean_cubes
from .model import DiffusionNet

DRAWS_STREAM = 1  # apart from the stream that chooses the cubes


def training_draws(index: NDArray[np.int64], *, seed: int, device: torch.device | str) -> tuple[Tensor, Tensor]:
    """Timesteps ``(N,)``, uniform in [0, 1000), and standard normals ``(N, 1, 32, 32, 32)``.

    Sample i's depend on (seed, i) alone, whatever the batch, and (the normals) on the kind of device, whose generator
    draws them.

    Example:
        >>> times, normals = training_draws(np.array([3, 7]), seed=0, device="cpu")
        >>> again, _ = training_draws(np.array([7]), seed=0, device="cpu")
        >>> normals.shape, bool(times[1] == again[0])
        (torch.Size([2, 1, 32, 32, 32]), True)
    """
    times, normals = np.empty(len(index), np.int64), []
    shape = (1, *(RESOLUTION,) * 3)
    generator = torch.Generator(device)
    for row, sample in enumerate(index):
        rng = np.random.default_rng([seed, int(sample), DRAWS_STREAM])
        times[row] = rng.integers(TIMESTEPS)
        generator.manual_seed(int(rng.integers(2**63)))
        normals.append(torch.randn(shape, generator=generator, device=device))
    return torch.from_numpy(times).to(device), torch.stack(normals) if normals else torch.empty(0, *shape)


def diffusion_losses(
    network: DiffusionNet, labels: Tensor, edge_fraction: Tensor, *, index: NDArray[np.int64], seed: int
) -> Tensor:
    """The objective's loss on clean cubes ``(N,)``.

    Args:
        network: to train.
        labels: ``(N, 32, 32, 32)`` uint8; see :func:`unghost.prior.diffusion.formulas.clean_cubes`.
        edge_fraction: ``(N,)`` > 0.
        index: ``(N,)`` numbers of the samples.
        seed: of the run.

    Example:
        >>> from unghost.prior.diffusion.model import DiffusionConfig
        >>> from unghost.prior.networks.restoration import SIZES
        >>> network = DiffusionNet(DiffusionConfig("x0", SIZES["xs"]))
        >>> labels = torch.zeros(1, 32, 32, 32, dtype=torch.uint8)
        >>> losses = diffusion_losses(network, labels, torch.tensor([0.1]), index=np.array([0]), seed=0)
        >>> len(losses), bool(losses.isfinite().all())
        (1, True)
    """
    times, draws = training_draws(index, seed=seed, device=labels.device)
    return network.loss(clean_cubes(labels), times, edge_fraction, draws)
