"""The two losses of the paper on densities, pure and unreduced.

Gradients flow through ``density`` only; what the denoiser predicted enters as a mask.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from ..core.errors import InvalidArgument, MissingExtra

try:
    import torch
    from torch import Tensor
    from torch.autograd.function import once_differentiable
except ImportError as error:  # pragma: no cover - exercised in a subprocess
    raise MissingExtra("unghost.regularizer.losses needs torch: pip install unghost[torch]") from error

from ..core.arrays import upcast, widest
from ..core.occupancy import DECISION


def dsds_loss(
    density: Tensor,
    x0_pred: Tensor,
    *,
    target_density: float | Tensor,
    threshold: float = DECISION,
    fill_threshold: float | None = None,
) -> Tensor:
    r"""Density score distillation (the paper, eq. 2): push density out of empty voxels and into occupied ones.

    .. math:: m \sigma + (1 - m) \max(w - \sigma, 0), \qquad m = [\hat x_0 < threshold]

    Departure: with ``fill_threshold > threshold``, voxels between the two are left alone.

    Args:
        density: ``(...)``, finite, >= 0, per scene unit (or an optical depth, with ``target_density`` to match).
        x0_pred: the same shape, [-1, 1]; not differentiated.
        target_density: ``w``, >= 0; a number, or a tensor of the same rank whose every axis but the first is 1.
        threshold: ``x0_pred`` below it means empty.
        fill_threshold: ``x0_pred`` at or above it means occupied; None for ``threshold``.

    Returns:
        The unreduced loss, the shape of ``density``, at least float32. Finite wherever ``density`` is.

    Raises:
        ValueError: shapes differ, or ``fill_threshold < threshold``.

    Example:
        >>> import torch
        >>> density, x0_pred = torch.tensor([3.0, 0.5, 3.0]), torch.tensor([-1.0, 1.0, 1.0])
        >>> dsds_loss(density, x0_pred, target_density=2.0).tolist()
        [3.0, 1.5, 0.0]
    """
    if x0_pred.shape != density.shape:
        raise InvalidArgument(f"dsds_loss: x0_pred must have shape {tuple(density.shape)}, got {tuple(x0_pred.shape)}")
    fill = threshold if fill_threshold is None else fill_threshold
    if not (math.isfinite(threshold) and math.isfinite(fill) and fill >= threshold):
        raise InvalidArgument(f"dsds_loss: fill_threshold must be finite and >= threshold={threshold}, got {fill}")
    values, prediction = upcast(density), x0_pred.detach()
    target = _target(target_density, values)
    penalty = torch.where(prediction < threshold, values, torch.zeros_like(values))
    return penalty + torch.where(prediction >= fill, torch.relu(target - values), torch.zeros_like(values))


def _target(target_density: float | Tensor, density: Tensor) -> Tensor:
    """``w`` as a tensor beside ``density``, refusing anything that would broadcast by accident."""
    if not isinstance(target_density, Tensor):
        if not (math.isfinite(target_density) and target_density >= 0):
            raise InvalidArgument(f"dsds_loss: target_density must be finite and >= 0, got {target_density}")
        return density.new_tensor(target_density)
    per_cube = (len(density), *[1] * (density.ndim - 1)) if density.ndim else ()
    if tuple(target_density.shape) not in ((), per_cube, tuple(density.shape)):
        raise InvalidArgument(
            f"dsds_loss: target_density must be a number or have shape {per_cube}, got {tuple(target_density.shape)}"
        )
    return target_density.detach().to(density)


def visibility_loss(density: Tensor, view_count: Tensor, *, min_views: int = 1) -> Tensor:
    r"""Density where no camera looks (the paper, eq. 3): :math:`V(q) \sigma(q)`, :math:`V = [views < min\_views]`.

    Args:
        density: ``(...)``, finite, >= 0, per scene unit (or an optical depth).
        view_count: the same shape, integers: how many cameras see the point; not differentiated.
        min_views: a point seen by fewer is penalised; the paper's eq. 3 has 1.

    Returns:
        The unreduced loss, the shape of ``density``, at least float32.

    Raises:
        ValueError: shapes differ, or ``min_views < 1``.

    Example:
        >>> visibility_loss(torch.tensor([2.0, 2.0]), torch.tensor([0, 3])).tolist()
        [2.0, 0.0]
    """
    if view_count.shape != density.shape:
        raise InvalidArgument(
            f"visibility_loss: view_count must have shape {tuple(density.shape)}, got {tuple(view_count.shape)}"
        )
    if min_views < 1:
        raise InvalidArgument(f"visibility_loss: min_views must be >= 1, got {min_views}")
    values = upcast(density)
    return torch.where(view_count < min_views, values, torch.zeros_like(values))


def sight_line_loss(density: Tensor, length: Tensor | float) -> Tensor:
    """Opacity of sight lines, which measured free space: ``1 - exp(-optical depth)``.

    Args:
        density: ``(L, S)``, >= 0, per scene unit, at places spread evenly over each line.
        length: ``(L,)`` or a number, scene units.

    Returns:
        ``(L,)`` in [0, 1), at least float32: 0 for clear lines.

    Raises:
        ValueError: ``length`` does not fit.

    Example:
        >>> sight_line_loss(torch.tensor([[0.0, 0.0], [1.0, 3.0]]), torch.tensor([5.0, 0.5])).tolist()
        [0.0, 0.6321205496788025]
    """
    return -torch.expm1(-_line_depth("sight_line_loss", density, length))


def end_point_loss(density: Tensor, length: Tensor | float) -> Tensor:
    """Transparency of short segments about observed points, which measured matter: ``exp(-optical depth)``.

    Args:
        density: ``(L, S)``, >= 0, per scene unit, at places spread evenly over each segment.
        length: ``(L,)`` or a number, scene units.

    Returns:
        ``(L,)`` in (0, 1], at least float32: 0 for opaque segments.

    Raises:
        ValueError: ``length`` does not fit.

    Example:
        >>> end_point_loss(torch.tensor([[0.0, 0.0], [1.0, 3.0]]), 0.5).tolist()
        [1.0, 0.3678794503211975]
    """
    return torch.exp(-_line_depth("end_point_loss", density, length))


def _line_depth(caller: str, density: Tensor, length: Tensor | float) -> Tensor:
    if density.ndim != 2 or (isinstance(length, Tensor) and length.shape != density.shape[:1]):
        raise InvalidArgument(
            f"{caller}: density must be (L, S) and length (L,), got {tuple(density.shape)} and "
            f"{tuple(length.shape) if isinstance(length, Tensor) else length}"
        )
    return upcast(density).mean(dim=1) * length


def stable_mean(loss: Tensor, *, count: int | None = None) -> Tensor:
    """Mean that no finite loss can overflow: each term is divided before the sum, which runs in float64.

    Where the mean is within rounding of the largest float64 it may become inf; its gradient is ``1 / count`` all the
    same.

    Args:
        loss: ``(...)``.
        count: divide by this instead of the number of elements; >= 1.

    Returns:
        Scalar float64 (float32 on mps); exactly 0 for an empty tensor.

    Example:
        >>> stable_mean(torch.full((4,), 3e38)).item() < 3.1e38  # a float32 sum would overflow
        True
    """
    wide = widest(loss)
    return (wide / max(loss.numel() if count is None else count, 1)).sum()


def cube_parts(cubes: Tensor) -> list[slice]:
    """How to go through cubes ``(N, R, R, R)``: on a CPU one by one, so that all steps find one in its cache."""
    size = 1 if cubes.device.type == "cpu" else max(len(cubes), 1)
    return [slice(start, start + size) for start in range(0, len(cubes), size)]


def cubewise_mean(
    loss: Callable[[Tensor, Tensor], Tensor], density: Tensor, x0_pred: Tensor, factor: Tensor, used: Tensor
) -> Tensor:
    """Mean loss of many cubes in float64, one after the other on a CPU, in whose cache all of them have no room.

    Args:
        loss: ``(density (n, R, R, R) times factor, x0_pred)`` to the unreduced loss, the same shape.
        density: ``(N, R, R, R)``.
        x0_pred: the same shape; not differentiated.
        factor: ``(N, 1, 1, 1)`` float64, not differentiated.
        used: ``(N, R, R, R)`` bool: the mean is over these.

    Returns:
        Scalar float64 (float32 on mps); exactly 0 where nothing is used. It can be differentiated once. The gradient is
        finite wherever ``density`` is; the mean is inf where a ``density * factor`` is beyond 1.8e308 (3.4e38 on mps),
        which only densities given in float64 can reach at a ``factor`` > 1.

    Example:
        >>> density, x0_pred = torch.full((2, 2, 2, 2), 3.0), -torch.ones(2, 2, 2, 2)
        >>> factor, used = torch.full((2, 1, 1, 1), 0.5, dtype=torch.float64), torch.ones(2, 2, 2, 2, dtype=torch.bool)
        >>> cubewise_mean(lambda d, x: dsds_loss(d, x, target_density=1.0), density, x0_pred, factor, used).item()
        1.5
    """
    result: Tensor = _CubewiseMean.apply(density, loss, x0_pred, factor, used)  # type: ignore[no-untyped-call]
    return result


class _CubewiseMean(torch.autograd.Function):
    """See :func:`cubewise_mean`."""

    @staticmethod
    def forward(
        ctx: Any,
        density: Tensor,
        loss: Callable[[Tensor, Tensor], Tensor],
        x0_pred: Tensor,
        factor: Tensor,
        used: Tensor,
    ) -> Tensor:
        """The mean; the gradient is worked out on the way."""
        count, total = max(int(used.sum()), 1), widest(density.new_zeros(()))
        gradient = torch.empty_like(density) if ctx.needs_input_grad[0] else None
        for part in cube_parts(density):
            with torch.enable_grad():
                wide = widest(density[part].detach()).requires_grad_(gradient is not None)
                each = loss(wide * factor[part], x0_pred[part])
                mean = stable_mean(torch.where(used[part], each, torch.zeros_like(each)), count=count)
            if gradient is not None:
                gradient[part] = torch.autograd.grad(mean, wide)[0]
            total = total + mean.detach()
        ctx.save_for_backward(gradient)
        return total

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_output: Tensor) -> tuple[Tensor | None, None, None, None, None]:
        """To the density alone."""
        (gradient,) = ctx.saved_tensors
        return (None if gradient is None else gradient * grad_output.to(gradient)), None, None, None, None
