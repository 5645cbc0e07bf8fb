import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from unghost.evaluation.uncertainty.sparsification import ause, sparsify

ERRORS = np.array([4.0, 1.0, 3.0, 2.0])


def test_four_pixels_by_hand():
    # left after removing 0, 1, 2, 3 of four, by error: 2.5, 2, 1.5, 1. The uncertainty drops 1 first, then 4, then 2:
    # {4,3,2} 3, {3,2} 2.5, {3} 3. Divided by 2.5: 1 .8 .6 .4 against 1 1.2 1 1.2, apart by 0 .4 .4 .8;
    # trapezoids of width .25: (.2 + .4 + .6) / 4 = .3. At random 1 throughout: apart by 0 .2 .4 .6, (.1 + .3 + .5) / 4
    found = sparsify(ERRORS, np.array([3.0, 4.0, 1.0, 2.0]), steps=4)
    assert found.removed.tolist() == [0, 0.25, 0.5, 0.75]
    assert found.by_error == pytest.approx([1, 0.8, 0.6, 0.4])
    assert found.by_uncertainty == pytest.approx([1, 1.2, 1, 1.2])
    assert found.ause == pytest.approx(0.3)
    assert found.ause_random == pytest.approx(0.225)
    assert found.pixels == 4


def test_reductions_by_hand():
    # two steps: all four, then the two surest {4, 1} against the two best {1, 2}
    uncertainty = np.array([1.0, 2.0, 3.0, 4.0])
    mse = sparsify(ERRORS, uncertainty, steps=2, reduction="mse")
    assert mse.by_uncertainty == pytest.approx([1, 8.5 / 7.5])
    assert mse.by_error == pytest.approx([1, 2.5 / 7.5])
    rmse = sparsify(ERRORS, uncertainty, steps=2, reduction="rmse")
    assert rmse.by_uncertainty == pytest.approx(np.sqrt([1, 8.5 / 7.5]))
    assert rmse.ause == pytest.approx((np.sqrt(8.5 / 7.5) - np.sqrt(2.5 / 7.5)) / 4)


def test_the_published_normalization_divides_by_the_largest():
    uncertainty = np.array([3.0, 4.0, 1.0, 2.0])
    whole, largest = (sparsify(ERRORS, uncertainty, steps=4, normalization=name) for name in ("whole", "largest"))
    assert largest.by_uncertainty.max() == 1
    assert largest.ause == pytest.approx(whole.ause / 1.2)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from(["mae", "mse", "rmse"]), st.integers(5, 300))
def test_a_ranking_like_the_errors_is_perfect_and_any_other_is_worse(seed, reduction, count):
    rng = np.random.default_rng(seed)
    errors = rng.exponential(size=count)
    assert ause(errors, errors**3 + 5, reduction=reduction) == pytest.approx(0, abs=1e-12)
    assert ause(errors, rng.random(count), reduction=reduction) >= -1e-12
    upside_down = sparsify(errors, -errors, reduction=reduction)
    assert upside_down.ause >= upside_down.ause_random >= 0


def test_equals_a_loop():
    rng = np.random.default_rng(0)
    errors, doubts = rng.exponential(size=137), rng.random(137)
    found = sparsify(errors, doubts, steps=20)
    for step in range(20):
        left = max(int((1 - step / 20) * 137), 1)
        surest = sorted(range(137), key=lambda index: doubts[index])[:left]
        best = sorted(errors)[:left]
        assert found.by_uncertainty[step] == pytest.approx(errors[surest].mean() / errors.mean())
        assert found.by_error[step] == pytest.approx(np.mean(best) / errors.mean())


def test_a_constant_uncertainty_is_random_whatever_the_order_of_pixels():
    rng = np.random.default_rng(0)
    errors = rng.exponential(size=200)
    found = sparsify(errors, np.full(200, 0.7))
    assert found.by_uncertainty == pytest.approx(found.at_random)
    assert found.ause == pytest.approx(found.ause_random)
    doubts = rng.integers(0, 4, 200).astype(float)  # ties
    order = rng.permutation(200)
    assert ause(errors, doubts) == pytest.approx(ause(errors[order], doubts[order]), abs=1e-12)


def test_ties_are_the_mean_over_orders():
    errors, doubts = np.array([1.0, 5.0, 3.0]), np.array([0.0, 1.0, 1.0])
    found = sparsify(errors, doubts, steps=3)  # left 3, 2, 1: with two left, half the time 5 and half the time 3
    assert found.by_uncertainty * 3 == pytest.approx([3, ((1 + 5) / 2 + (1 + 3) / 2) / 2, 1])


def test_masks_shapes_and_infinite_doubt():
    rng = np.random.default_rng(0)
    errors, doubts = rng.exponential(size=(6, 7)), rng.random((6, 7))
    mask = rng.random((6, 7)) < 0.5
    spoilt = np.where(mask, errors, np.nan)
    assert ause(spoilt, np.where(mask, doubts, np.nan), mask) == ause(errors[mask], doubts[mask])
    endless = doubts.copy()
    endless.flat[doubts.argmax()] = np.inf
    assert ause(errors, endless) == ause(errors, doubts)


def test_no_error_anywhere_and_a_single_pixel():
    assert ause(np.zeros(9), np.arange(9.0)) == 0
    assert sparsify(np.array([2.0]), np.array([1.0])).by_uncertainty == pytest.approx(np.ones(100))


def test_errors_are_named():
    good = np.ones(4)
    with pytest.raises(ValueError, match="reduction must be one of mae, rmse, mse, got 'max'"):
        ause(good, good, reduction="max")
    with pytest.raises(ValueError, match="normalization must be one of whole, largest, got 'none'"):
        ause(good, good, normalization="none")
    with pytest.raises(ValueError, match=r"shape of error \(4,\), got \(3,\)"):
        ause(good, good[:3])
    with pytest.raises(ValueError, match="mask must be bool of shape"):
        ause(good, good, good)
    with pytest.raises(ValueError, match="at least one pixel"):
        ause(good, good, np.zeros(4, dtype=bool))
    with pytest.raises(ValueError, match="2 unmasked values are not"):
        ause(np.array([1.0, -1.0, np.inf, 2.0]), good)
    with pytest.raises(ValueError, match="1 unmasked uncertainties are NaN"):
        ause(good, np.array([1.0, np.nan, 1, 1]))
    with pytest.raises(ValueError, match="steps must be >= 2, got 1"):
        ause(good, good, steps=1)


@pytest.mark.parametrize("reduction", ["mae", "mse", "rmse"])
def test_without_ties_the_published_recipe_gives_the_same_area(reduction):
    # Bayes' Rays: a hundred shares removed, means of the prefixes of both orders, divided by the larger maximum
    rng = np.random.default_rng(0)
    errors = rng.exponential(size=1003)
    doubts = errors + rng.normal(size=1003)
    values = errors if reduction == "mae" else errors**2
    removed = np.linspace(0, 1, 100, endpoint=False)
    curves = []
    for ordered in (values[np.argsort(doubts)], np.sort(values)):
        means = np.array([ordered[: int((1 - share) * 1003)].mean() for share in removed])
        curves.append(np.sqrt(means) if reduction == "rmse" else means)
    apart = (curves[0] - curves[1]) / max(curves[0].max(), curves[1].max())
    wanted = ((apart[1:] + apart[:-1]) / 2 * np.diff(removed)).sum()
    assert ause(errors, doubts, reduction=reduction, normalization="largest") == pytest.approx(wanted)
