import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from unghost.fields.adapters.grids import cell_centers, cell_pitch, grid_density_fn

BOX = np.array([[-1.0, 0.0, 2.0], [1.0, 3.0, 4.0]])


def test_centres_and_pitch_by_hand():
    centers = cell_centers(BOX, (4, 6, 4))
    np.testing.assert_allclose(centers[0, 0, 0], [-0.75, 0.25, 2.25])
    np.testing.assert_allclose(centers[3, 5, 3], [0.75, 2.75, 3.75])
    assert cell_pitch(BOX, (4, 6, 4)) == pytest.approx(0.5)
    with pytest.raises(ValueError, match="cubic cells"):
        cell_pitch(BOX, (4, 4, 4))


def test_the_grid_gives_back_its_values_at_the_centres():
    grid = np.random.default_rng(0).random((4, 6, 4)).astype(np.float32)
    found = grid_density_fn(grid, BOX)(cell_centers(BOX, (4, 6, 4)))
    assert found.shape == (4, 6, 4, 1)
    np.testing.assert_allclose(found[..., 0], grid, atol=1e-5)


def test_against_scipys_interpolation():
    rng = np.random.default_rng(1)
    grid = rng.random((4, 6, 5)).astype(np.float32)
    points = rng.uniform(BOX[0], BOX[1], size=(500, 3))
    index = (points - BOX[0]) / (BOX[1] - BOX[0]) * grid.shape - 0.5
    expected = map_coordinates(grid, index.T, order=1, mode="nearest")
    np.testing.assert_allclose(grid_density_fn(grid, BOX)(points)[:, 0], expected, atol=1e-5)


def test_outside_is_empty_and_a_single_cell_is_constant():
    field = grid_density_fn(np.full((1, 1, 1), 7.0), BOX)
    points = np.array([[0.0, 1.0, 3.0], [-1.0, 0.0, 2.0], [-1.001, 0, 2], [0, 0, 5]])
    assert field(points)[:, 0].tolist() == [7.0, 7.0, 0.0, 0.0]
    assert field(np.zeros((0, 3))).shape == (0, 1)


def test_refusals():
    with pytest.raises(ValueError, match=r"density must have shape \(X, Y, Z\), got \(2, 2\)"):
        grid_density_fn(np.zeros((2, 2)), BOX)
    with pytest.raises(ValueError, match="min < max"):
        grid_density_fn(np.zeros((2, 2, 2)), BOX[::-1])
