import numpy as np
import pytest
from unghost_tests import textured_room


@pytest.fixture
def pattern():
    """Two images ``(48, 64, 3)`` with waves, edges and flat squares, from formulas alone."""
    row, column = np.mgrid[0:48, 0:64]
    checks = (row // 8 + column // 8) % 2
    wave = (np.cos(0.17 * column) + 1) / 2
    target = np.stack([(np.sin(0.31 * row) + 1) / 2, wave, checks * 0.8 + 0.1], axis=-1)
    preds = np.stack([(np.sin(0.31 * row + 0.4) + 1) / 2, wave * 0.9, checks * 0.6 + 0.2], axis=-1)
    return preds, target


@pytest.fixture(scope="session")
def room():
    """The module of the textured room."""
    return textured_room
