"""Unconditional samples: from pure noise back to x0 along a ladder of timesteps, with any denoiser.

A denoiser here is ``(xt (N, ...), timestep (N,), edge_fraction (N,)) -> E[x0 | xt] (N, ...)``; what is drawn between
two rungs is exact given that mean for bits, and to first order in the rung for Gaussian noise, as always in DDPM.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from ...core.errors import InvalidArgument
from ...core.frames import RESOLUTION
from ...core.occupancy import signed_from_occupancy
from ...core.schedule import TIMESTEPS, strided_timesteps
from .formulas import bernoulli_posterior, epsilon_from_x0, kept_share
from .model import DiffusionNet

Denoise = Callable[[Tensor, Tensor, Tensor], Tensor]


def _rungs(steps: int) -> Iterator[tuple[int, int]]:
    """Pairs (timestep, the one after it); the last leads to -1, x0 itself."""
    return pairwise([*strided_timesteps(steps).tolist(), -1])


def _at(step: int, like: Tensor) -> Tensor:
    return torch.full((len(like),), step, dtype=torch.int64, device=like.device)


@torch.no_grad()
def sample_gaussian(
    denoise: Denoise,
    shape: tuple[int, ...],
    edge_fraction: Tensor,
    *,
    generators: Sequence[torch.Generator],
    steps: int = 1000,
    eta: float = 1.0,
    on_step: Callable[[int, Tensor], None] | None = None,
) -> Tensor:
    """DDIM (Song et al. 2021, eq. 12 and 16): ``eta`` 1 is ancestral, at 1000 steps DDPM itself; 0 is deterministic.

    ``x_s = sqrt(a_s) x0 + sqrt(1 - a_s - v) epsilon + sqrt(v) z`` with ``v = eta^2`` times the variance of
    ``q(x_s | x_t, x_0)``; ``epsilon`` is computed from ``x0``, so that a clamped x0 does not leave its xt.
    Fewer steps lose variance: the spread of x0 given xt is not drawn, only its mean is followed.

    Args:
        denoise: the posterior mean of x0, clamped or not.
        shape: of the samples, ``(N, ...)``.
        edge_fraction: ``(N,)`` > 0, handed to ``denoise``; its device is where all happens.
        generators: one for each sample, of that device; the start first, then one draw a step where ``eta > 0``.
        steps: denoiser calls, 1 to 1000, evenly spread over the timesteps.
        eta: in [0, 1].
        on_step: called with the timestep and x0's mean after each call of ``denoise``.

    Returns:
        ``x0`` of that shape, float32: the last mean.

    Example:
        >>> def denoise(xt, timestep, edge_fraction):
        ...     return torch.ones_like(xt)  # certain of what x0 is
        >>> generators = [torch.Generator().manual_seed(0)]
        >>> sample_gaussian(denoise, (1, 4), torch.tensor([0.1]), generators=generators, steps=5).tolist()
        [[1.0, 1.0, 1.0, 1.0]]
    """
    _check_batch("sample_gaussian", shape, edge_fraction, generators)
    if not 0.0 <= eta <= 1.0:
        raise InvalidArgument(f"sample_gaussian: eta must lie in [0, 1], got {eta}")
    xt = x0 = _drawn(torch.randn, shape, generators)
    for step, following in _rungs(steps):
        time, previous = _at(step, xt), _at(following, xt)
        x0 = denoise(xt, time, edge_fraction)
        if on_step is not None:
            on_step(step, x0)
        if following < 0:
            break
        late, early = kept_share(time, xt), kept_share(previous, xt)
        variance = eta**2 * (1.0 - late / early) * (1.0 - early) / (1.0 - late)
        epsilon = epsilon_from_x0(xt, time, x0)
        xt = early.sqrt().float() * x0 + (1.0 - early - variance).sqrt().float() * epsilon
        if eta > 0.0:
            xt = xt + variance.sqrt().float() * _drawn(torch.randn, shape, generators)
    return x0


@torch.no_grad()
def sample_bernoulli(
    denoise: Denoise,
    shape: tuple[int, ...],
    edge_fraction: Tensor,
    *,
    generators: Sequence[torch.Generator],
    steps: int = 1000,
    on_step: Callable[[int, Tensor], None] | None = None,
) -> Tensor:
    """Ancestral samples of bits: ``x_s ~ P(x_s | x_t)`` of each voxel, x0's chance being ``(1 + denoise) / 2``.

    Exact for each voxel at any stride; voxels of one rung are drawn independently given xt, so few steps lose their
    agreement (at 1000 hardly any).

    Args:
        denoise: the posterior mean of x0 in [-1, 1].
        shape: of the samples, ``(N, ...)``.
        edge_fraction: ``(N,)`` > 0; its device is where all happens.
        generators: one for each sample, of that device; the start first, then one draw a step.
        steps: denoiser calls, 1 to 1000.
        on_step: called with the timestep and x0's mean after each call of ``denoise``.

    Returns:
        ``x0`` of that shape, float32, each voxel -1 or +1, drawn from the last mean.

    Example:
        >>> def denoise(xt, timestep, edge_fraction):
        ...     return torch.ones_like(xt)  # certain of what x0 is
        >>> generators = [torch.Generator().manual_seed(0)]
        >>> sample_bernoulli(denoise, (1, 4), torch.tensor([0.1]), generators=generators, steps=5).tolist()
        [[1.0, 1.0, 1.0, 1.0]]
    """
    _check_batch("sample_bernoulli", shape, edge_fraction, generators)

    def bits(chance: Tensor) -> Tensor:
        drawn: Tensor = signed_from_occupancy(_drawn(torch.rand, shape, generators) < chance)
        return drawn

    xt = bits(torch.full((), 0.5, device=edge_fraction.device))
    for step, following in _rungs(steps):
        time, previous = _at(step, xt), _at(following, xt)
        x0 = denoise(xt, time, edge_fraction)
        if on_step is not None:
            on_step(step, x0)
        xt = bits(bernoulli_posterior(xt, x0, time, previous))
    return xt


def sample_cubes(
    network: DiffusionNet,
    *,
    count: int,
    edge_fraction: float,
    seed: int,
    steps: int = 100,
    eta: float = 1.0,
    batch_size: int = 16,
    on_step: Callable[[int, Tensor], None] | None = None,
) -> Tensor:
    """Cubes from a trained diffusion, by the sampler of its objective.

    Args:
        network: in evaluation mode; its device is where all happens.
        count: cubes.
        edge_fraction: > 0, the same for all.
        seed: cube i depends on (seed, i) alone, but for rounding.
        steps: denoiser calls a cube, 1 to 1000.
        eta: of :func:`sample_gaussian`; the Bernoulli sampler has none and takes 1 alone.
        batch_size: cubes at a time.
        on_step: called with the timestep and the mean of x0 after each call of the network.

    Returns:
        ``(count, 1, 32, 32, 32)`` float32 on the CPU: x0 in [-1, 1], occupied above 0; bits for Bernoulli.

    Raises:
        ValueError: a count or a batch below 1, steps outside [1, 1000], an edge fraction that is not > 0, ``eta`` with
            Bernoulli.

    Example:
        >>> from unghost.prior.diffusion.model import DiffusionConfig
        >>> from unghost.prior.networks.restoration import SIZES
        >>> network = DiffusionNet(DiffusionConfig("x0", SIZES["xs"])).eval()
        >>> sample_cubes(network, count=1, edge_fraction=0.1, seed=0, steps=2).shape
        torch.Size([1, 1, 32, 32, 32])
    """
    if count < 1 or batch_size < 1:
        raise InvalidArgument(f"sample_cubes: count and batch_size must be >= 1, got {count} and {batch_size}")
    if not 0.0 < edge_fraction < float("inf"):
        raise InvalidArgument(f"sample_cubes: edge_fraction must be finite and > 0, got {edge_fraction}")
    if not 1 <= steps <= TIMESTEPS:
        raise InvalidArgument(f"sample_cubes: steps must lie in [1, {TIMESTEPS}], got {steps}")
    flips = network.config.objective == "bernoulli"
    if flips and eta != 1.0:
        raise InvalidArgument(f"sample_cubes: eta must be 1 for objective 'bernoulli', got {eta}")
    device = next(network.parameters()).device
    parts = []
    for first in range(0, count, batch_size):
        shape = (min(batch_size, count - first), 1, *(RESOLUTION,) * 3)
        edges = torch.full(shape[:1], edge_fraction, device=device)
        seeds = [_seed(seed, index) for index in range(first, first + len(edges))]
        generators = [torch.Generator(device).manual_seed(value) for value in seeds]
        if flips:
            part = sample_bernoulli(network, shape, edges, generators=generators, steps=steps, on_step=on_step)
        else:
            part = sample_gaussian(network, shape, edges, generators=generators, steps=steps, eta=eta, on_step=on_step)
        parts.append(part.cpu())
    return torch.cat(parts)


def _seed(seed: int, index: int) -> int:
    return int(np.random.default_rng([seed, index]).integers(2**63))


def _drawn(draw: Callable[..., Tensor], shape: tuple[int, ...], generators: Sequence[torch.Generator]) -> Tensor:
    """``torch.randn`` or ``torch.rand`` of that shape, each sample by its own generator."""
    return torch.stack([draw(shape[1:], generator=generator, device=generator.device) for generator in generators])


def _check_batch(
    caller: str, shape: tuple[int, ...], edge_fraction: Tensor, generators: Sequence[torch.Generator]
) -> None:
    if not shape or shape[0] < 1:
        raise InvalidArgument(f"{caller}: shape must start with one sample or more, got {shape}")
    if tuple(edge_fraction.shape) != tuple(shape[:1]):
        raise InvalidArgument(
            f"{caller}: edge_fraction must have shape {tuple(shape[:1])}, got {tuple(edge_fraction.shape)}"
        )
    if len(generators) != shape[0]:
        raise InvalidArgument(f"{caller}: generators must be one for each of {shape[0]} samples, got {len(generators)}")
