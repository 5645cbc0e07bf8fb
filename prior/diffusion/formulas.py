"""Diffusion as formulas, on tensors: noising, its exact posteriors, and x0 from what a network predicts.

Cubes are ``(N, ...)``, timesteps ``(N,)`` int64 in [0, 1000); ``previous`` may also be -1, which stands for x0 itself.
With ``a = alphas_cumprod[t]``, ``s = previous``:

    Gaussian    q(x_t | x_0) = N(sqrt(a_t) x_0, (1 - a_t) I)              Ho et al. 2020, eq. 4; the paper's eq. 1
    Bernoulli   q(x_t = x_0) = (1 + a_t) / 2, x in {-1, +1}               Sohl-Dickstein et al. 2015, table 1

Posteriors are of any earlier time ``s < t`` given ``x_t`` and ``x_0``, which is what a strided sampler needs;
``s = t - 1`` gives the published ones. Tables are float64, their rows are cast to the cube's dtype last.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...core.errors import InvalidArgument, InvalidType
from ...core.occupancy import EMPTY, OCCUPIED, SURFACE_LABEL, signed_from_occupancy
from ...core.schedule import alphas_cumprod

_KEPT: NDArray[np.float64] = np.append(alphas_cumprod(), 1.0)  # index -1 is "no noise"


def kept_share(timestep: Tensor, like: Tensor) -> Tensor:
    """``alphas_cumprod[timestep]`` in float64, shaped to broadcast over ``like (N, ...)``; 1 at timestep -1.

    Raises:
        TypeError: timesteps that are not integers.
        ValueError: timesteps outside [-1, 1000), or not one for each cube.

    Example:
        >>> kept_share(torch.tensor([-1, 999]), torch.zeros(2, 3)).flatten().round(decimals=4).tolist()
        [1.0, 0.0]
    """
    if timestep.is_floating_point() or timestep.dtype == torch.bool:
        raise InvalidType(f"kept_share: timestep must be an integer, got dtype {timestep.dtype}")
    if tuple(timestep.shape) != (len(like),):
        raise InvalidArgument(f"kept_share: timestep must have shape ({len(like)},), got {tuple(timestep.shape)}")
    if timestep.numel() and not (int(timestep.min()) >= -1 and int(timestep.max()) < len(_KEPT) - 1):
        raise InvalidArgument(f"kept_share: timestep must lie in [-1, 1000), got {timestep.min()} .. {timestep.max()}")
    table = torch.from_numpy(_KEPT)
    rows = table[timestep.cpu().long()].to(like.device)
    return rows.view(-1, *([1] * (like.ndim - 1)))


def q_sample(x0: Tensor, timestep: Tensor, noise: Tensor) -> Tensor:
    """``x_t`` of the Gaussian diffusion: ``sqrt(a) x0 + sqrt(1 - a) noise`` (inside eq. 1 of the paper).

    Args:
        x0: ``(N, ...)``, signed occupancy in the prior's use.
        timestep: ``(N,)`` in [0, 1000).
        noise: standard normal, of x0's shape.

    Example:
        >>> x0, noise = torch.ones(1, 4), torch.zeros(1, 4)
        >>> [round(float(q_sample(x0, torch.tensor([t]), noise)[0, 0]), 3) for t in (0, 50, 999)]
        [0.999, 0.933, 0.0]
    """
    _same_shape("q_sample", x0=x0, noise=noise)
    kept = kept_share(timestep, x0)
    return kept.sqrt().to(x0.dtype) * x0 + (1.0 - kept).sqrt().to(x0.dtype) * noise


def q_flip(x0: Tensor, timestep: Tensor, uniform: Tensor) -> Tensor:
    """``x_t`` of the Bernoulli diffusion: +1 where ``uniform < (1 + a x0) / 2``, else -1.

    A soft ``x0`` in [-1, 1] counts as a bit that is +1 with probability ``(1 + x0) / 2``.

    Args:
        x0: ``(N, ...)`` in [-1, 1].
        timestep: ``(N,)`` in [0, 1000).
        uniform: uniform in [0, 1), of x0's shape.

    Example:
        >>> x0, uniform = torch.ones(1, 4), torch.tensor([[0.0, 0.4, 0.6, 0.999]])
        >>> q_flip(x0, torch.tensor([999]), uniform).tolist()
        [[1.0, 1.0, -1.0, -1.0]]
    """
    _same_shape("q_flip", x0=x0, uniform=uniform)
    chance = (1.0 + kept_share(timestep, x0).to(x0.dtype) * x0) / 2.0
    xt: Tensor = signed_from_occupancy(uniform < chance).to(x0.dtype)
    return xt


def x0_from_epsilon(xt: Tensor, timestep: Tensor, epsilon: Tensor, *, clamp: bool = True) -> Tensor:
    """``(xt - sqrt(1 - a) epsilon) / sqrt(a)``, clamped to [-1, 1], where occupancy lives, unless told not to.

    The quotient magnifies an error of ``epsilon`` by ``sqrt((1 - a) / a)``: 0.04 at t = 0, 0.4 at 50, 31 at 500, 5e5 at
    999. So at the last timesteps an unclamped value means nothing and the clamped one is little more than a sign.

    Example:
        >>> x0, noise, timestep = torch.tensor([[1.0, -1.0]]), torch.tensor([[0.3, -2.0]]), torch.tensor([50])
        >>> x0_from_epsilon(q_sample(x0, timestep, noise), timestep, noise).round(decimals=5).tolist()
        [[1.0, -1.0]]
    """
    _same_shape("x0_from_epsilon", xt=xt, epsilon=epsilon)
    kept = kept_share(timestep, xt)
    x0 = (xt - (1.0 - kept).sqrt().to(xt.dtype) * epsilon) / kept.sqrt().to(xt.dtype)
    return x0.clamp(EMPTY, OCCUPIED) if clamp else x0


def epsilon_from_x0(xt: Tensor, timestep: Tensor, x0: Tensor) -> Tensor:
    """The noise that leads from ``x0`` to ``xt``: ``(xt - sqrt(a) x0) / sqrt(1 - a)``; inverse of x0_from_epsilon.

    Example:
        >>> x0, noise, timestep = torch.tensor([[1.0, -1.0]]), torch.tensor([[0.5, -2.0]]), torch.tensor([50])
        >>> epsilon_from_x0(q_sample(x0, timestep, noise), timestep, x0).round(decimals=4).tolist()
        [[0.5, -2.0]]
    """
    _same_shape("epsilon_from_x0", xt=xt, x0=x0)
    kept = kept_share(timestep, xt)
    return (xt - kept.sqrt().to(xt.dtype) * x0) / (1.0 - kept).sqrt().to(xt.dtype)


def _check_order(previous: Tensor, timestep: Tensor, caller: str) -> None:
    if bool((previous >= timestep).any()) or bool((timestep < 0).any()):
        raise InvalidArgument(f"{caller}: previous must be < timestep, which must be >= 0")


def bernoulli_posterior(xt: Tensor, x0_pred: Tensor, timestep: Tensor, previous: Tensor) -> Tensor:
    """``P(x_s = +1 | x_t)``, ``s = previous < t``, for bits whose x0 is +1 with probability ``(1 + x0_pred) / 2``.

    ``sum over x0 of P(x0 | x_t) q(x_s | x_t, x0)`` with ``q(x_s | x_t, x0)`` proportional to
    ``q(x_t | x_s) q(x_s | x0)``; exact for each voxel, not an approximation by the mean.

    Args:
        xt: ``(N, ...)`` of -1 and +1.
        x0_pred: the posterior mean ``E[x0 | x_t]`` in [-1, 1], of xt's shape.
        timestep: ``(N,)`` in [0, 1000).
        previous: ``(N,)`` in [-1, timestep); at -1 the result is ``(1 + x0_pred) / 2``.

    Example:
        >>> xt, x0_pred = torch.tensor([[1.0, -1.0]]), torch.tensor([[0.5, 0.5]])
        >>> bernoulli_posterior(xt, x0_pred, torch.tensor([10]), torch.tensor([-1])).tolist()
        [[0.75, 0.75]]
    """
    _same_shape("bernoulli_posterior", xt=xt, x0_pred=x0_pred)
    _check_order(previous, timestep, "bernoulli_posterior")
    late, early = kept_share(timestep, xt), kept_share(previous, xt)
    # q(x_s = +1 | x_t, x_0) = (1 + m)(1 + k) / ((1 + m)(1 + k) + (1 - m)(1 - k)), m = between x_t, k = early x_0
    m, occupied = late / early * xt.double(), (1.0 + x0_pred.double()) / 2.0
    chance = torch.zeros_like(m)
    for bit, share in ((OCCUPIED, occupied), (EMPTY, 1.0 - occupied)):
        k = early * bit
        above, below = (1.0 + m) * (1.0 + k), (1.0 - m) * (1.0 - k)
        chance = chance + share * above / (above + below)
    return chance.to(xt.dtype)


def clean_cubes(labels: Tensor) -> Tensor:
    """x0 of a labelled cube: ``(N, R, R, R)`` labels to signed occupancy ``(N, 1, R, R, R)``.

    Surface is +1; free voxels and those labelled "ignore" are -1: a generative model has to say something of each
    voxel, and what nobody could see is not counted as surface. The corruption in the pair plays no part.

    Example:
        >>> labels = torch.tensor([0, 1, 2, 0, 0, 0, 0, 1], dtype=torch.uint8).view(1, 2, 2, 2)  # free, surface, ignore
        >>> clean_cubes(labels).flatten().tolist()
        [-1.0, 1.0, -1.0, -1.0, -1.0, -1.0, -1.0, 1.0]
    """
    x0: Tensor = signed_from_occupancy(labels == SURFACE_LABEL)[:, None]
    return x0


def _same_shape(caller: str, **tensors: Tensor) -> None:
    (first, one), (second, other) = tensors.items()
    if one.shape != other.shape:
        raise InvalidArgument(
            f"{caller}: {second} must have the shape of {first} {tuple(one.shape)}, got {tuple(other.shape)}"
        )
