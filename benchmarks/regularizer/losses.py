"""The rows of ``docs/stability.md`` about single losses, and what all rows are made of."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch

from unghost.baselines.losses import (
    depth_smoothness_loss,
    distortion_loss,
    free_space_loss,
    scale_gradients,
    sds_loss,
    sparsity_loss,
    squash_density,
    total_variation_loss,
)
from unghost.regularizer.losses import cubewise_mean, dsds_loss, stable_mean

SINGLE = (torch.float32,)
BRAIN = (torch.float32, torch.bfloat16)
TYPES = (torch.float32, torch.float16, torch.bfloat16)


@dataclass(frozen=True)
class Case:
    """One row: what goes in, what happens, and the check, which may return a relative error.

    Attributes:
        given: the input.
        behaviour: what ``check`` asserts.
        check: of a dtype.
        types: in which it is checked.
    """

    given: str
    behaviour: str
    check: Callable[[torch.dtype], float | None]
    types: tuple[torch.dtype, ...] = TYPES


def relative(measured: float, expected: float) -> float:
    return abs(measured - expected) / abs(expected) if expected else abs(measured)


def largest(dtype: torch.dtype) -> float:
    return torch.finfo(dtype).max


def smallest(dtype: torch.dtype) -> float:
    return torch.finfo(dtype).smallest_normal * torch.finfo(dtype).eps


def worst(found: torch.Tensor, exact: torch.Tensor) -> float:
    """Largest relative error; below the smallest normal float32, relative to that."""
    difference = (found.detach().double() - exact.detach()).abs()
    return float((difference / exact.detach().abs().clamp(min=torch.finfo(torch.float32).tiny)).max())


def refuses(run: Callable[[], Any], kind: type[Exception], text: str) -> None:
    message = ""
    try:
        run()
    except kind as error:
        message = str(error)
    assert text in message, f"no {kind.__name__} that says {text!r}, but {message!r}"


def magnitudes(dtype: torch.dtype, shape: tuple[int, ...]) -> torch.Tensor:
    """Zero, the smallest, the largest and what lies between, in random places."""
    wanted = [0.0, smallest(dtype), 1e-30, 1e-3, 1.0, 30.0, 1e10, largest(dtype)]
    chosen = np.random.default_rng(0).choice([value for value in wanted if value <= largest(dtype)], shape)
    return torch.from_numpy(chosen).to(dtype)


def rival(
    loss: Callable[[torch.Tensor], torch.Tensor], lowest: float = 0.0, highest: float = math.inf
) -> Callable[[torch.dtype], float]:
    """Densities of all magnitudes against the same in float64; values between the two, gradients finite."""

    def check(dtype: torch.dtype) -> float:
        given = magnitudes(dtype, (6, 6, 6)).requires_grad_()
        found, exact = loss(given), loss(given.detach().double())
        assert torch.isfinite(found).all()
        assert ((found >= lowest) & (found <= highest)).all()
        stable_mean(found).backward()
        assert given.grad is not None
        assert torch.isfinite(given.grad).all()
        return worst(found, exact)

    return check


def flat(dtype: torch.dtype) -> float:
    """Total variation beside and in a part where nothing changes."""
    grid = torch.ones((4, 4, 4), dtype=dtype)
    grid[3] = 3.0
    loss = total_variation_loss(grid.requires_grad_())
    loss.sum().backward()
    assert grid.grad is not None
    assert (grid.grad[:2] == 0).all()
    return worst(loss, torch.tensor([0.0, 0.0, 2.0], dtype=torch.float64)[:, None, None].expand(3, 3, 3))


def largest_float64(_: torch.dtype) -> None:
    """Where no wider type is left."""
    for value, beyond in ((1e300, False), (1e308, True)):
        density = torch.full((1, 2, 2, 2), value, dtype=torch.float64, requires_grad=True)
        factor, used = torch.full((1, 1, 1, 1), 10.0, dtype=torch.float64), torch.ones(1, 2, 2, 2, dtype=torch.bool)
        loss = cubewise_mean(
            lambda d, x: dsds_loss(d, x, target_density=1.0), density, -torch.ones(1, 2, 2, 2), factor, used
        )
        assert loss.isinf() if beyond else relative(loss.item(), 10.0 * value) < 1e-15
        loss.backward()
        assert density.grad is not None
        assert (density.grad == 10.0 / 8).all()
    grid = torch.zeros((2, 2, 2), dtype=torch.float64)
    grid[1, 0, 0] = 1e308
    assert total_variation_loss(grid).item() == 1e308
    assert depth_smoothness_loss(grid[:, 0] / 1e155).item() == 1e153**2
    assert depth_smoothness_loss(grid[:, 0]).isinf()


def sky(dtype: torch.dtype) -> float:
    depth = torch.tensor([[math.inf, math.inf, 1.0], [math.inf, 2.0, 5.0], [1.0, 1.0, 1.0]], dtype=dtype)
    loss = depth_smoothness_loss(depth.requires_grad_())
    loss.sum().backward()
    assert depth.grad is not None
    assert (depth.grad[depth.isinf()] == 0).all()
    return worst(loss, torch.tensor([[0.0, 0.0], [0.0, 10.0]], dtype=torch.float64))


def spread(dtype: torch.dtype) -> float:
    """The sum in O(samples) against the double sum."""
    edges = magnitudes(dtype, (6, 7)).sort(dim=-1).values.requires_grad_()
    weights = torch.full((6, 6), 0.125, dtype=dtype, requires_grad=True)
    found = distortion_loss(weights, edges)
    found.sum().backward()
    assert weights.grad is not None
    assert torch.isfinite(found).all()
    assert not weights.grad.isnan().any()  # it can be larger than the largest of its type
    w, s = weights.detach().double(), edges.detach().double()
    middle = s[:, 1:] / 2 + s[:, :-1] / 2
    exact = (w[:, :, None] * w[:, None] * (middle[:, :, None] - middle[:, None]).abs()).sum((1, 2))
    return worst(found, exact + (w**2 * s.diff(dim=1)).sum(1) / 3)


def no_edges(dtype: torch.dtype) -> None:
    for bad in (math.inf, math.nan):
        edges = torch.tensor([[0.0, 1.0, bad]], dtype=dtype)
        refuses(partial(distortion_loss, torch.ones(1, 2), edges), ValueError, f"1 of 3 that are not; first {bad}")


def scaled(dtype: torch.dtype) -> float:
    values = torch.ones(6, dtype=dtype, requires_grad=True)
    distance = torch.tensor([0.0, 0.03, 0.3, 1.0, 5.0, math.inf], dtype=dtype)
    result = scale_gradients(values, distance)
    assert torch.equal(result, values)
    assert result.dtype == dtype
    result.sum().backward()
    assert values.grad is not None
    return worst(values.grad, distance.double().clamp(max=1.0) ** 2)


def no_distances(dtype: torch.dtype) -> None:
    for bad in (-1.0, math.nan):
        distance = torch.tensor([0.0, bad], dtype=dtype)
        refuses(partial(scale_gradients, torch.ones(2), distance), ValueError, f"1 of 2 that are not; first {bad:g}")


def half_gradient(dtype: torch.dtype) -> None:
    """The gradient of one voxel in a million lies below float16's smallest number."""
    level = torch.full((1 << 20,), 2.0, dtype=dtype, requires_grad=True)
    stable_mean(dsds_loss(level, -torch.ones(len(level)), target_density=1.0)).backward()
    assert level.grad is not None
    assert (level.grad == torch.tensor(2.0**-20, dtype=dtype)).all()
    level.grad.zero_()
    (0.01 * stable_mean(dsds_loss(level, -torch.ones(len(level)), target_density=1.0))).backward()
    assert (level.grad == 0).all()


def squash(how: Any) -> Callable[[torch.Tensor], torch.Tensor]:
    return lambda density: squash_density(density, threshold=0.01, how=how)


def distill(density: torch.Tensor) -> torch.Tensor:
    return sds_loss(squash("sigmoid")(density), torch.zeros_like(density), alpha_cumprod=0.36)


LOSS_CASES = [
    Case(
        "densities in float16, gradient",
        "a voxel's share of a mean over a million, times a weight, can underflow to "
        "0 in float16: scale the loss (`GradScaler`) or give densities in float32",
        half_gradient,
        (torch.float16,),
    ),
    Case(
        "densities in float64, beyond 1e300",
        "finite gradients; a loss is inf where `density · pitch` is beyond "
        "1.8e308, or the square of a depth's difference",
        largest_float64,
        SINGLE,
    ),
    Case(
        "total variation, densities 0 to the largest",
        "finite, in float64; no square of more than 1 is taken",
        rival(total_variation_loss),
    ),
    Case("total variation where nothing changes", "0, gradient 0", flat),
    Case(
        "sparsity, densities 0 to the largest",
        "between 0 and 1; small densities keep their digits (`expm1`)",
        rival(lambda d: sparsity_loss(d, length=0.05), 0.0, 1.0),
    ),
    Case("free-space prior, densities 0 to the largest", "between 1/2 and 1", rival(free_space_loss, 0.5, 1.0)),
    Case("depth smoothness, depths 0 to the largest", "finite, in float64", rival(depth_smoothness_loss)),
    Case("depth smoothness, rays that meet nothing (inf)", "no difference to their neighbours: 0, gradient 0", sky),
    Case("distortion, edges 0 to the largest", "finite, in float64; against the double sum", spread),
    Case("distortion, an edge inf or NaN", "`ValueError` with count and first: squash distances before", no_edges),
    Case("scaled gradients, distances 0 to inf", "values as they are; the gradient is rounded to their type", scaled),
    Case("scaled gradients, a distance NaN or −1", "`ValueError` with count and first", no_distances),
    Case("densities squashed by a clamp", "between −1 and 1", rival(squash("clamp"), -1.0, 1.0)),
    Case("densities squashed by a sigmoid", "between −1 and 1.005", rival(squash("sigmoid"), -1.0 - 1e-6, 1.005)),
    Case("score distillation of those", "between 0 and .2424 (a = .36)", rival(distill, 0.0, 0.2424)),
]
