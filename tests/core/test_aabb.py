import numpy as np
import pytest

from unghost.core.aabb import as_aabb, contains, scene_extent


def test_box_is_a_copy_in_float64():
    given = np.array([[0, 0, 0], [1, 2, 3]], dtype=np.float32)
    box = as_aabb(given)
    box[0, 0] = -5
    assert box.dtype == np.float64
    assert given[0, 0] == 0


def test_extent_is_the_longest_side():
    assert scene_extent([[-1, 0, 0], [1, 5, 3]]) == 5.0


def test_contains_is_closed():
    points = np.array([[0.0, 0, 0], [1, 1, 1], [0.5, 0.5, 1.0001], [np.nan, 0, 0]])
    assert contains([[0, 0, 0], [1, 1, 1]], points).tolist() == [True, True, False, False]


@pytest.mark.parametrize(
    ("box", "words"),
    [
        ([0, 1], r"clean: aabb must have shape \(2, 3\), got \(2,\)"),
        ([[0, 0, 0], [1, np.inf, 1]], "must be finite"),
        ([[0, 2, 0], [1, 2, 1]], "min < max on every axis, y fails"),
    ],
)
def test_refusals_name_caller_and_rule(box, words):
    with pytest.raises(ValueError, match=words):
        as_aabb(box, caller="clean")
