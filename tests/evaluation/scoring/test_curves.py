import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from unghost.evaluation.scoring import curves
from unghost.evaluation.scoring.curves import Curve


def _rows(pairs, convention="proper", **more):
    return [
        {"coverage": c, "psnr": s, "threshold": k, "convention": convention, **more} for k, (c, s) in enumerate(pairs)
    ]


def _curve(method, pairs, **settings):
    return Curve.create(method, _rows(pairs), knob="threshold", **settings)


# column B of the published scores, PSNR over coverage in %: what "the bar" rests on
BAYES = _curve("bayes-rays", [(0.547, 17.97), (0.704, 17.88), (0.893, 17.63), (0.932, 17.49)])
FREE = _curve("free-space", [(0.876, 17.69), (0.899, 17.60), (0.965, 17.35)])
PAPER = Curve.create("paper", _rows([(0.681, 17.01)]))


def test_interpolation_by_hand():
    curve = _curve("a", [(0.8, 18.0), (0.4, 20.0)])
    assert curve.at(0.4) == 20
    assert curve.at(0.5) == pytest.approx(19.5)
    assert curve.at(0.8) == 18
    assert curve.at(0.39) is None
    assert curve.at(0.81) is None


def test_the_published_bar_at_equal_coverage():
    # Bayes' Rays at 68.1 %: 17.97 - .09 * (.681 - .547) / (.704 - .547) = 17.893, .883 dB ahead of the paper
    rows = curves.against_points([BAYES, FREE, PAPER])
    assert rows[0]["psnr"] == pytest.approx(17.97 - 0.09 * 0.134 / 0.157)
    assert rows[0]["ahead"] == pytest.approx(0.883, abs=1e-3)
    assert (rows[0]["method"], rows[0]["point"], rows[0]["coverage"]) == ("bayes-rays", "paper", 0.681)
    assert rows[1]["ahead"] is None  # the free-space prior never removes that much


def test_comparison_by_hand():
    rows = {row["method"]: row for row in curves.compare([BAYES, FREE, PAPER])}
    assert rows["bayes-rays"]["at_coverage"] == 0.932
    assert rows["bayes-rays"]["psnr_at_coverage"] == 17.49
    assert rows["free-space"]["psnr_at_coverage"] == pytest.approx(17.60 - 0.25 * 33 / 66)
    assert rows["paper"]["psnr_at_coverage"] is None
    # area over .876 .. .932. Free-space: to .899 the mean of 17.69 and 17.60, then of 17.60 and 17.475
    assert rows["free-space"]["area_range"] == [0.876, 0.932]
    wanted = (17.645 * 0.023 + (17.60 + 17.475) / 2 * 0.033) / 0.056
    assert rows["free-space"]["psnr_area"] == pytest.approx(wanted)
    start = 17.88 - 0.25 * (0.876 - 0.704) / (0.893 - 0.704)
    wanted = ((start + 17.63) / 2 * 0.017 + (17.63 + 17.49) / 2 * 0.039) / 0.056
    assert rows["bayes-rays"]["psnr_area"] == pytest.approx(wanted)
    assert rows["paper"]["psnr_area"] is None
    at = {row["method"]: row["psnr_at_coverage"] for row in curves.compare([BAYES, FREE, PAPER], coverage=0.681)}
    assert at == {"bayes-rays": pytest.approx(17.893, abs=1e-3), "free-space": None, "paper": 17.01}


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6), st.integers(2, 9))
def test_area_is_the_integral_and_lies_between_the_extremes(seed, count):
    rng = np.random.default_rng(seed)
    pairs = list(zip(rng.permutation(np.arange(1, 60))[:count] / 60, rng.uniform(10, 30, count)))
    curve = _curve("a", pairs)
    low, high = curve.coverage[0], curve.coverage[-1]
    middle = (low + high) / 2
    fine = np.linspace(low, high, 20001)
    wanted = np.mean([(curve.at(a) + curve.at(b)) / 2 for a, b in zip(fine[::100], fine[100::100])])
    assert curve.area(low, high) == pytest.approx(wanted, abs=0.02)
    halves = curve.area(low, middle) + curve.area(middle, high)
    assert curve.area(low, high) == pytest.approx(halves / 2)
    assert curve.score.min() <= curve.area(low, high) <= curve.score.max()


def test_the_order_of_settings_does_not_matter_and_equal_coverages_count_once():
    pairs = [(0.5, 18.0), (0.9, 17.0), (0.5, 18.5), (0.7, 17.5), (0.9, 16.0)]
    curve = _curve("a", pairs)
    assert curve.coverage.tolist() == [0.5, 0.7, 0.9]
    assert curve.score.tolist() == [18.5, 17.5, 17.0]
    assert curve.knob.tolist() == [2, 3, 1]
    errors = _curve("a", pairs, higher_is_better=False)
    assert errors.score.tolist() == [18.0, 17.5, 16.0]
    assert _curve("a", pairs[::-1]).score.tolist() == curve.score.tolist()


def test_lower_is_better_turns_the_sign_of_ahead():
    curve = _curve("a", [(0.5, 0.1), (0.9, 0.3)], higher_is_better=False)
    point = Curve.create("p", _rows([(0.7, 0.25)]), higher_is_better=False)
    assert curves.against_points([curve, point])[0]["ahead"] == pytest.approx(0.05)


def test_undefined_settings_are_left_out_and_counted():
    curve = _curve("a", [(0.0, None), (0.5, 18.0), (0.9, float("nan")), (None, 3.0), (0.8, float("inf")), (0.7, 17.0)])
    assert curve.coverage.tolist() == [0.5, 0.7]
    assert curve.undefined == 4
    with pytest.raises(ValueError, match="'gone' has no row with a finite psnr and coverage"):
        _curve("gone", [(0.0, None)])


def test_curves_that_do_not_overlap_have_no_common_range():
    low, high = _curve("low", [(0.1, 20.0), (0.4, 19.0)]), _curve("high", [(0.6, 18.0), (0.9, 17.0)])
    assert curves.common_range([low, high]) is None
    rows = curves.compare([low, high])
    assert [row["psnr_at_coverage"] for row in rows] == [row["psnr_area"] for row in rows] == [None, None]
    assert curves.common_range([PAPER]) is None
    assert curves.compare([PAPER])[0]["at_coverage"] is None


def test_conventions_metrics_and_names_do_not_mix():
    other = Curve.create("other", _rows([(0.5, 18.0), (0.9, 17.0)], convention="nerfbaselines"))
    with pytest.raises(ValueError, match=r"'proper' \(row 'bayes-rays'\) and 'nerfbaselines' \(row 'other'\)"):
        curves.compare([BAYES, other])
    with pytest.raises(ValueError, match=r"Curve.create: conventions do not mix: 'a' .* and 'b'"):
        Curve.create("x", [{"coverage": 0.5, "psnr": 1.0, "convention": each} for each in "ab"])
    ssim = Curve.create("other", _rows([(0.5, 18.0), (0.9, 17.0)], ssim=0.5), metric="ssim")
    with pytest.raises(ValueError, match=r"one metric only, got 'psnr' \(curve 'bayes-rays'\) and 'ssim'"):
        curves.compare([BAYES, ssim])
    with pytest.raises(ValueError, match="different names"):
        curves.compare([BAYES, BAYES])
    with pytest.raises(ValueError, match="at least one"):
        curves.compare([])
    with pytest.raises(ValueError, match=r"coverage of 'a' must lie in \[0, 1\], got 54.7"):
        _curve("a", [(54.7, 17.97)])
    with pytest.raises(ValueError, match="low must be < high"):
        BAYES.area(0.7, 0.7)
    with pytest.raises(ValueError, match=r"compare: coverage must lie in \[0, 1\], got 70"):
        curves.compare([BAYES], coverage=70)


def test_cutting_keeps_the_surest():
    mask = np.array([[True, True, True, False], [True, True, False, False]])
    confidence = np.array([[0.1, 0.9, 0.5, np.nan], [0.5, 0.7, 1.0, 1.0]])
    assert curves.cut_to_coverage(mask, confidence, coverage=0.25).tolist() == [[0, 1, 0, 0], [0, 1, 0, 0]]
    # three of eight: of the two 0.5 the first stays; 0.49 of 8 pixels is 3 whole ones
    assert curves.cut_to_coverage(mask, confidence, coverage=0.49).tolist() == [[0, 1, 1, 0], [0, 1, 0, 0]]
    whole = curves.cut_to_coverage(mask, confidence, coverage=0.9)
    np.testing.assert_array_equal(whole, mask)
    assert whole is not mask
    assert not curves.cut_to_coverage(mask, confidence, coverage=0.0).any()


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), st.floats(0, 1))
def test_cuts_are_nested_and_of_the_asked_size(seed, coverage):
    rng = np.random.default_rng(seed)
    mask, confidence = rng.random((3, 5, 6)) < 0.7, np.round(rng.random((3, 5, 6)), 1)
    cut = curves.cut_to_coverage(mask, confidence, coverage=coverage)
    assert cut.sum() == min(int(coverage * 90 + 1e-9), mask.sum())
    assert not (cut & ~mask).any()
    assert not (curves.cut_to_coverage(mask, confidence, coverage=coverage / 2) & ~cut).any()
    if cut.any() and (mask & ~cut).any():
        assert confidence[cut].min() >= confidence[mask & ~cut].max()


def test_cutting_errors():
    mask = np.ones((2, 2), dtype=bool)
    with pytest.raises(ValueError, match="mask must be bool of the shape of confidence"):
        curves.cut_to_coverage(mask, np.ones((2, 3)), coverage=0.5)
    with pytest.raises(ValueError, match=r"coverage must lie in \[0, 1\], got 50"):
        curves.cut_to_coverage(mask, np.ones((2, 2)), coverage=50)
    with pytest.raises(ValueError, match="4 confidences in the mask are NaN"):
        curves.cut_to_coverage(mask, np.full((2, 2), np.nan), coverage=0.5)


def test_the_direction_of_a_metric_is_that_of_the_registry():
    rows = [{"coverage": 0.5, "disparity_mae": value, "convention": "proper"} for value in (0.3, 0.2)]
    curve = Curve.create("a", rows, metric="disparity_mae")
    assert not curve.higher_is_better
    assert curve.score.tolist() == [0.2]  # of one coverage the better counts
    other = [{**row, "own": row["disparity_mae"]} for row in rows]
    with pytest.raises(ValueError, match=r"key must be one of psnr, .* got 'own'"):
        Curve.create("a", other, metric="own")
    assert Curve.create("a", other, metric="own", higher_is_better=True).score.tolist() == [0.3]
