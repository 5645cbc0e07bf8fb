import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from unghost.core.schedule import alphas_cumprod, betas, flip_probabilities
from unghost.prior.diffusion.formulas import (
    bernoulli_posterior,
    clean_cubes,
    epsilon_from_x0,
    kept_share,
    q_flip,
    q_sample,
    x0_from_epsilon,
)


def at(*steps):
    return torch.tensor(steps, dtype=torch.int64)


def test_kept_share_is_the_table_and_one_before_it():
    found = kept_share(at(0, 999, -1), torch.zeros(3, 1, 2, 2, 2))
    assert found.shape == (3, 1, 1, 1, 1)
    assert found.dtype == torch.float64
    assert found.flatten().tolist() == [alphas_cumprod()[0], alphas_cumprod()[-1], 1.0]


@pytest.mark.parametrize(
    ("steps", "kind", "message"),
    [
        (torch.tensor([1.0]), TypeError, "timestep must be an integer, got dtype torch.float32"),
        (at(1, 2), ValueError, r"timestep must have shape \(1,\), got \(2,\)"),
        (at(1000), ValueError, r"timestep must lie in \[-1, 1000\)"),
        (at(-2), ValueError, r"timestep must lie in \[-1, 1000\)"),
    ],
)
def test_kept_share_refuses(steps, kind, message):
    with pytest.raises(kind, match=message):
        kept_share(steps, torch.zeros(1, 4))


def test_noising_by_hand_and_at_the_ends():
    x0, noise = torch.tensor([[1.0, -1.0]]), torch.tensor([[0.5, 2.0]])
    # a_0 = 1 - 0.0015
    first = [math.sqrt(0.9985) + 0.5 * math.sqrt(0.0015), -math.sqrt(0.9985) + 2.0 * math.sqrt(0.0015)]
    assert q_sample(x0, at(0), noise).flatten().tolist() == pytest.approx(first, abs=1e-6)
    assert torch.allclose(q_sample(x0, at(999), noise), noise, atol=1e-5)
    assert x0.tolist() == [[1.0, -1.0]]


def test_noising_one_step_after_another_gives_the_same_distribution():
    """Monte Carlo of q(x_t | x_{t-1}) forty times against the closed form at once."""
    rng = np.random.default_rng(0)
    chain = np.full(200_000, 0.7)
    for beta in betas()[:40]:
        chain = math.sqrt(1 - beta) * chain + math.sqrt(beta) * rng.standard_normal(chain.shape)
    noise = torch.from_numpy(rng.standard_normal((1, 200_000)))
    direct = q_sample(torch.full((1, 200_000), 0.7, dtype=torch.float64), at(39), noise).numpy()
    error = math.sqrt((1 - alphas_cumprod()[39]) / 200_000)
    assert abs(chain.mean() - direct.mean()) < 5 * error
    assert chain.std() == pytest.approx(direct.std(), rel=0.01)


def test_flips_happen_as_often_as_the_table_says():
    uniform = torch.rand(3, 100_000, generator=torch.Generator().manual_seed(1))
    x0 = torch.ones(3, 100_000)
    for sign in (1.0, -1.0):
        flipped = (q_flip(sign * x0, at(10, 200, 999), uniform) == -sign).float().mean(1)
        expected = flip_probabilities()[[10, 200, 999]]
        assert np.abs(flipped.numpy() - expected).max() < 5 * math.sqrt(0.25 / 100_000)
    assert set(q_flip(x0, at(10, 200, 999), uniform).unique().tolist()) == {-1.0, 1.0}


def test_a_soft_cube_flips_as_a_coin_of_its_value():
    uniform = torch.linspace(0, 1, 10_001)[None, :-1]
    share = (q_flip(torch.full((1, 10_000), 0.5), at(0), uniform) > 0).float().mean().item()
    assert share == pytest.approx((1 + 0.9985 * 0.5) / 2, abs=2e-4)


@given(st.integers(0, 999), st.floats(-1, 1), st.floats(-4, 4))
@settings(max_examples=60, deadline=None)
def test_x0_from_epsilon_inverts(step, value, draw):
    x0, noise = torch.full((1, 1), value, dtype=torch.float64), torch.full((1, 1), draw, dtype=torch.float64)
    xt = q_sample(x0, at(step), noise)
    assert x0_from_epsilon(xt, at(step), noise, clamp=False).item() == pytest.approx(value, abs=1e-8)
    assert epsilon_from_x0(xt, at(step), x0).item() == pytest.approx(draw, abs=1e-8)


def test_x0_is_clamped_where_noise_is_magnified():
    xt, wrong = torch.tensor([[0.5, -0.5]]), torch.zeros(1, 2)
    free = x0_from_epsilon(xt, at(999), wrong, clamp=False)
    assert free[0, 0] > 1e5
    assert torch.isfinite(free).all()
    assert x0_from_epsilon(xt, at(999), wrong).tolist() == [[1.0, -1.0]]


@pytest.mark.parametrize(("late", "early"), [(1, 0), (40, 39), (400, 150), (999, 998), (999, 0), (25, -1)])
@pytest.mark.parametrize("xt", [-1.0, 1.0])
def test_bernoulli_posterior_by_enumeration(late, early, xt):
    """All paths x_0 -> x_s -> x_t with the transition matrices multiplied out step by step."""

    def chain(first, last):  # from after step `first` to after step `last`
        matrix = np.eye(2)
        for beta in betas()[first + 1 : last + 1]:
            matrix = matrix @ np.array([[1 - beta / 2, beta / 2], [beta / 2, 1 - beta / 2]])
        return matrix

    start_to_early, early_to_late = chain(-1, early), chain(early, late)
    seen, occupied = int(xt > 0), 0.83  # P(x_0 = +1 | x_t)
    expected = 0.0
    for x0, share in ((1, occupied), (0, 1 - occupied)):
        joint = [start_to_early[x0, xs] * early_to_late[xs, seen] for xs in (0, 1)]
        expected += share * joint[1] / sum(joint)
    mean = torch.tensor([[2 * occupied - 1]], dtype=torch.float64)
    found = bernoulli_posterior(torch.tensor([[xt]], dtype=torch.float64), mean, at(late), at(early))
    assert found.item() == pytest.approx(expected, abs=1e-9)


def test_the_posterior_wants_an_earlier_time():
    cube = torch.zeros(1, 2)
    with pytest.raises(ValueError, match="previous must be < timestep"):
        bernoulli_posterior(cube, cube, at(5), at(5))
    with pytest.raises(ValueError, match="must have the shape of xt"):
        bernoulli_posterior(cube, torch.zeros(1, 3), at(5), at(4))


def test_clean_cubes_take_what_is_ignored_for_empty():
    labels = torch.tensor([0, 1, 2, 1, 0, 0, 2, 0], dtype=torch.uint8).reshape(1, 2, 2, 2)
    found = clean_cubes(labels)
    assert found.shape == (1, 1, 2, 2, 2)
    assert found.dtype == torch.float32
    assert found.flatten().tolist() == [-1, 1, -1, 1, -1, -1, -1, -1]
    assert labels.flatten().tolist() == [0, 1, 2, 1, 0, 0, 2, 0]


def test_no_cubes_at_all():
    none = torch.zeros(0, 1, 4, 4, 4)
    steps = torch.zeros(0, dtype=torch.int64)
    assert q_sample(none, steps, none).shape == none.shape
    assert q_flip(none, steps, none).shape == none.shape
    assert x0_from_epsilon(none, steps, none).shape == none.shape
    assert bernoulli_posterior(none, none, steps, steps - 1).shape == none.shape
