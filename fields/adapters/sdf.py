"""Signed distances as densities: VolSDF's Laplace density and the logistic one of NeuS, seen head-on."""

from __future__ import annotations

from collections.abc import Callable

from ...core.arrays import Array, namespace
from ...core.errors import InvalidArgument

DensityFn = Callable[[Array], Array]


def laplace_density(distance: Array, *, beta: float, alpha: float | None = None) -> Array:
    r"""VolSDF (Yariv et al. 2021, eq. 2 and 3): ``alpha * Psi_beta(-distance)``, the Laplace distribution function.

    ``alpha / 2 * exp(-d / beta)`` outside and ``alpha * (1 - exp(d / beta) / 2)`` inside: ``alpha`` deep inside,
    half of it on the surface. Smooth of order one; the gradient flows to the distance.

    Args:
        distance: ``(...)`` array or tensor, scene units, negative inside.
        beta: width of the soft surface, scene units, > 0.
        alpha: density deep inside, per scene unit, > 0; None for ``1 / beta``, as in the paper.

    Returns:
        ``(...)`` of the same kind, in [0, alpha]; NaN where the distance is.

    Example:
        >>> import numpy as np
        >>> laplace_density(np.array([0.0, -100.0]), beta=0.1)
        array([ 5., 10.])
    """
    _positive("laplace_density", beta=beta, alpha=alpha)
    xp = namespace(distance)
    outside = 0.5 * xp.exp(-xp.clip(distance, 0.0, None) / beta)  # neither half can overflow
    inside = 1.0 - 0.5 * xp.exp(xp.clip(distance, None, 0.0) / beta)
    return xp.where(distance > 0, outside, inside) * (1.0 / beta if alpha is None else alpha)


def logistic_density(distance: Array, *, sharpness: float) -> Array:
    r"""NeuS (Wang et al. 2021, eq. 10), for a ray that meets the surface head-on: ``s / (1 + exp(s * distance))``.

    NeuS' own density is this times the cosine between ray and normal, and zero on the way out. A density field
    knows no ray, so it is the upper bound over all of them: a surface never gets thinner than NeuS draws it.

    Args:
        distance: ``(...)`` array or tensor, scene units, negative inside.
        sharpness: NeuS' ``s`` (the inverse of its trained deviation), per scene unit, > 0.

    Returns:
        ``(...)`` of the same kind, in [0, sharpness].

    Example:
        >>> import numpy as np
        >>> logistic_density(np.array([-1.0, 0.0, 1.0]), sharpness=4.0).round(3).tolist()
        [3.928, 2.0, 0.072]
    """
    _positive("logistic_density", sharpness=sharpness)
    xp = namespace(distance)
    outside = xp.exp(-xp.clip(distance, 0.0, None) * sharpness)
    inside = xp.exp(xp.clip(distance, None, 0.0) * sharpness)
    return xp.where(distance > 0, outside / (1.0 + outside), 1.0 / (1.0 + inside)) * sharpness


def sdf_density_fn(
    sdf: Callable[[Array], Array],
    *,
    beta: float | None = None,
    alpha: float | None = None,
    sharpness: float | None = None,
) -> DensityFn:
    """The density field of a signed distance: Laplace with ``beta`` (and ``alpha``), or logistic with ``sharpness``.

    Args:
        sdf: ``positions (..., 3) -> distance (...) or (..., 1)``, scene units, negative inside; numpy or torch.

    Returns:
        ``positions (..., 3) -> density``, of the shape and kind that ``sdf`` returns.

    Raises:
        ValueError: not exactly one of ``beta`` and ``sharpness``, or one that is not finite and > 0.

    Example:
        >>> import numpy as np
        >>> ball = sdf_density_fn(lambda p: np.linalg.norm(p, axis=-1) - 1.0, beta=0.02)
        >>> ball(np.array([[1.0, 0.0, 0.0]]))
        array([25.])
    """
    if (beta is None) == (sharpness is None):
        raise InvalidArgument(
            f"sdf_density_fn: pass either beta or sharpness, got beta={beta!r}, sharpness={sharpness!r}"
        )
    if sharpness is not None and alpha is not None:
        raise InvalidArgument(f"sdf_density_fn: alpha belongs to beta, got alpha={alpha!r} with sharpness")
    _positive("sdf_density_fn", beta=beta, alpha=alpha, sharpness=sharpness)

    def density_fn(positions: Array) -> Array:
        distance = sdf(positions)
        if beta is not None:
            return laplace_density(distance, beta=beta, alpha=alpha)
        assert sharpness is not None
        return logistic_density(distance, sharpness=sharpness)

    return density_fn


def _positive(caller: str, **values: float | None) -> None:
    for name, value in values.items():
        if value is not None and not 0.0 < value < float("inf"):
            raise InvalidArgument(f"{caller}: {name} must be finite and > 0, got {value}")
