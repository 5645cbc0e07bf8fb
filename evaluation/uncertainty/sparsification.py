"""Does an uncertainty rank errors? Sparsification curves and the area between them (AUSE).

Ilg et al. 2018: drop the most uncertain pixels bit by bit and watch the error of the rest fall; then drop the
worst pixels instead (the oracle). The area between the two curves is 0 for an uncertainty that ranks as the error does.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.errors import InvalidArgument

FloatArray = NDArray[np.float64]
REDUCTIONS = ("mae", "rmse", "mse")
NORMALIZATIONS = ("whole", "largest")


@dataclass(frozen=True, eq=False)
class Sparsification:
    """What :func:`sparsify` found.

    Attributes:
        removed: ``(steps,)`` share of pixels removed: 0, 1 / steps, … .
        by_uncertainty, by_error, at_random: ``(steps,)`` normalised error of the rest under the three orders;
            ``at_random`` is constant: its expectation.
        ause: area between ``by_uncertainty`` and ``by_error``, by trapezoids over ``removed``; 0 is a perfect ranking.
        ause_random: the same of ``at_random``: what an uncertainty that knows nothing gets.
        pixels: that took part.
    """

    removed: FloatArray
    by_uncertainty: FloatArray
    by_error: FloatArray
    at_random: FloatArray
    ause: float
    ause_random: float
    pixels: int


def sparsify(
    error: NDArray[Any],
    uncertainty: NDArray[Any],
    mask: NDArray[np.bool_] | None = None,
    *,
    reduction: str = "mae",
    steps: int = 100,
    normalization: str = "whole",
) -> Sparsification:
    """Sparsification curves of an error under an uncertainty.

    Pixels of equal uncertainty are dropped in random order *in expectation*: each counts with the mean error of
    its equals, so that the result does not depend on the order of pixels, and a constant uncertainty is exactly
    ``at_random``. After removing the share ``r`` of ``n`` pixels, ``floor((1 - r) n)``, but at least one, are left.

    Args:
        error: absolute errors (depth, say), any shape, >= 0, finite where the mask is True.
        uncertainty: the same shape, larger is less sure; infinite is allowed, NaN is not.
        mask: bool, the same shape; None: everything.
        reduction: ``mae``, ``rmse`` or ``mse`` of what is left.
        steps: >= 2.
        normalization: divide by the error of the ``whole`` (every curve starts at 1), or, as Bayes' Rays' published
            code does, by the ``largest`` value of the two curves: differs where removing the uncertain first makes
            the rest worse.

    Raises:
        ValueError: shapes, an unknown name, no pixel, errors that are negative or not finite, a NaN uncertainty.
    """
    for name, value, choices in (
        ("reduction", reduction, REDUCTIONS),
        ("normalization", normalization, NORMALIZATIONS),
    ):
        if value not in choices:
            raise InvalidArgument(f"sparsify: {name} must be one of {', '.join(choices)}, got {value!r}")
    if steps < 2:
        raise InvalidArgument(f"sparsify: steps must be >= 2, got {steps}")
    errors, doubts = _chosen(error, uncertainty, mask)
    powered = errors if reduction == "mae" else errors**2
    left = np.maximum(((1 - np.arange(steps) / steps) * len(errors) + 1e-9).astype(np.int64), 1)
    curves = [_curve(powered, order, left) for order in (doubts, powered)]
    curves.append(np.full(steps, powered.mean()))
    if reduction == "rmse":
        curves = [np.sqrt(curve) for curve in curves]
    whole = max(curves[0].max(), curves[1].max()) if normalization == "largest" else curves[2][0]
    curves = [curve / whole if whole > 0 else np.zeros(steps) for curve in curves]
    removed = np.arange(steps) / steps
    areas = [
        float(((c[1:] + c[:-1]) / 2 * np.diff(removed)).sum()) for c in (curves[0] - curves[1], curves[2] - curves[1])
    ]
    return Sparsification(removed, curves[0], curves[1], curves[2], areas[0], areas[1], len(errors))


def ause(
    error: NDArray[Any], uncertainty: NDArray[Any], mask: NDArray[np.bool_] | None = None, **settings: Any
) -> float:
    """Area under the sparsification error curve: :func:`sparsify`'s ``ause``; 0 is a perfect ranking."""
    return sparsify(error, uncertainty, mask, **settings).ause


def _chosen(
    error: NDArray[Any], uncertainty: NDArray[Any], mask: NDArray[np.bool_] | None
) -> tuple[FloatArray, FloatArray]:
    if error.shape != uncertainty.shape:
        raise InvalidArgument(
            f"sparsify: uncertainty must have the shape of error {error.shape}, got {uncertainty.shape}"
        )
    chosen = np.ones(error.shape, dtype=np.bool_) if mask is None else mask
    if chosen.dtype != np.bool_ or chosen.shape != error.shape:
        raise InvalidArgument(f"sparsify: mask must be bool of shape {error.shape}, got {chosen.dtype} {chosen.shape}")
    if not chosen.any():
        raise InvalidArgument("sparsify: the mask must hold at least one pixel")
    errors, doubts = error[chosen].astype(np.float64), uncertainty[chosen].astype(np.float64)
    bad = int((~(np.isfinite(errors) & (errors >= 0))).sum())
    if bad:
        raise InvalidArgument(f"sparsify: error must be finite and >= 0, {bad} unmasked values are not")
    if np.isnan(doubts).any():
        raise InvalidArgument(f"sparsify: {int(np.isnan(doubts).sum())} unmasked uncertainties are NaN")
    return errors, doubts


def _curve(powered: FloatArray, order: FloatArray, left: NDArray[np.int64]) -> FloatArray:
    """Mean of the ``left`` first pixels in rising ``order``, equals counting as the mean of their kind."""
    values, group, counts = np.unique(order, return_inverse=True, return_counts=True)
    means = np.bincount(group.ravel(), weights=powered, minlength=len(values)) / counts
    summed = np.concatenate([[0.0], np.cumsum(np.repeat(means, counts))])
    return np.asarray(summed[left] / left, dtype=np.float64)
