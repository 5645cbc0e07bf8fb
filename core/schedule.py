"""Time: integer timesteps in [0, 1000), the paper's noise schedule, and severities mapped onto it."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

TIMESTEPS = 1000
BETA_START, BETA_END = 0.0015, 0.05  # linear, as in the published configuration


def betas() -> NDArray[np.float64]:
    """``(1000,)`` linear noise variances."""
    return np.asarray(np.linspace(BETA_START, BETA_END, TIMESTEPS), dtype=np.float64)


def alphas_cumprod() -> NDArray[np.float64]:
    """``(1000,)`` the paper's alpha-bar."""
    return np.asarray(np.cumprod(1.0 - betas()), dtype=np.float64)


def timestep_from_severity(severity: ArrayLike) -> NDArray[np.int64]:
    """Severity in [0, 1] to a timestep in [0, 999], rounded to the nearest."""
    value = np.asarray(severity, dtype=np.float64)
    if not ((value >= 0) & (value <= 1)).all():
        raise ValueError(f"timestep_from_severity: severity must lie in [0, 1], got {value.min()} .. {value.max()}")
    steps: NDArray[np.int64] = np.rint(value * (TIMESTEPS - 1)).astype(np.int64)
    return steps


def check_timestep(timestep: ArrayLike, *, caller: str) -> NDArray[np.int64]:
    """Integer timesteps in [0, 1000), any shape, as int64."""
    value = np.asarray(timestep)
    if value.dtype.kind not in "iu":
        raise TypeError(f"{caller}: timestep must be an integer, got dtype {value.dtype}")
    if value.size and (value.min() < 0 or value.max() >= TIMESTEPS):
        raise ValueError(f"{caller}: timestep must lie in [0, {TIMESTEPS}), got {value.min()} .. {value.max()}")
    return value.astype(np.int64)
