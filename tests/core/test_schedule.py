import numpy as np
import pytest

from unghost.core.schedule import (
    alphas_cumprod,
    betas,
    check_timestep,
    flip_log_odds,
    flip_probabilities,
    strided_timesteps,
    timestep_from_severity,
)


def test_the_papers_schedule():
    assert len(betas()) == 1000
    assert betas()[0] == 0.0015
    assert betas()[-1] == 0.05
    assert alphas_cumprod()[1] == pytest.approx((1 - betas()[0]) * (1 - betas()[1]))
    assert (np.diff(alphas_cumprod()) < 0).all()


def test_severity_spans_the_timesteps():
    assert timestep_from_severity([0.0, 0.5, 1.0]).tolist() == [0, 500, 999]
    for wrong in (-0.1, 1.1, np.nan):
        with pytest.raises(ValueError, match="severity must lie in"):
            timestep_from_severity(wrong)


def test_timesteps_are_integers_in_range():
    assert check_timestep(np.int32(999), caller="f").dtype == np.int64
    assert check_timestep(np.zeros(0, dtype=int), caller="f").shape == (0,)
    with pytest.raises(TypeError, match="f: timestep must be an integer, got dtype float64"):
        check_timestep(3.0, caller="f")
    for wrong in (-1, 1000):
        with pytest.raises(ValueError, match="f: timestep must lie in"):
            check_timestep([0, wrong], caller="f")


def test_flips_are_what_a_thousand_coin_steps_leave():
    """One step mixes ``[[1 - b/2, b/2], [b/2, 1 - b/2]]`` in; the product's off-diagonal is the flip probability."""
    product = np.eye(2)
    found = []
    for beta in betas():
        product = product @ np.array([[1 - beta / 2, beta / 2], [beta / 2, 1 - beta / 2]])
        found.append(product[0, 1])
    np.testing.assert_allclose(flip_probabilities(), found, rtol=1e-10)
    assert flip_probabilities()[0] == pytest.approx(0.00075)
    assert flip_probabilities()[-1] == pytest.approx(0.5, abs=1e-10)


def test_log_odds_of_a_bit():
    flips = flip_probabilities()
    np.testing.assert_allclose(flip_log_odds()[:500], np.log((1 - flips) / flips)[:500], rtol=1e-9)
    assert flip_log_odds()[0] == pytest.approx(7.19, abs=0.01)
    assert 0 < flip_log_odds()[-1] < 1e-11  # where 1 - f and f are the same number to 11 digits
    assert (np.diff(flip_log_odds()) < 0).all()


@pytest.mark.parametrize("count", [1, 2, 7, 50, 999, 1000])
def test_strides_go_from_the_last_timestep_to_the_first(count):
    steps = strided_timesteps(count)
    assert len(steps) == count
    assert steps[0] == 999
    assert steps[-1] == (0 if count > 1 else 999)
    assert (np.diff(steps) <= -(999 // max(count - 1, 1))).all()
    assert (np.diff(steps) >= -np.ceil(999 / max(count - 1, 1))).all()


def test_strides_by_hand_and_refused():
    assert strided_timesteps(4).tolist() == [999, 666, 333, 0]
    for wrong in (0, 1001):
        with pytest.raises(ValueError, match=r"count must lie in \[1, 1000\]"):
            strided_timesteps(wrong)
