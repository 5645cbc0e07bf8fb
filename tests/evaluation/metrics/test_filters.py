import numpy as np
import pytest
from scipy import ndimage

from unghost.evaluation.metrics.filters import correlate, gaussian_taps

SCIPY = {"symmetric": "reflect", "reflect": "mirror", "edge": "nearest", "constant": "constant"}


def test_taps_by_hand():
    # exp(0), exp(-1/2), exp(-2) about the middle of width 1
    wanted = np.array([np.exp(-2), np.exp(-0.5), 1, np.exp(-0.5), np.exp(-2)])
    assert gaussian_taps(2, 1.0) == pytest.approx(wanted / wanted.sum())
    assert gaussian_taps(0, 3.0).tolist() == [1.0]


@pytest.mark.parametrize("border", SCIPY)
def test_equals_scipy(border):
    rng = np.random.default_rng(0)
    image, rows, columns = rng.random((9, 12, 2)), rng.random(7), rng.random(5)
    found = correlate(image, rows, columns, border=border)
    for channel in range(2):
        down = ndimage.correlate1d(image[..., channel], rows, axis=0, mode=SCIPY[border])
        np.testing.assert_allclose(found[..., channel], ndimage.correlate1d(down, columns, axis=1, mode=SCIPY[border]))
    inside = correlate(image, rows, columns, border="valid")
    assert inside.shape == (3, 8, 2)
    np.testing.assert_allclose(inside, found[3:-3, 2:-2])
