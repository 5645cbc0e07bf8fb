"""Random proportions, and the two types that families of solids are made of."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Solid = Callable[[Array], Array]
Family = Callable[[np.random.Generator], Solid]


def log_uniform(rng: np.random.Generator, low: float, high: float, count: int | None = None) -> Any:
    """Log-uniform draws on [low, high], ``low > 0``; a float, or ``(count,)``.

    Example:
        >>> 0.1 <= log_uniform(np.random.default_rng(0), 0.1, 1.0) <= 1.0
        True
    """
    draws = np.exp(rng.uniform(np.log(low), np.log(high), size=count))
    return float(draws) if count is None else draws


def log_whole(rng: np.random.Generator, low: int, high: int) -> int:
    """A whole number in [low, high], ``low >= 1``, as probable as its share of a log-uniform draw.

    Example:
        >>> 1 <= log_whole(np.random.default_rng(0), 1, 8) <= 8
        True
    """
    return min(int(log_uniform(rng, low, high + 1)), high)
