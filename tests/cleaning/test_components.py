import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from unghost.cleaning.components import dilate, label_components


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    shape=st.tuples(*[st.integers(1, 9)] * 3),
    fill=st.floats(0, 1),
    connectivity=st.sampled_from([6, 26]),
)
def test_labels_are_scipys(seed, shape, fill, connectivity):
    occupied = np.random.default_rng(seed).random(shape) < fill
    structure = ndimage.generate_binary_structure(3, 1 if connectivity == 6 else 3)
    expected, expected_count = ndimage.label(occupied, structure)
    labels, count = label_components(occupied, connectivity=connectivity)
    assert count == expected_count
    assert (labels == expected).all()
    assert (dilate(occupied) == ndimage.binary_dilation(occupied, ndimage.generate_binary_structure(3, 3))).all()


def test_a_long_snake_is_one_piece():
    snake = np.zeros((40, 40, 1), bool)
    snake[::2] = True
    snake[1::4, -1] = True
    snake[3::4, 0] = True
    assert label_components(snake)[1] == 1


def test_diagonal_neighbours_touch_only_under_26():
    pair = np.zeros((2, 2, 2), bool)
    pair[0, 0, 0] = pair[1, 1, 1] = True
    assert label_components(pair, connectivity=6)[1] == 2
    assert label_components(pair)[1] == 1
    with pytest.raises(ValueError, match="connectivity must be 6 or 26, got 18"):
        label_components(pair, connectivity=18)
