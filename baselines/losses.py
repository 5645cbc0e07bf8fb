"""What others add to the photometric loss against floaters: pure, unreduced, each after its source.

All take and give tensors; half precision is raised to float32 as in :mod:`unghost.regularizer.losses`, and to float64
where squares or long sums need it; :func:`scale_gradients` alone gives back what it got. Where a formula has a corner
(the root of total variation at 0), the gradient there is 0, never NaN.
"""

from __future__ import annotations

import math
from typing import Literal

from ..core.errors import InvalidArgument, MissingExtra

try:
    import torch
    from torch import Tensor
except ImportError as error:  # pragma: no cover - exercised in a subprocess
    raise MissingExtra("unghost.baselines.losses needs torch: pip install unghost[torch]") from error

from ..core.arrays import upcast, widest
from ..core.ray_distortion import distortion

Squash = Literal["clamp", "sigmoid"]
SIGMOID_SLOPE = 6.0  # of the scaled sigmoid at the threshold: within .005 of -1 at density 0 before it is rescaled


def total_variation_loss(grid: Tensor) -> Tensor:
    r"""Plenoxels, eq. 3: :math:`\sqrt{\Delta_x^2 + \Delta_y^2 + \Delta_z^2}` of neighbouring voxels.

    Args:
        grid: ``(..., X, Y, Z)`` densities (or anything else), each axis >= 2.

    Returns:
        ``(..., X - 1, Y - 1, Z - 1)`` float64 (float32 on mps): the differences are to the next voxel along each axis.
        Finite up to 1e308; as no square is taken of more than 1, the gradient is finite wherever ``grid`` is.

    Raises:
        ValueError: fewer than three axes, or one shorter than 2.

    Example:
        >>> grid = torch.zeros(2, 2, 2)
        >>> grid[1] = 3.0
        >>> total_variation_loss(grid).flatten().tolist()
        [3.0]
    """
    if grid.ndim < 3 or min(grid.shape[-3:]) < 2:
        raise InvalidArgument(
            f"total_variation_loss: grid must be (..., X, Y, Z) with sides >= 2, got {tuple(grid.shape)}"
        )
    values = widest(grid)
    here = values[..., :-1, :-1, :-1]
    steps = torch.stack(
        [values[..., 1:, :-1, :-1] - here, values[..., :-1, 1:, :-1] - here, values[..., :-1, :-1, 1:] - here]
    )
    longest = steps.detach().abs().amax(0)
    flat = longest == 0
    unit = steps / torch.where(flat, torch.ones_like(longest), longest)
    return longest * torch.sqrt(torch.where(flat, torch.ones_like(longest), (unit**2).sum(0)))


def sparsity_loss(density: Tensor, *, length: float) -> Tensor:
    r"""PlenOctrees, eq. 7: :math:`|1 - e^{-\lambda \sigma}|` at points drawn uniformly in the scene's box.

    Args:
        density: ``(...)`` >= 0, per scene unit.
        length: ``lambda``, scene units, > 0.

    Example:
        >>> [round(value, 3) for value in sparsity_loss(torch.tensor([0.0, 1.0, 1e6]), length=1.0).tolist()]
        [0.0, 0.632, 1.0]
    """
    if not (math.isfinite(length) and length > 0):
        raise InvalidArgument(f"sparsity_loss: length must be finite and > 0, got {length}")
    return -torch.expm1(-length * upcast(density))


def depth_smoothness_loss(depth: Tensor) -> Tensor:
    r"""RegNeRF, eq. 4: squared differences of expected depth within patches of rays from unseen views.

    Args:
        depth: ``(..., H, W)``, sides >= 2, scene units; the paper's patches have 8 x 8 rays. A ray that meets nothing
            (inf) has no depth to compare: the difference to its neighbours is 0, and so is the gradient.

    Returns:
        ``(..., H - 1, W - 1)`` float64 (float32 on mps): down plus across. Finite for depths up to 1e153 (1e18).

    Example:
        >>> depth_smoothness_loss(torch.tensor([[1.0, 1.0], [3.0, 1.0]])).tolist()
        [[4.0]]
    """
    if depth.ndim < 2 or min(depth.shape[-2:]) < 2:
        raise InvalidArgument(f"depth_smoothness_loss: depth must be (..., H, W), sides >= 2, got {tuple(depth.shape)}")
    endless, values = torch.isinf(depth), widest(depth)
    down = torch.where(endless[..., 1:, :-1] | endless[..., :-1, :-1], 0.0, values.diff(dim=-2)[..., :-1])
    across = torch.where(endless[..., :-1, 1:] | endless[..., :-1, :-1], 0.0, values.diff(dim=-1)[..., :-1, :])
    return down**2 + across**2


def distortion_loss(weights: Tensor, edges: Tensor) -> Tensor:
    """mip-NeRF 360, eq. 15, a ray: see :func:`unghost.core.ray_distortion.distortion`.

    Args:
        weights: ``(..., S)`` in [0, 1], adding up to at most 1.
        edges: ``(..., S + 1)``, finite, ascending; squash distances to [0, 1] first (the paper by ``t / (1 + t)``-like
            maps, which take an endless last sample to 1).

    Returns:
        ``(...)`` float64 (float32 on mps), differentiable in both. Finite for edges up to 1e307 (1e37).

    Raises:
        ValueError: shapes that do not fit; an edge that is infinite or NaN.

    Example:
        >>> edges = torch.tensor([0.0, 0.5, 1.0])
        >>> [round(float(distortion_loss(torch.tensor(weights), edges)), 4) for weights in ([1.0, 0.0], [0.5, 0.5])]
        [0.1667, 0.3333]
    """
    finite = torch.isfinite(edges)
    if not bool(finite.all()):
        raise InvalidArgument(
            f"distortion_loss: edges must be finite (squash distances first), got {int((~finite).sum())} of "
            f"{edges.numel()} that are not; first {edges[~finite][0].item():g}"
        )
    spread: Tensor = distortion(widest(weights), widest(edges))
    return spread


def free_space_loss(density: Tensor) -> Tensor:
    """Free-space prior ("Optimize the Unseen"): ``sigmoid(density)`` at points drawn uniformly, 2^17 of them a step.

    Args:
        density: ``(...)`` >= 0, per scene unit: the least value is 1/2.

    Example:
        >>> [round(value, 3) for value in free_space_loss(torch.tensor([0.0, 4.0])).tolist()]
        [0.5, 0.982]
    """
    return torch.sigmoid(upcast(density))


class _ScaleGradient(torch.autograd.Function):
    @staticmethod
    def forward(ctx: torch.autograd.function.FunctionCtx, values: Tensor, scale: Tensor) -> Tensor:
        ctx.save_for_backward(scale)
        return values.view_as(values)

    @staticmethod
    def backward(ctx: torch.autograd.function.FunctionCtx, *gradients: Tensor) -> tuple[Tensor, None]:
        (scale,) = ctx.saved_tensors  # type: ignore[attr-defined]
        return (gradients[0] * scale).to(gradients[0].dtype), None


def scale_gradients(values: Tensor, distance: Tensor) -> Tensor:
    """Floaters No More: the same values, their gradients times ``min(1, distance^2)``.

    Samples near a camera are dense and get too much of the gradient. The gradient is thus on purpose not that of the
    values, and ``gradcheck`` fails wherever the distance is below 1.

    Args:
        values: ``(...)`` or ``(..., C)``: densities, colours.
        distance: ``(...)`` >= 0, inf too, from the ray's camera, in units in which 1 is the far side of "near".

    Returns:
        ``values``, of their own dtype, as their gradient is; the factor is worked out in float32 at least.

    Raises:
        ValueError: shapes that do not fit; distances that are NaN or negative.

    Example:
        >>> density = torch.ones(3, requires_grad=True)
        >>> scale_gradients(density, torch.tensor([0.0, 0.5, 2.0])).sum().backward()
        >>> density.grad.tolist()
        [0.0, 0.25, 1.0]
    """
    if values.shape[: distance.ndim] != distance.shape:
        raise InvalidArgument(
            f"scale_gradients: values must begin with distance's shape {tuple(distance.shape)}, "
            f"got {tuple(values.shape)}"
        )
    far = upcast(distance.detach())
    valid = far >= 0
    if not bool(valid.all()):
        raise InvalidArgument(
            f"scale_gradients: distance must be >= 0, got {int((~valid).sum())} of {far.numel()} that are not; "
            f"first {far[~valid][0].item():g}"
        )
    scale = far.clamp(max=1.0) ** 2
    wide = scale.reshape((*scale.shape, *[1] * (values.ndim - scale.ndim)))
    scaled: Tensor = _ScaleGradient.apply(values, wide)  # type: ignore[no-untyped-call]
    return scaled


def squash_density(density: Tensor, *, threshold: float, how: Squash) -> Tensor:
    """Density to the diffusion model's range, differentiably (the paper, "Why not just..."): 0, t, 2t to -1, 0, 1.

    ``"clamp"`` is linear between -1 and 1 and flat beyond; ``"sigmoid"`` a scaled and shifted sigmoid, which goes on to
    at most 1.005. Both are flat where density is large: the reason why the paper does without.

    Args:
        density: ``(...)`` >= 0.
        threshold: ``t`` > 0, where density begins to be occupied.
        how: see above.

    Example:
        >>> squash_density(torch.tensor([0.0, 0.01, 0.02, 5.0]), threshold=0.01, how="clamp").tolist()
        [-1.0, 0.0, 1.0, 1.0]
    """
    if not (math.isfinite(threshold) and threshold > 0):
        raise InvalidArgument(f"squash_density: threshold must be finite and > 0, got {threshold}")
    centred = upcast(density) / threshold - 1.0
    if how == "clamp":
        return centred.clamp(-1.0, 1.0)
    if how != "sigmoid":
        raise InvalidArgument(f'squash_density: how must be "clamp" or "sigmoid", got {how!r}')
    return torch.tanh(centred * (SIGMOID_SLOPE / 2.0)) / math.tanh(SIGMOID_SLOPE / 2.0)


def sds_loss(signed: Tensor, x0_pred: Tensor, *, alpha_cumprod: float | Tensor) -> Tensor:
    r"""Score distillation (DreamFusion, eq. 3) of cubes that were noised before they were denoised.

    Its gradient with respect to ``signed`` is :math:`w\,(\hat\epsilon - \epsilon)`, :math:`w = 1 - \bar\alpha`. As
    :math:`\hat\epsilon - \epsilon = \sqrt{\bar\alpha / (1 - \bar\alpha)}\,(x - \hat x_0)`, neither noise is asked for.
    The value is that of :math:`\tfrac12 w \sqrt{\bar\alpha / (1 - \bar\alpha)}\,(x - \hat x_0)^2`, its gradient taken
    with :math:`\hat x_0` held.

    Args:
        signed: ``(N, ...)``, :func:`squash_density` of the cubes; differentiated.
        x0_pred: the same shape: what the denoiser made of ``sqrt(a) signed + sqrt(1 - a) noise``; not differentiated.
        alpha_cumprod: ``a`` in (0, 1) at the timestep; a number, or one for each cube ``(N,)``.

    Example:
        >>> signed = torch.tensor([[0.5]], requires_grad=True)
        >>> sds_loss(signed, torch.tensor([[-1.0]]), alpha_cumprod=0.36).sum().backward()
        >>> round(signed.grad.item(), 2)  # (1 - a) sqrt(a / (1 - a)) (0.5 + 1)
        0.72
    """
    if x0_pred.shape != signed.shape:
        raise InvalidArgument(f"sds_loss: x0_pred must have shape {tuple(signed.shape)}, got {tuple(x0_pred.shape)}")
    values = upcast(signed)
    alpha = torch.as_tensor(alpha_cumprod, dtype=values.dtype, device=values.device)
    if tuple(alpha.shape) not in ((), (len(values),)) or not bool(((alpha > 0) & (alpha < 1)).all()):
        raise InvalidArgument(
            f"sds_loss: alpha_cumprod must be one or {len(values)} numbers in (0, 1), got {alpha_cumprod}"
        )
    weight = torch.sqrt(alpha * (1.0 - alpha))
    weight = weight.reshape(-1, *[1] * (values.ndim - 1)) if weight.ndim else weight
    return 0.5 * weight * (values - x0_pred.detach()) ** 2
