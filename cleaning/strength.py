"""How strongly to clean, chosen by photos that the field was not trained on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ..core.errors import InvalidArgument
from .keep_mask import KeepMask
from .pipeline import Judgement

STRENGTHS = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8)


@dataclass(frozen=True)
class StrengthChoice:
    """A strength, its mask, and the error at every strength that was tried."""

    strength: float
    mask: KeepMask
    errors: dict[float, float]


def choose_strength(
    judgement: Judgement,
    error: Callable[[KeepMask], float],
    *,
    strengths: Sequence[float] = STRENGTHS,
    tolerance: float = 0.02,
) -> StrengthChoice:
    """The largest strength that held-out *training* views bear.

    Ghosts near the training cameras cost little there, so the error hardly falls with cleaning; but it rises as
    soon as surfaces go. Hence not the best strength: the largest one whose error is within ``tolerance`` of the best.

    Args:
        judgement: of :func:`unghost.cleaning.pipeline.judge`.
        error: what rendering the field cleaned by a mask gets wrong on photos from the training trajectory that
            were kept out of training: a mean squared error, say; >= 0, finite. Called once a strength.
        strengths: in [0, 1], at least one.
        tolerance: relative, >= 0.

    Raises:
        ValueError: no strengths, one outside [0, 1], an error that is negative or not finite.

    Example:
        >>> from unghost.baselines.filters import Classical
        >>> from unghost.cleaning.pipeline import judge
        >>> def density_fn(p):
        ...     return 50.0 * (abs(p[:, 2] + 0.5) < 0.15)
        >>> judgement = judge(density_fn, [[-1, -1, -1], [1, 1, 1]], denoiser=Classical("input"), resolution=16)
        >>> choice = choose_strength(judgement, lambda mask: 1.0 + mask.summary()["removed"])  # stands for renders
        >>> choice.strength
        0.8
    """
    tried = sorted(set(map(float, strengths)))
    if not tried or not all(0.0 <= strength <= 1.0 for strength in tried):
        raise InvalidArgument(
            f"choose_strength: strengths must be one or more numbers in [0, 1], got {list(strengths)}"
        )
    if not 0.0 <= tolerance < np.inf:
        raise InvalidArgument(f"choose_strength: tolerance must be finite and >= 0, got {tolerance}")
    errors: dict[float, float] = {}
    for strength in tried:
        found = float(error(judgement.mask(strength)))
        if not 0.0 <= found < np.inf:
            raise InvalidArgument(f"choose_strength: error must give finite numbers >= 0, got {found} at {strength:g}")
        errors[strength] = found
    allowed = min(errors.values()) * (1.0 + tolerance)
    best = max(strength for strength, found in errors.items() if found <= allowed)
    return StrengthChoice(best, judgement.mask(best), errors)
