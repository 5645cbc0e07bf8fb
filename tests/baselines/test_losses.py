"""Each loss of a rival: by hand, against an oracle, gradcheck, and numbers that would break it."""

import math

import numpy as np
import pytest
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
from unghost.core.ray_distortion import distortion
from unghost.core.schedule import alphas_cumprod

RNG = torch.Generator().manual_seed(0)


def uniform(*shape, low=0.0, high=1.0):
    return (low + (high - low) * torch.rand(*shape, generator=RNG, dtype=torch.float64)).requires_grad_()


def test_total_variation_by_hand():
    grid = torch.zeros(2, 2, 2)
    grid[1, 0, 0], grid[0, 1, 0], grid[0, 0, 1] = 3.0, 4.0, 12.0
    assert total_variation_loss(grid).tolist() == [[[13.0]]]  # 9 + 16 + 144 = 169
    assert total_variation_loss(torch.ones(5, 3, 4, 2)).shape == (5, 2, 3, 1)


def test_total_variation_of_a_step_is_its_area():
    grid = torch.zeros(9, 9, 9)
    grid[4:] = 2.0
    assert total_variation_loss(grid).sum() == 2.0 * 8 * 8


def test_total_variation_has_a_gradient_where_nothing_changes():
    grid = torch.ones(3, 3, 3, requires_grad=True)
    total_variation_loss(grid).sum().backward()
    assert grid.grad.abs().max() == 0.0


@pytest.mark.parametrize("step", [1e-310, 1e-200, 1e160, 1e307])
def test_total_variation_takes_no_square_of_what_has_none(step):
    grid = torch.zeros(2, 2, 2, dtype=torch.float64)
    grid[1, 0, 0], grid[0, 1, 0] = 3 * step, 4 * step
    grid.requires_grad_()
    loss = total_variation_loss(grid)
    assert loss.item() == pytest.approx(5 * step, rel=1e-9)
    loss.sum().backward()
    assert grid.grad[1, 0, 0].item() == pytest.approx(0.6, rel=1e-9)


def test_total_variation_beyond_float64_is_infinite_with_a_finite_gradient():
    grid = torch.zeros(2, 2, 2, dtype=torch.float64)
    grid[1, 0, 0] = grid[0, 1, 0] = torch.finfo(torch.float64).max
    loss = total_variation_loss(grid.requires_grad_())
    assert loss.item() == math.inf
    loss.sum().backward()
    assert grid.grad[1, 0, 0].item() == pytest.approx(math.sqrt(0.5))


def test_sparsity_by_hand():
    loss = sparsity_loss(torch.tensor([0.0, 2.0, 1e30]), length=0.5)
    assert loss.tolist() == pytest.approx([0.0, 1.0 - math.exp(-1.0), 1.0])
    assert sparsity_loss(torch.tensor(1e-20), length=1.0).item() == pytest.approx(1e-20)  # 1 - exp would be 0


def test_depth_smoothness_by_hand():
    assert depth_smoothness_loss(torch.tensor([[1.0, 3.0], [5.0, 9.0]])).tolist() == [[16.0 + 4.0]]
    assert depth_smoothness_loss(torch.zeros(10, 8, 8)).shape == (10, 7, 7)


def test_depths_of_any_size_and_of_rays_that_meet_nothing():
    assert depth_smoothness_loss(torch.tensor([[1e20, 0.0], [0.0, 0.0]])).tolist() == [[pytest.approx(2e40, rel=1e-6)]]
    assert depth_smoothness_loss(torch.tensor([[300.0, 0.0], [0.0, 0.0]], dtype=torch.float16)).tolist() == [[180000.0]]
    depth = torch.tensor([[math.inf, math.inf, 1.0], [math.inf, 2.0, 5.0], [1.0, 1.0, 1.0]], requires_grad=True)
    loss = depth_smoothness_loss(depth)
    # the sky to the sky and to the wall: 0; the wall to itself: (1 - 2)^2 + (5 - 2)^2
    assert loss.tolist() == [[0.0, 0.0], [0.0, 10.0]]
    loss.sum().backward()
    assert depth.grad.tolist() == [[0.0, 0.0, 0.0], [0.0, 2.0 - 6.0, 6.0], [0.0, -2.0, 0.0]]
    assert depth_smoothness_loss(torch.tensor([[math.nan, 1.0], [1.0, 1.0]])).isnan().all()


def test_distortion_by_hand_and_against_the_double_sum():
    weights, edges = torch.tensor([[0.5, 0.5]]), torch.tensor([[0.0, 1.0, 2.0]])
    # twice .25 times the distance 1 of the middles, and .25 for each of the two samples over 3
    assert distortion_loss(weights, edges).tolist() == [pytest.approx(0.5 + 0.5 / 3)]
    rng = np.random.default_rng(0)
    w, s = rng.random((4, 7)), np.sort(rng.random((4, 8)), axis=1)
    middle = (s[:, 1:] + s[:, :-1]) / 2
    slow = (w[:, :, None] * w[:, None] * abs(middle[:, :, None] - middle[:, None])).sum((1, 2))
    slow += (w**2 * np.diff(s)).sum(1) / 3
    np.testing.assert_allclose(distortion(w, s), slow, rtol=1e-12)
    np.testing.assert_allclose(distortion_loss(torch.from_numpy(w), torch.from_numpy(s)), slow, rtol=1e-12)


def test_distortion_of_huge_edges_and_of_no_rays():
    weights, edges = torch.full((1, 2), 0.5), torch.tensor([[0.0, 1e38, 3e38]])
    # middles 5e37 and 2e38: twice .25 times 1.5e38, and .25 times the widths 1e38 and 2e38 over 3
    assert distortion_loss(weights, edges).item() == pytest.approx(7.5e37 + 2.5e37, rel=1e-6)
    assert distortion_loss(torch.zeros(0, 4), torch.zeros(0, 5)).shape == (0,)


def test_free_space_by_hand():
    assert free_space_loss(torch.tensor([0.0, math.log(3.0), 1e30])).tolist() == pytest.approx([0.5, 0.75, 1.0])


def test_gradients_scale_with_the_square_of_the_distance_and_values_do_not():
    density, colour = torch.ones(3, requires_grad=True), torch.ones(3, 2, requires_grad=True)
    distance = torch.tensor([0.0, 0.5, 4.0])
    for values in (density, colour):
        scaled = scale_gradients(values, distance)
        assert torch.equal(scaled, values)
        scaled.sum().backward()
    assert density.grad.tolist() == [0.0, 0.25, 1.0]
    assert colour.grad.tolist() == [[0.0] * 2, [0.25] * 2, [1.0] * 2]


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_scaled_gradients_in_half_precision(dtype):
    """The square of .001 is subnormal in float16: three digits of it would be lost."""
    values = torch.ones(2, dtype=dtype, requires_grad=True)
    scaled = scale_gradients(values, torch.tensor([0.001, math.inf], dtype=dtype))
    assert scaled.dtype == dtype
    scaled.backward(torch.tensor([1000.0, 1.0], dtype=dtype))
    assert values.grad.dtype == dtype
    assert values.grad.tolist() == [pytest.approx(1e-3, rel=1e-2), 1.0]


@pytest.mark.parametrize("how", ["clamp", "sigmoid"])
def test_the_squash_goes_through_the_three_points_of_the_paper(how):
    density = torch.tensor([0.0, 0.01, 0.02, 10.0], dtype=torch.float64, requires_grad=True)
    signed = squash_density(density, threshold=0.01, how=how)
    np.testing.assert_allclose(signed.detach()[:3], [-1.0, 0.0, 1.0], atol=1e-12)
    assert 1.0 <= signed[3] <= 1.005
    (slope,) = torch.autograd.grad(signed.sum(), density)
    assert slope[1] > 50.0  # steep ...
    assert slope[3] == 0.0  # ... and flat: what the paper says is wrong with it


def test_the_sigmoid_between_its_points_by_hand():
    def scaled(d):  # logistic of six times the distance to the threshold, in [-1, 1] before it is rescaled
        return 2.0 / (1.0 + math.exp(-6.0 * (d / 0.01 - 1.0))) - 1.0

    density = torch.tensor([0.005, 0.015], dtype=torch.float64)
    found = squash_density(density, threshold=0.01, how="sigmoid").tolist()
    assert found == pytest.approx([-0.909647, 0.909647], abs=1e-6)
    assert found == pytest.approx([scaled(0.005) / scaled(0.02), scaled(0.015) / scaled(0.02)], rel=1e-12)


def test_sds_by_hand():
    signed, x0_pred = torch.tensor([[1.0, -0.25], [0.5, 0.0]]), torch.tensor([[-0.5, -0.25], [1.0, 1.0]])
    # sqrt(.36 * .64) = .48: half of it times 1.5^2 = 2.25 and 0; sqrt(.5 * .5) = .5: times .5^2 = .25 and 1
    found = sds_loss(signed, x0_pred, alpha_cumprod=torch.tensor([0.36, 0.5]))
    assert found.flatten().tolist() == pytest.approx([0.54, 0.0, 0.0625, 0.25])


def test_sds_has_the_gradient_of_dreamfusion():
    """Against noise put in and predicted: w (eps_pred - eps)."""
    alpha = torch.from_numpy(alphas_cumprod()[[50, 600]])
    signed, x0_pred, noise = (uniform(2, 4, 4, low=-1.0).detach() for _ in range(3))
    a = alpha[:, None, None]
    noised = a.sqrt() * signed + (1 - a).sqrt() * noise
    predicted_noise = (noised - a.sqrt() * x0_pred) / (1 - a).sqrt()
    signed.requires_grad_()
    x0_pred.requires_grad_()
    sds_loss(signed, x0_pred, alpha_cumprod=alpha).sum().backward()
    torch.testing.assert_close(signed.grad, (1 - a) * (predicted_noise - noise), rtol=1e-10, atol=1e-12)
    assert x0_pred.grad is None


def test_gradcheck():
    check = torch.autograd.gradcheck
    assert check(total_variation_loss, (uniform(2, 3, 3, 3),))
    assert check(lambda d: sparsity_loss(d, length=0.3), (uniform(5),))
    assert check(depth_smoothness_loss, (uniform(2, 4, 4),))
    edges = uniform(3, 6).detach().sort(dim=1).values.requires_grad_()
    assert check(distortion_loss, (uniform(3, 5), edges))
    assert check(free_space_loss, (uniform(5),))
    assert check(lambda d: squash_density(d, threshold=0.4, how="sigmoid"), (uniform(5),))
    apart = torch.tensor([0.1, 0.3, 0.5, 0.7, 0.9, 3.0], dtype=torch.float64, requires_grad=True)  # kinks: 0 and .8
    assert check(lambda d: squash_density(d, threshold=0.4, how="clamp"), (apart,))
    target = uniform(2, 5).detach()
    assert check(lambda x: sds_loss(x, target, alpha_cumprod=0.3), (uniform(2, 5),))


def test_scaled_gradients_are_the_numeric_ones_times_the_scale():
    """gradcheck cannot pass: the values are those of the identity, whose gradient is on purpose made smaller."""
    values, distance = uniform(4, 3), torch.tensor([0.0, 0.3, 0.9, 2.0], dtype=torch.float64)

    def outcome(v):
        return (torch.sin(scale_gradients(v, distance)) ** 2).sum()

    (found,) = torch.autograd.grad(outcome(values), values)
    steps = 1e-6 * torch.eye(values.numel(), dtype=torch.float64).reshape(-1, *values.shape)
    numeric = torch.stack([(outcome(values + step) - outcome(values - step)) / 2e-6 for step in steps]).reshape(4, 3)
    scale = torch.tensor([0.0, 0.09, 0.81, 1.0], dtype=torch.float64)[:, None]
    torch.testing.assert_close(found, numeric.detach() * scale, rtol=1e-6, atol=1e-9)
    with pytest.raises(RuntimeError, match="Jacobian mismatch"):
        torch.autograd.gradcheck(outcome, (values,))


LOSSES = {
    "total_variation": total_variation_loss,
    "sparsity": lambda d: sparsity_loss(d, length=0.1),
    "free_space": free_space_loss,
    "clamp": lambda d: squash_density(d, threshold=0.01, how="clamp"),
    "sigmoid": lambda d: squash_density(d, threshold=0.01, how="sigmoid"),
}


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_is_raised(dtype):
    grid = torch.full((2, 2, 2), 300.0, dtype=dtype)
    grid[1] = 600.0  # its square is beyond float16
    assert total_variation_loss(grid).tolist() == [[[300.0]]]
    assert all(loss(grid).dtype in (torch.float32, torch.float64) for loss in LOSSES.values())


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: total_variation_loss(torch.ones(1, 2, 2)), r"sides >= 2, got \(1, 2, 2\)"),
        (lambda: depth_smoothness_loss(torch.ones(4)), r"\(\.\.\., H, W\).*got \(4,\)"),
        (lambda: sparsity_loss(torch.ones(1), length=0.0), "length must be finite and > 0, got 0.0"),
        (lambda: distortion_loss(torch.ones(2, 3), torch.ones(2, 3)), r"edges must have shape \(2, 4\)"),
        (lambda: distortion_loss(torch.ones(1, 2), torch.tensor([[0.0, 1.0, math.inf]])), "finite .*got 1 of 3.* inf"),
        (lambda: distortion_loss(torch.ones(1, 2), torch.tensor([[0.0, math.nan, 1.0]])), "finite .*got 1 of 3.* nan"),
        (lambda: scale_gradients(torch.ones(3), torch.ones(2)), r"distance's shape \(2,\), got \(3,\)"),
        (
            lambda: scale_gradients(torch.ones(2), torch.tensor([1.0, math.nan])),
            "distance must be >= 0, got 1 of 2.*nan",
        ),
        (lambda: scale_gradients(torch.ones(2), torch.tensor([-0.5, -1.0])), "distance must be >= 0, got 2 of 2.*-0.5"),
        (lambda: squash_density(torch.ones(1), threshold=0.0, how="clamp"), "threshold must be finite and > 0"),
        (lambda: squash_density(torch.ones(1), threshold=1.0, how="tanh"), 'how must be "clamp" or "sigmoid"'),
        (lambda: sds_loss(torch.ones(2, 3), torch.ones(3), alpha_cumprod=0.5), r"x0_pred must have shape \(2, 3\)"),
        (lambda: sds_loss(torch.ones(2), torch.ones(2), alpha_cumprod=1.0), r"in \(0, 1\), got 1.0"),
    ],
)
def test_what_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()
