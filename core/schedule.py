"""Time: integer timesteps in [0, 1000), the paper's noise schedule, and severities mapped onto it.

One table serves both kinds of diffusion. With ``a = alphas_cumprod()[t]``:

    Gaussian    x_t = sqrt(a) x_0 + sqrt(1 - a) noise
    Bernoulli   x_t = x_0 with its sign flipped with probability (1 - a) / 2, so that E[x_t | x_0] = a x_0
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import InvalidArgument, InvalidType

TIMESTEPS = 1000
BETA_START, BETA_END = 0.0015, 0.05  # linear, as in the published configuration


def betas() -> NDArray[np.float64]:
    """``(1000,)`` linear noise variances."""
    return np.asarray(np.linspace(BETA_START, BETA_END, TIMESTEPS), dtype=np.float64)


def alphas_cumprod() -> NDArray[np.float64]:
    """``(1000,)`` the paper's alpha-bar."""
    return np.asarray(np.cumprod(1.0 - betas()), dtype=np.float64)


def flip_probabilities() -> NDArray[np.float64]:
    """``(1000,)`` share of voxels whose sign differs from x0: ``(1 - alphas_cumprod) / 2``, from 0.00075 to 0.5.

    Each step replaces a share ``beta`` of the voxels by fair coins (Sohl-Dickstein et al. 2015, Bernoulli diffusion).
    """
    return np.asarray((1.0 - alphas_cumprod()) / 2.0, dtype=np.float64)


def flip_log_odds() -> NDArray[np.float64]:
    """``(1000,)`` how much one bit says about its x0: ``log((1 - f) / f)``, from 7.2 down to 8e-12, never negative."""
    kept = alphas_cumprod()
    return np.asarray(np.log1p(kept) - np.log1p(-kept), dtype=np.float64)


def strided_timesteps(count: int) -> NDArray[np.int64]:
    """``count`` timesteps from 999 down to 0, evenly spread, both ends among them (999 alone for a count of 1).

    Raises:
        ValueError: ``count`` outside [1, 1000].
    """
    if not 1 <= count <= TIMESTEPS:
        raise InvalidArgument(f"strided_timesteps: count must lie in [1, {TIMESTEPS}], got {count}")
    steps: NDArray[np.int64] = np.rint(np.linspace(TIMESTEPS - 1, 0, count)).astype(np.int64)
    return steps


def timestep_from_severity(severity: ArrayLike) -> NDArray[np.int64]:
    """Severity in [0, 1] to a timestep in [0, 999], rounded to the nearest."""
    value = np.asarray(severity, dtype=np.float64)
    if not ((value >= 0) & (value <= 1)).all():
        raise InvalidArgument(
            f"timestep_from_severity: severity must lie in [0, 1], got {value.min()} .. {value.max()}"
        )
    steps: NDArray[np.int64] = np.rint(value * (TIMESTEPS - 1)).astype(np.int64)
    return steps


def check_timestep(timestep: ArrayLike, *, caller: str) -> NDArray[np.int64]:
    """Integer timesteps in [0, 1000), any shape, as int64."""
    value = np.asarray(timestep)
    if value.dtype.kind not in "iu":
        raise InvalidType(f"{caller}: timestep must be an integer, got dtype {value.dtype}")
    if value.size and (value.min() < 0 or value.max() >= TIMESTEPS):
        raise InvalidArgument(f"{caller}: timestep must lie in [0, {TIMESTEPS}), got {value.min()} .. {value.max()}")
    return value.astype(np.int64)
