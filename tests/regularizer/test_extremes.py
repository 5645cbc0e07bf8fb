"""Densities of every size and dtype, no elements too: no loss that should be finite is not, and no gradient is NaN."""

import functools
import math
import warnings

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

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
from unghost.core.occupancy import OccupancyRule
from unghost.regularizer.density_regularizer import DensityRegularizer
from unghost.regularizer.losses import cubewise_mean, dsds_loss, stable_mean, visibility_loss

DTYPES = [torch.float16, torch.bfloat16, torch.float32, torch.float64]
LARGEST = torch.finfo(torch.float64).max
ANY = settings(max_examples=120, deadline=None, derandomize=True)
any_shape = st.lists(st.integers(0, 3), max_size=4).map(tuple)
cube_shape = st.integers(0, 2).flatmap(lambda count: st.tuples(st.just(count), *[st.integers(2, 3)] * 3))
seeds = st.integers(0, 2**32 - 1)


def extremes(dtype):
    info = torch.finfo(dtype)
    return [0.0, info.smallest_normal * info.eps, info.smallest_normal, 1.0, min(1e30, info.max), info.max]


@st.composite
def densities(draw, shapes=any_shape):
    """A leaf of one of the dtypes that mixes some of its extremes."""
    dtype, shape = draw(st.sampled_from(DTYPES)), draw(shapes)
    palette = draw(st.lists(st.sampled_from(extremes(dtype)), min_size=1, max_size=3, unique=True))
    chosen = np.random.default_rng(draw(seeds)).choice(palette, shape)
    return torch.tensor(chosen, dtype=torch.float64).to(dtype).requires_grad_()


def check(density, loss, *, limit):
    """The mean is finite if no density is beyond ``limit``; no gradient is NaN, all are finite from float32 on."""
    total = stable_mean(loss)
    highest = density.detach().double().max().item() if density.numel() else 0.0
    assert total.isfinite() if highest <= limit else not total.isnan()
    assert total.item() == 0.0 or density.numel()
    if total.requires_grad:
        total.backward()
        assert density.grad.dtype == density.dtype
        assert not density.grad.isnan().any()
        assert density.grad.isfinite().all() or density.dtype in (torch.float16, torch.bfloat16)


def like(density, values, seed, dtype=torch.float32):
    return torch.from_numpy(np.random.default_rng(seed).choice(values, tuple(density.shape))).to(dtype)


def test_the_strategy_reaches_what_it_should():
    assert all(torch.tensor(extremes(dtype), dtype=dtype).isfinite().all() for dtype in DTYPES)
    assert all((torch.tensor(extremes(dtype), dtype=dtype)[1:] > 0).all() for dtype in DTYPES)
    with pytest.raises(AssertionError):
        check(torch.full((2,), 1e30), torch.full((2,), math.inf), limit=1e35)


@ANY
@given(densities(), seeds, st.sampled_from([0.0, 0.01, 1e30]), st.sampled_from([-0.5, 0.0]))
def test_density_score_distillation(density, seed, target, threshold):
    x0_pred = like(density, [-1.0, -0.2, 0.0, 1.0], seed)
    loss = dsds_loss(density, x0_pred, target_density=target, threshold=threshold, fill_threshold=0.0)
    assert loss.isfinite().all()
    check(density, loss, limit=0.99 * LARGEST)


@ANY
@given(densities(), seeds)
def test_visibility(density, seed):
    loss = visibility_loss(density, like(density, [0, 1, 5], seed, torch.int64))
    assert loss.isfinite().all()
    check(density, loss, limit=0.99 * LARGEST)


@ANY
@given(densities(cube_shape), seeds, st.sampled_from([1e-30, 0.1, 1.0, 1e6]), st.sampled_from([0.01, 1e30]))
def test_means_of_cubes(density, seed, factor, target):
    x0_pred, used = like(density, [-1.0, 0.0, 1.0], seed), like(density, [0, 1], seed + 1, torch.bool)
    factors = torch.full((len(density), 1, 1, 1), factor, dtype=torch.float64)
    loss = functools.partial(dsds_loss, target_density=target)
    total = cubewise_mean(loss, density, x0_pred, factors, used)
    check(density, total, limit=0.99 * LARGEST / max(factor, 1.0))


ELEMENTWISE = {
    "sparsity": lambda d: sparsity_loss(d, length=0.1),
    "free_space": free_space_loss,
    "clamp": lambda d: squash_density(d, threshold=0.01, how="clamp"),
    "sigmoid": lambda d: squash_density(d, threshold=0.01, how="sigmoid"),
}


@pytest.mark.slow
@ANY
@given(densities(), st.sampled_from(sorted(ELEMENTWISE)))
def test_rivals_of_single_densities(density, name):
    loss = ELEMENTWISE[name](density)
    assert (loss.abs() <= 1.005).all()
    check(density, loss, limit=LARGEST)


@ANY
@given(densities(cube_shape), seeds, st.sampled_from(["clamp", "sigmoid"]), st.sampled_from([1e-6, 0.5, 0.9999]))
def test_score_distillation(density, seed, how, alpha):
    signed = squash_density(density, threshold=0.01, how=how)
    check(density, sds_loss(signed, like(density, [-1.0, 1.0], seed), alpha_cumprod=alpha), limit=LARGEST)


@ANY
@given(densities(), seeds)
def test_scaled_gradients(density, seed):
    check(density, scale_gradients(density, like(density, [0.0, 1e-45, 0.5, 1e30, math.inf], seed)), limit=1e308)


@ANY
@given(densities(cube_shape))
def test_total_variation(density):
    check(density, total_variation_loss(density), limit=1e308)
    if density.grad is not None and density.dtype == torch.float64:
        assert (density.grad.abs() <= 3.0).all()


@ANY
@given(densities(cube_shape), seeds)
def test_depth_smoothness(depth, seed):
    with torch.no_grad():
        depth[like(depth, [0, 1], seed, torch.bool)] = math.inf
    loss = depth_smoothness_loss(depth)
    finite = torch.where(depth.detach().isinf(), 0.0, depth.detach().double())
    assert loss.isfinite().all() or finite.max() > 1e153
    stable_mean(loss).backward()
    assert not depth.grad.isnan().any()


@pytest.mark.slow
@ANY
@given(densities(cube_shape))
def test_distortion(edges):
    weights = torch.full((*edges.shape[:-1], edges.shape[-1] - 1), 1.0 / edges.shape[-1], requires_grad=True)
    check(edges, distortion_loss(weights, edges.sort(dim=-1).values), limit=1e307)
    assert weights.grad is None or not weights.grad.isnan().any()


@pytest.mark.slow
@settings(max_examples=40, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    values=densities(st.just((8,))),
    answer=st.sampled_from(["identity", "empty", "full"]),
    rule=st.sampled_from([OccupancyRule(), OccupancyRule.paper()]),
    pitch=st.sampled_from([1e-6, 0.125, 100.0]),
    skip_empty=st.booleans(),
)
def test_a_step_of_the_regularizer(kit, aabb, lone_camera, values, answer, rule, pitch, skip_empty):
    """A field of eight densities, one an octant."""

    def density_fn(p):
        return values[((p > 0) * torch.tensor([1, 2, 4])).sum(dim=1)]

    regularizer = DensityRegularizer(
        kit.numpy_denoiser(kit.functions[answer]),
        aabb=aabb,
        cameras=lone_camera,
        rule=rule,
        field_pitch=pitch,
        skip_empty=skip_empty,
        cubes=1,
        edge_range=(0.9, 0.9),
        visibility_samples=64,
        dsds_weight=1.0,
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message="DensityRegularizer: density_fn returned")
        total = sum(regularizer(density_fn).values())
        total.backward()
    assert total.isfinite() if values.max() <= 1e300 else not total.isnan()
    assert not values.grad.isnan().any()
