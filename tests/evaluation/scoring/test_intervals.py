import numpy as np
import pytest

from unghost.evaluation.scoring.intervals import bootstrap_difference, bootstrap_mean, bootstrap_scenes, defined


def test_equals_a_loop_over_resamples():
    values = np.random.default_rng(1).normal(size=9)
    found = bootstrap_mean(values, np.random.default_rng(7), resamples=200, level=0.9)
    rng, means = np.random.default_rng(7), []
    for _ in range(200):
        total = 0.0
        for index in rng.integers(0, 9, 9):
            total += values[index]
        means.append(total / 9)
    means.sort()
    assert found.mean == pytest.approx(values.mean())
    assert (found.low, found.high) == pytest.approx((means[10], means[189]))  # 5 % of 200 fall off at either end
    assert (found.level, found.count, found.undefined) == (0.9, 9, 0)


def test_the_generator_alone_decides():
    values = np.random.default_rng(1).normal(size=9)
    first, again, other = (bootstrap_mean(values, np.random.default_rng(seed)) for seed in (0, 0, 1))
    assert first == again
    assert first.mean == other.mean
    assert (first.low, first.high) != (other.low, other.high)


def test_the_interval_holds_the_truth_about_as_often_as_it_says():
    rng = np.random.default_rng(0)
    hits = 0
    for _ in range(150):
        found = bootstrap_mean(rng.normal(3.0, 1.0, size=40), rng, level=0.9, resamples=150)
        hits += found.low <= 3.0 <= found.high
    assert 120 <= hits <= 147  # 90 % of 150 is 135, standard deviation 3.7


def test_undefined_values_are_left_out_and_counted():
    found = bootstrap_mean([1.0, None, 3.0, float("nan")], np.random.default_rng(0))
    assert (found.mean, found.count, found.undefined) == (2.0, 2, 2)
    assert defined([None, float("nan")])[1] == 2


@pytest.mark.parametrize(("values", "mean"), [([], None), ([None], None), ([4.0], 4.0), ([4.0, None], 4.0)])
def test_fewer_than_two_values_have_no_interval(values, mean):
    found = bootstrap_mean(values, np.random.default_rng(0))
    assert (found.mean, found.low, found.high) == (mean, None, None)
    scenes = bootstrap_scenes({"a": values}, np.random.default_rng(0))
    assert (scenes.mean, scenes.low, scenes.high) == (mean, None, None)


def test_infinite_values_give_no_nan():
    found = bootstrap_mean([float("inf"), 20.0, 21.0], np.random.default_rng(0))
    assert found.mean == found.high == float("inf")
    assert 20 <= found.low <= 21
    difference = bootstrap_difference([float("inf"), 2.0, 3.0], [float("inf"), 1.0, 1.0], np.random.default_rng(0))
    assert (difference.mean, difference.count, difference.undefined) == (1.5, 2, 1)


def test_scenes_weigh_the_same_whatever_their_number_of_images():
    scenes = {"long": [1.0] * 8, "short": [4.0, None]}
    assert bootstrap_scenes(scenes, np.random.default_rng(0)).mean == 2.5
    pooled = bootstrap_scenes(scenes, np.random.default_rng(0), mean_over="images")
    assert pooled.mean == pytest.approx(12 / 9)
    assert (pooled.count, pooled.undefined) == (9, 1)


def test_two_equal_scenes_resample_to_either():
    # no spread within a scene: a resample is both of the first, one of each, or both of the second
    found = bootstrap_scenes({"a": [1.0, 1.0], "b": [3.0, 3.0]}, np.random.default_rng(0))
    assert (found.low, found.mean, found.high) == (1.0, 2.0, 3.0)
    one = bootstrap_scenes({"a": [1.0, 1.0, 1.0]}, np.random.default_rng(0))
    assert (one.low, one.mean, one.high) == (1.0, 1.0, 1.0)


@pytest.mark.parametrize("mean_over", ["scenes", "images"])
def test_scenes_equal_a_loop_over_resamples(mean_over):
    """Other draws, the same distribution: both ends within the noise of 4,000 resamples."""
    draws = np.random.default_rng(2)
    scenes = {name: list(draws.normal(mean, 1.0, size)) for name, mean, size in (("a", 0, 5), ("b", 2, 9), ("c", 3, 2))}
    found = bootstrap_scenes(scenes, np.random.default_rng(0), resamples=4000, level=0.8, mean_over=mean_over)
    rng, means = np.random.default_rng(1), []
    for _ in range(4000):
        parts = []
        for index in rng.integers(0, 3, 3):
            values = scenes["abc"[index]]
            parts.append([values[image] for image in rng.integers(0, len(values), len(values))])
        flat = [value for part in parts for value in part]
        means.append(np.mean([np.mean(part) for part in parts] if mean_over == "scenes" else flat))
    means.sort()
    assert (found.low, found.high) == pytest.approx((means[400], means[3599]), abs=0.08)


def test_an_undefined_scene_takes_no_part():
    found = bootstrap_scenes({"a": [1.0, 3.0], "gone": [None, None]}, np.random.default_rng(0))
    assert (found.mean, found.count, found.undefined) == (2.0, 2, 2)


def test_pairing_sees_a_small_difference_through_a_large_spread():
    rng = np.random.default_rng(0)
    hard = rng.normal(18, 4, size=30)
    better = hard + 0.3 + rng.normal(scale=0.1, size=30)
    paired = bootstrap_difference(better, hard, np.random.default_rng(0))
    assert 0 < paired.low < 0.3 < paired.high + 0.1
    apart = [bootstrap_mean(values, np.random.default_rng(0)) for values in (better, hard)]
    assert apart[0].low < apart[1].high  # unpaired, the two intervals overlap


def test_errors():
    rng = np.random.default_rng(0)
    with pytest.raises(ValueError, match=r"bootstrap_mean: level must lie in \(0, 1\), got 95"):
        bootstrap_mean([1.0], rng, level=95)
    with pytest.raises(ValueError, match="resamples must be >= 1, got 0"):
        bootstrap_scenes({"a": [1.0]}, rng, resamples=0)
    with pytest.raises(ValueError, match="mean_over must be scenes or images, got 'pixels'"):
        bootstrap_scenes({"a": [1.0]}, rng, mean_over="pixels")
    with pytest.raises(ValueError, match="must pair up, got 1 and 2"):
        bootstrap_difference([1.0], [1.0, 2.0], rng)
