import sys
from contextlib import contextmanager

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from unghost.cleaning.components import dilate, label_components


@contextmanager
def installed(scipy):
    """With scipy, or as on the base install without it."""
    with pytest.MonkeyPatch.context() as patch:
        if not scipy:
            patch.setitem(sys.modules, "scipy", None)
        yield


@pytest.fixture(params=[True, False], ids=["scipy", "numpy"])
def either(request):
    with installed(request.param):
        yield request.param


def test_the_block_can_fail():
    with installed(scipy=False), pytest.raises(ImportError):
        from scipy import ndimage as blocked  # noqa: F401


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    shape=st.tuples(*[st.integers(1, 9)] * 3),
    fill=st.floats(0, 1),
    connectivity=st.sampled_from([6, 26]),
    axes=st.permutations([0, 1, 2]),
)
def test_labels_are_the_same_with_and_without_scipy(seed, shape, fill, connectivity, axes):
    occupied = (np.random.default_rng(seed).random(shape) < fill).transpose(axes)  # of any memory layout
    structure = ndimage.generate_binary_structure(3, 1 if connectivity == 6 else 3)
    expected, expected_count = ndimage.label(occupied.copy(order="C"), structure)
    for scipy in (True, False):
        with installed(scipy):
            labels, count = label_components(occupied, connectivity=connectivity)
        assert count == expected_count
        assert labels.dtype == np.int64
        assert (labels == expected).all()
    first = [int(np.flatnonzero(labels == number)[0]) for number in range(1, count + 1)]
    assert first == sorted(first)
    assert (dilate(occupied) == ndimage.binary_dilation(occupied, ndimage.generate_binary_structure(3, 3))).all()


def test_a_long_snake_is_one_piece(either):
    snake = np.zeros((40, 40, 1), bool)
    snake[::2] = True
    snake[1::4, -1] = True
    snake[3::4, 0] = True
    assert label_components(snake)[1] == 1


def test_nothing_has_no_pieces(either):
    for shape in ((0, 3, 3), (4, 4, 4)):
        labels, count = label_components(np.zeros(shape, bool))
        assert count == 0
        assert labels.shape == shape
        assert not labels.any()


def test_diagonal_neighbours_touch_only_under_26(either):
    pair = np.zeros((2, 2, 2), bool)
    pair[0, 0, 0] = pair[1, 1, 1] = True
    assert label_components(pair, connectivity=6)[1] == 2
    assert label_components(pair)[1] == 1
    with pytest.raises(ValueError, match="connectivity must be 6 or 26, got 18"):
        label_components(pair, connectivity=18)
