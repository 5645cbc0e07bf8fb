"""Losses on sparse points that others add to the photometric loss: pure, unreduced, each after its source.

As in :mod:`.losses`, half precision is raised to float32, and to float64 where logarithms or sums of squares need it.
The lengths that the sources give in metres are arguments here.
"""

from __future__ import annotations

import math

from ..core.errors import InvalidArgument, MissingExtra

try:
    import torch
    from torch import Tensor
except ImportError as error:  # pragma: no cover - exercised in a subprocess
    raise MissingExtra("unghost.baselines.point_losses needs torch: pip install unghost[torch]") from error

from ..core.arrays import upcast, widest

LEAST_WEIGHT = 1e-5  # added to rendering weights before their logarithm
ENDING_FACTOR = 3.0  # how much an ending line counts against a passing one
KERNEL_DEVIATIONS = 3.0  # standard deviations of the kernel in its half width


def ds_nerf_loss(weights: Tensor, edges: Tensor, depth: Tensor, deviation: Tensor) -> Tensor:
    r"""DS-NeRF depth supervision: :math:`-\sum_k \log h_k\, e^{-(t_k - D)^2 / 2 \hat\sigma^2}\, \Delta t_k` of a ray.

    Deng et al., arXiv:2107.02791, sec. 3: up to a constant and the normalisation of the normal distribution, the KL
    divergence from a normal distribution about the depth of a sparse point to the ray's termination distribution. A
    deviation well below the length of the intervals falls between their middles and gives no loss.

    Args:
        weights: ``(..., S)`` rendering weights :math:`h_k` in [0, 1] of rays through sparse points; differentiated.
        edges: ``(..., S + 1)`` of the intervals, distances along the ray, finite, ascending.
        depth: ``(...)`` distance :math:`D` of the point along the ray.
        deviation: ``(...)`` > 0, :math:`\hat\sigma`, in the unit of ``edges``.

    Returns:
        ``(...)`` float64 (float32 on mps), in the unit of ``edges``.

    Raises:
        ValueError: shapes that do not fit; an edge that is not finite; a deviation <= 0.

    Example:
        >>> edges = torch.tensor([0.0, 1.0, 2.0, 3.0])
        >>> [round(ds_nerf_loss(torch.tensor(weights), edges, torch.tensor(1.5), torch.tensor(0.2)).item(), 2)
        ...  for weights in ([0.0, 1.0, 0.0], [0.5, 0.5, 0.0], [1.0, 0.0, 0.0])]
        [0.0, 0.69, 11.51]
    """
    middles, lengths = _intervals("ds_nerf_loss", weights, edges, depth)
    sigma = widest(deviation)
    if deviation.shape != depth.shape or not bool((sigma > 0).all()):
        raise InvalidArgument(
            f"ds_nerf_loss: deviation must be {tuple(depth.shape)} values > 0, got shape {tuple(deviation.shape)}, "
            f"{int((~(sigma > 0)).sum())} values that are not"
        )
    apart = (middles - widest(depth)[..., None]) / sigma[..., None]
    return -(torch.log(widest(weights) + LEAST_WEIGHT) * torch.exp(-0.5 * apart**2) * lengths).sum(dim=-1)


def expected_depth_loss(weights: Tensor, edges: Tensor, depth: Tensor) -> Tensor:
    r"""Urban Radiance Fields, expected depth: :math:`(\sum_k w_k t_k - z)^2` of a ray.

    Rematas et al., arXiv:2111.14643, sec. 3.3. Light that gets through adds nothing to the sum.

    Args:
        weights: ``(..., S)`` rendering weights in [0, 1]; differentiated.
        edges: ``(..., S + 1)`` of the intervals, distances along the ray, finite, ascending.
        depth: ``(...)`` measured distance :math:`z` along the ray.

    Returns:
        ``(...)`` float64 (float32 on mps), in the unit of ``edges``, squared.

    Raises:
        ValueError: shapes that do not fit; an edge that is not finite.

    Example:
        >>> expected_depth_loss(torch.tensor([0.5, 0.5]), torch.tensor([0.0, 2.0, 4.0]), torch.tensor(5.0)).item()
        9.0
    """
    middles, _ = _intervals("expected_depth_loss", weights, edges, depth)
    return ((widest(weights) * middles).sum(dim=-1) - widest(depth)) ** 2


def line_of_sight_loss(weights: Tensor, edges: Tensor, depth: Tensor, margin: Tensor) -> Tensor:
    r"""Urban Radiance Fields, line of sight: empty before the point, Gaussian near it.

    Rematas et al., arXiv:2111.14643, sec. 3.3: :math:`\int_{t_n}^{z - \epsilon} w(t)^2 dt` and
    :math:`\int_{z - \epsilon}^{z + \epsilon} (w(t) - K_\epsilon(t - z))^2 dt`, where :math:`K_\epsilon` is a normal
    distribution of deviation :math:`\epsilon / 3`, cut at :math:`\pm\epsilon`. Both terms together, and by interval:
    :math:`(w_k - m_k)^2` with the mass :math:`m_k` that the kernel has in the interval (0 before the margin), so that
    an interval longer than the kernel still has a target, and the loss has no unit. Intervals that begin
    behind the margin have no loss, as in the paper: what is not there cannot be behind.

    Args:
        weights: ``(..., S)`` rendering weights in [0, 1]; differentiated.
        edges: ``(..., S + 1)`` of the intervals, distances along the ray, finite, ascending.
        depth: ``(...)`` measured distance :math:`z` along the ray.
        margin: ``(...)`` > 0, :math:`\epsilon`, in the unit of ``edges``.

    Returns:
        ``(..., S)`` float64 (float32 on mps): squared differences.

    Raises:
        ValueError: shapes that do not fit; an edge that is not finite; a margin <= 0.

    Example:
        >>> edges, depth = torch.tensor([0.0, 1.0, 2.0, 3.0]), torch.tensor(1.5)
        >>> line_of_sight_loss(torch.tensor([0.5, 0.5, 0.0]), edges, depth, torch.tensor(0.3)).tolist()
        [0.25, 0.25, 0.0]
    """
    _intervals("line_of_sight_loss", weights, edges, depth)
    half = widest(margin)[..., None]
    if margin.shape != depth.shape or not bool((half > 0).all()):
        raise InvalidArgument(
            f"line_of_sight_loss: margin must be {tuple(depth.shape)} values > 0, got shape {tuple(margin.shape)}, "
            f"{int((~(half > 0)).sum())} values that are not"
        )
    offset = (widest(edges) - widest(depth)[..., None]) / half
    root = KERNEL_DEVIATIONS / math.sqrt(2.0)
    below = torch.erf(offset.clamp(-1.0, 1.0) * root) / (2.0 * math.erf(root))
    squared: Tensor = (widest(weights) - below.diff(dim=-1)) ** 2
    return torch.where(offset[..., :-1] >= 1.0, torch.zeros_like(squared), squared)


def nearest_point_loss(density: Tensor, distance: Tensor, *, reach: float) -> Tensor:
    """Density times ``min(distance / reach, 1)``: matter far from every sparse point costs.

    The rule of point-based floater filters (keep what has sparse points within a radius), made continuous.

    Args:
        density: ``(...)`` >= 0; differentiated. Times a length to be free of the scene's unit.
        distance: ``(...)`` >= 0 to the nearest sparse point.
        reach: > 0, in the unit of ``distance``.

    Returns:
        ``(...)`` float32 or as precise as ``density``.

    Raises:
        ValueError: shapes that differ, a distance that is NaN or negative, ``reach`` not finite and > 0.

    Example:
        >>> nearest_point_loss(torch.full((3,), 2.0), torch.tensor([0.0, 0.5, 4.0]), reach=1.0).tolist()
        [0.0, 1.0, 2.0]
    """
    far = _nearness("nearest_point_loss", density, distance, reach)
    return upcast(density) * far


def floater_score_loss(
    density: Tensor,
    *,
    through: Tensor,
    ending: Tensor,
    distance: Tensor,
    neighbor_opacity: Tensor,
    reach: float,
) -> Tensor:
    r"""Density times a hand-made floater score of its place.

    :math:`\frac{through}{through + 3\, ending} \min(distance / reach, 1) (1 - neighbour\ opacity)`: a public study of
    one real room with 2,817 floaters labelled by hand found an area under the ROC curve of .976 for it. There it ranks
    splats; here it is the weight of a penalty, and is not differentiated. Where no line passes it is 0.

    Args:
        density: ``(...)`` >= 0; differentiated. Times a length to be free of the scene's unit.
        through: ``(...)`` >= 0, sight lines that pass through the place.
        ending: ``(...)`` >= 0, sight lines that end there.
        distance: ``(...)`` >= 0 to the five nearest sparse points, their mean.
        neighbor_opacity: ``(...)`` in [0, 1], the largest among the places around.
        reach: > 0, in the unit of ``distance``; the study's is .25 m.

    Returns:
        ``(...)`` float32 or as precise as ``density``.

    Raises:
        ValueError: shapes that differ; counts or distances that are NaN or negative; opacities outside [0, 1];
            ``reach`` not finite and > 0.

    Example:
        >>> place = {"distance": torch.tensor(0.5), "neighbor_opacity": torch.tensor(0.2)}
        >>> counts = {"through": torch.tensor(6.0), "ending": torch.tensor(2.0)}
        >>> round(floater_score_loss(torch.tensor(10.0), **counts, **place, reach=1.0).item(), 3)  # 10 * .5 * .5 * .8
        2.0
    """
    far = _nearness("floater_score_loss", density, distance, reach)
    counts = {"through": through, "ending": ending, "neighbor_opacity": neighbor_opacity}
    for name, values in counts.items():
        top = 1.0 if name == "neighbor_opacity" else math.inf
        if values.shape != density.shape or not bool(((values >= 0) & (values <= top)).all()):
            raise InvalidArgument(
                f"floater_score_loss: {name} must be {tuple(density.shape)} values in [0, {top:g}], "
                f"got shape {tuple(values.shape)}, {int((~((values >= 0) & (values <= top))).sum())} outside"
            )
    passing, stopping, solid = (upcast(values.detach()) for values in counts.values())
    share = passing / (passing + ENDING_FACTOR * stopping).clamp_min(torch.finfo(passing.dtype).tiny)
    return upcast(density) * share * far * (1.0 - solid)


def _intervals(caller: str, weights: Tensor, edges: Tensor, depth: Tensor) -> tuple[Tensor, Tensor]:
    """Middles and lengths of the intervals ``(..., S)``, after the shapes were checked."""
    expected = (*depth.shape, weights.shape[-1] if weights.ndim else 0)
    if tuple(weights.shape) != expected or tuple(edges.shape) != (*expected[:-1], expected[-1] + 1):
        raise InvalidArgument(
            f"{caller}: weights and edges must be (..., S) and (..., S + 1) for depth {tuple(depth.shape)}, "
            f"got {tuple(weights.shape)} and {tuple(edges.shape)}"
        )
    if not bool(torch.isfinite(edges).all()):
        raise InvalidArgument(
            f"{caller}: edges must be finite, got {int((~torch.isfinite(edges)).sum())} of {edges.numel()} that are not"
        )
    wide = widest(edges)
    return (wide[..., 1:] + wide[..., :-1]) / 2.0, wide.diff(dim=-1)


def _nearness(caller: str, density: Tensor, distance: Tensor, reach: float) -> Tensor:
    """``min(distance / reach, 1)``, not differentiated, after the arguments were checked."""
    if not (math.isfinite(reach) and reach > 0):
        raise InvalidArgument(f"{caller}: reach must be finite and > 0, got {reach}")
    if distance.shape != density.shape or not bool((distance >= 0).all()):
        raise InvalidArgument(
            f"{caller}: distance must be {tuple(density.shape)} values >= 0, got shape {tuple(distance.shape)}, "
            f"{int((~(distance >= 0)).sum())} values that are not"
        )
    return (upcast(distance.detach()) / reach).clamp(max=1.0)
