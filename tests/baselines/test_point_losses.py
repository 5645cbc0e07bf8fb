"""Each rival's loss on sparse points: by hand, gradcheck, shapes, and arguments that it refuses."""

import math

import pytest
import torch
from scipy.stats import norm

from unghost.baselines.point_losses import (
    LEAST_WEIGHT,
    ds_nerf_loss,
    expected_depth_loss,
    floater_score_loss,
    line_of_sight_loss,
    nearest_point_loss,
)

EDGES = torch.tensor([0.5, 1.0, 1.5, 2.0, 4.0], dtype=torch.float64)
RAYS = EDGES.expand(3, 5)
DEPTH = torch.tensor([0.8, 1.4, 3.0], dtype=torch.float64)
DEVIATION = torch.tensor([0.1, 0.3, 0.5], dtype=torch.float64)
LOSSES = {
    "ds_nerf_loss": lambda weights: ds_nerf_loss(weights, RAYS, DEPTH, DEVIATION),
    "expected_depth_loss": lambda weights: expected_depth_loss(weights, RAYS, DEPTH),
    "line_of_sight_loss": lambda weights: line_of_sight_loss(weights, RAYS, DEPTH, DEVIATION),
}


def weights():
    generator = torch.Generator().manual_seed(0)
    return (0.05 + 0.2 * torch.rand(3, 4, generator=generator, dtype=torch.float64)).requires_grad_()


@pytest.mark.parametrize("name", LOSSES)
def test_gradients(name):
    assert torch.autograd.gradcheck(LOSSES[name], weights())


@pytest.mark.parametrize("name", LOSSES)
def test_one_ray_is_that_ray_of_a_batch(name):
    loss = {"ds_nerf_loss": ds_nerf_loss, "expected_depth_loss": expected_depth_loss}.get(name, line_of_sight_loss)
    rest = () if name == "expected_depth_loss" else (DEVIATION,)
    found = loss(weights(), RAYS, DEPTH, *rest)
    assert torch.equal(found[1], loss(weights()[1], EDGES, DEPTH[1], *(each[1] for each in rest)))
    assert found.shape == ((3, 4) if name == "line_of_sight_loss" else (3,))


def test_ds_nerf_by_hand():
    given = torch.tensor([0.1, 0.6, 0.2, 0.0])
    pairs = ((0.1, 0.75, 0.5), (0.6, 1.25, 0.5), (0.2, 1.75, 0.5), (0.0, 3.0, 2.0))
    expected = -sum(
        math.log(h + LEAST_WEIGHT) * math.exp(-((t - 1.4) ** 2) / (2 * 0.3**2)) * step for h, t, step in pairs
    )
    found = ds_nerf_loss(given, EDGES.float(), torch.tensor(1.4), torch.tensor(0.3))
    assert found.item() == pytest.approx(expected, rel=1e-5)


def test_ds_nerf_prefers_light_that_ends_at_the_point():
    losses = [ds_nerf_loss(torch.eye(4)[k], EDGES.float(), torch.tensor(1.25), torch.tensor(0.2)) for k in range(4)]
    assert min(range(4), key=losses.__getitem__) == 1


def test_expected_depth_by_hand():
    given = torch.tensor([0.5, 0.0, 0.0, 0.25])
    assert expected_depth_loss(given, EDGES.float(), torch.tensor(1.0)).item() == pytest.approx((0.375 + 0.75 - 1) ** 2)


def test_line_of_sight_by_hand():
    depth, margin = torch.tensor(1.4, dtype=torch.float64), torch.tensor(0.3, dtype=torch.float64)
    given = torch.tensor([0.2, 0.5, 0.1, 0.2], dtype=torch.float64)
    kernel = norm(1.4, 0.1)
    inside = kernel.cdf(1.7) - kernel.cdf(1.1)
    masses = [0.0, (kernel.cdf(1.5) - kernel.cdf(1.1)) / inside, (kernel.cdf(1.7) - kernel.cdf(1.5)) / inside]
    expected = [(w - m) ** 2 for w, m in zip((0.2, 0.5, 0.1), masses)] + [0.0]  # 2.0 is behind 1.7
    assert line_of_sight_loss(given, EDGES, depth, margin).tolist() == pytest.approx(expected, abs=1e-12)
    perfect = torch.tensor([*masses, 0.0], dtype=torch.float64)
    assert line_of_sight_loss(perfect, EDGES, depth, margin).abs().max() < 1e-12


def test_nearest_point_by_hand_and_gradient():
    distance = torch.tensor([0.0, 0.1, 9.0], dtype=torch.float64)
    density = torch.tensor([3.0, 4.0, 5.0], dtype=torch.float64, requires_grad=True)
    assert nearest_point_loss(density, distance, reach=0.4).tolist() == pytest.approx([0.0, 1.0, 5.0])
    assert torch.autograd.gradcheck(lambda values: nearest_point_loss(values, distance, reach=0.4), density)


def test_floater_score_by_hand_and_gradient():
    given = {
        "through": torch.tensor([9.0, 0.0, 0.0, 5.0], dtype=torch.float64),
        "ending": torch.tensor([1.0, 4.0, 0.0, 0.0], dtype=torch.float64),
        "distance": torch.tensor([0.1, 0.2, 0.2, 0.2], dtype=torch.float64),
        "neighbor_opacity": torch.tensor([0.5, 0.0, 0.0, 0.0], dtype=torch.float64, requires_grad=True),
    }
    density = torch.full((4,), 8.0, dtype=torch.float64, requires_grad=True)
    found = floater_score_loss(density, **given, reach=0.2)
    assert found.tolist() == pytest.approx([8 * 0.75 * 0.5 * 0.5, 0.0, 0.0, 8.0])
    found.sum().backward()
    assert given["neighbor_opacity"].grad is None  # the score is a weight, not a loss of its own
    assert torch.autograd.gradcheck(lambda values: floater_score_loss(values, **given, reach=0.2), density)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: ds_nerf_loss(weights()[:, :3], RAYS, DEPTH, DEVIATION), r"ds_nerf_loss: weights and edges must be"),
        (lambda: expected_depth_loss(weights(), RAYS, DEPTH[:2]), r"for depth \(2,\)"),
        (lambda: expected_depth_loss(weights(), RAYS / 0.0, DEPTH), "edges must be finite, got 15 of 15"),
        (lambda: ds_nerf_loss(weights(), RAYS, DEPTH, 0 * DEVIATION), "deviation must be .* 3 values that are not"),
        (lambda: line_of_sight_loss(weights(), RAYS, DEPTH, DEVIATION[0]), r"margin must be \(3,\) values > 0"),
        (lambda: nearest_point_loss(DEPTH, -DEPTH, reach=1.0), "distance must be .* 3 values that are not"),
        (lambda: nearest_point_loss(DEPTH, DEPTH, reach=0.0), "reach must be finite and > 0, got 0.0"),
        (
            lambda: floater_score_loss(
                DEPTH, through=DEPTH, ending=DEPTH, distance=DEPTH, neighbor_opacity=DEPTH, reach=1.0
            ),
            r"neighbor_opacity must be \(3,\) values in \[0, 1\], got shape \(3,\), 2 outside",
        ),
    ],
)
def test_what_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()
