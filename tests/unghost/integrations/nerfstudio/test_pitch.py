"""The side of nerfacto's hash cells."""

import numpy as np
import pytest

from unghost.integrations.nerfstudio import hash_pitch, surface_cells

BOX = np.array([[-1.0] * 3, [1.0] * 3])


def contracted(places):
    norm = np.maximum(np.abs(places).max(axis=-1, keepdims=True), 1.0)
    return (2 - 1 / norm) * places / norm


def test_in_a_box_that_is_not_contracted_it_is_a_number():
    assert hash_pitch(2048, BOX, contracted=True) == 4 / 2048
    assert hash_pitch(128, BOX * 3, contracted=False) == pytest.approx(6 / 128)
    assert hash_pitch(10, np.array([[0, 0, 0], [8.0, 1.0, 1.0]]), contracted=False) == pytest.approx(0.2)


def test_beyond_it_is_the_side_of_a_cube_of_a_cells_volume():
    places = np.array([[0.3, 0.2, -0.9], [3.0, 0.5, -0.4], [-1.2, 0.7, 5.0]])
    pitch = hash_pitch(100, BOX * 8, contracted=True)
    step = 1e-5
    for place, found in zip(places, pitch(places)):
        shifts = np.eye(3) * step
        columns = (contracted(place + shifts) - contracted(place - shifts)) / (2 * step)
        assert found == pytest.approx(4 / 100 / np.cbrt(abs(np.linalg.det(columns))), rel=1e-6)


def test_no_cells_are_refused():
    with pytest.raises(ValueError, match="hash_pitch: max_res must be >= 1, got 0"):
        hash_pitch(0, BOX, contracted=True)


def test_surfaces_fit_the_table_at_the_level_that_is_measured():
    for size in (3, 15, 17, 19, 22):
        cells = surface_cells(size)
        assert 8 * cells**2 <= 2**size < 8 * (cells + 1) ** 2
    assert hash_pitch(min(2048, surface_cells(19)), BOX, contracted=True) == 2 / 128  # as for a field of no known cells
    with pytest.raises(ValueError, match="surface_cells: log2_hashmap_size must be >= 3, got 2"):
        surface_cells(2)
