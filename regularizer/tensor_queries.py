"""Asking a differentiable density callable, in bounded chunks, and saying what is wrong with its answer (torch)."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from ..core.arrays import upcast
from ..core.errors import InvalidArgument, InvalidType
from ..core.occupancy import check_density, check_density_shape

DensityFn = Callable[[Any], Any]

CALLER = "DensityRegularizer"
WITHOUT_GRADIENT = (
    "{caller}: density_fn returned densities without a gradient, so that the losses cannot change the field: "
    "is it detached, frozen, or under no_grad?"
)


def query_tensors(
    field: DensityFn, positions: Tensor, *, chunk: int, drop_invalid: bool, caller: str = CALLER
) -> tuple[Tensor, Tensor]:
    """Densities ``(M,)`` at ``positions (M, 3)``, at least float32, and which of them are valid.

    Args:
        field: positions to densities ``(M, 1)`` or ``(M,)``.
        positions: float32.
        chunk: most positions a call.
        drop_invalid: put 0 for what is NaN, infinite or negative, and call it invalid, instead of raising.
        caller: named in messages.

    Raises:
        TypeError: no tensor of floating-point numbers.
        ValueError: of another shape or on another device; or NaN, infinite or negative, unless dropping.

    Warns:
        UserWarning: gradients are wanted, and the densities have none.
    """
    if len(positions) == 0:
        return positions.new_zeros(0), torch.ones(0, dtype=torch.bool, device=positions.device)
    values = torch.cat([_as_densities(field(part), part, caller) for part in torch.split(positions, chunk)])
    if torch.is_grad_enabled() and not values.requires_grad:
        warnings.warn(WITHOUT_GRADIENT.format(caller=caller), stacklevel=2)
    if not drop_invalid:
        check_density(values.detach(), positions, caller=caller)
        return values, torch.ones_like(values, dtype=torch.bool)
    valid = torch.isfinite(values.detach()) & (values.detach() >= 0)
    return torch.where(valid, values, torch.zeros_like(values)), valid


def _as_densities(density: Any, positions: Tensor, caller: str) -> Tensor:
    """What a callable returned for ``positions (M, 3)``, as ``(M,)``, at least float32, or an error that names it."""
    if not isinstance(density, Tensor):
        raise InvalidType(f"{caller}: density_fn must return a torch tensor, got {type(density).__name__}")
    if not density.is_floating_point():
        raise InvalidType(f"{caller}: density_fn must return floating-point densities, got {density.dtype}")
    if density.device != positions.device:
        raise InvalidArgument(
            f"{caller}: density_fn must return densities on the device of its positions, "
            f"{positions.device}, got {density.device}"
        )
    return upcast(check_density_shape(density, positions, caller=caller))
