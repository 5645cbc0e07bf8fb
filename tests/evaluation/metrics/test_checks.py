import numpy as np
import pytest

from unghost.evaluation.metrics.checks import check_pair, check_range, choose, picked


def test_choices_are_listed():
    assert choose("f", "kind", "b", {"a": 1, "b": 2}) == 2
    with pytest.raises(ValueError, match="f: kind must be one of a, b, got 'c'"):
        choose("f", "kind", "c", {"a": 1, "b": 2})


def test_what_is_picked_must_be_finite():
    values = np.array([1.0, np.nan, np.inf])
    assert picked("f", values, np.array([True, False, False])).tolist() == [1.0]
    with pytest.raises(ValueError, match="f: 2 unmasked values are NaN or infinite"):
        picked("f", values, np.array([True, True, True]))


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf])
def test_a_range_is_finite_and_positive(value):
    with pytest.raises(ValueError, match="f: data_range must be finite and > 0"):
        check_range("f", value)


def test_pairs():
    image, mask = np.zeros((2, 3, 1)), np.ones((2, 3), dtype=bool)
    check_pair("f", image, image, mask, channels=True)
    check_pair("f", image[..., 0], image[..., 0], mask, channels=False)
    with pytest.raises(ValueError, match=r"f: preds must have shape \(H, W\), got \(2, 3, 1\)"):
        check_pair("f", image, image, mask, channels=False)
    with pytest.raises(ValueError, match=r"f: mask must be bool of shape \(2, 3\), got bool \(3, 2\)"):
        check_pair("f", image, image, mask.T, channels=True)
