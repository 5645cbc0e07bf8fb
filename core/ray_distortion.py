"""mip-NeRF 360's distortion of a ray's weights, for arrays and tensors alike."""

from __future__ import annotations

from .arrays import Array
from .errors import InvalidArgument


def distortion(weights: Array, edges: Array) -> Array:
    r"""How far along a ray its weights are spread (mip-NeRF 360, eq. 15), in O(samples).

    .. math:: \sum_{i,j} w_i w_j |m_i - m_j| + \tfrac13 \sum_i w_i^2 (s_{i+1} - s_i)

    Args:
        weights: ``(..., S)``, array or tensor: each sample's share of the ray's light.
        edges: ``(..., S + 1)``, ascending: where the samples begin and end; ``m`` are their middles. The paper
            squashes distances to [0, 1] first.

    Returns:
        ``(...)``, as given; differentiable where tensors are.

    Raises:
        ValueError: shapes that do not fit.
    """
    wanted = (*weights.shape[:-1], weights.shape[-1] + 1)
    if tuple(edges.shape) != wanted:
        raise InvalidArgument(f"distortion: edges must have shape {wanted}, got {tuple(edges.shape)}")
    width = edges[..., 1:] - edges[..., :-1]
    middle = edges[..., :-1] + width / 2
    before = weights.cumsum(-1) - weights
    moment = (weights * middle).cumsum(-1) - weights * middle
    return (2.0 * weights * (middle * before - moment)).sum(-1) + (weights**2 * width).sum(-1) / 3.0
