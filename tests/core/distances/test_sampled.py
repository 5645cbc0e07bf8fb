import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from unghost.core.distances import signed as sd
from unghost.core.distances.sampled import SampledDistance


def ball(radius=0.5, nodes=41, reach=0.8):
    axis = np.linspace(-reach, reach, nodes)
    lattice = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    return SampledDistance(sd.sphere(lattice, radius).astype(np.float32), np.full(3, -reach), axis[1] - axis[0])


def test_nodes_are_exact_and_between_them_it_is_linear():
    values = np.ones((3, 2, 4), dtype=np.float32) * np.arange(1, 5, dtype=np.float32)
    grid = SampledDistance(values, np.array([1.0, 0.0, -1.0]), 0.5)
    assert grid(np.array([1.5, 0.5, -0.5])) == 2.0
    np.testing.assert_allclose(grid(np.array([[1.2, 0.1, -0.75], [1.9, 0.4, 0.25]])), [1.5, 3.5])


def test_a_ball_is_a_ball():
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.8, 0.8, size=(4, 500, 3))
    error = ball()(points) - sd.sphere(points, 0.5)
    assert error.shape == (4, 500)
    near = np.abs(sd.sphere(points, 0.5)) < 0.2
    assert np.abs(error[near]).max() < 2e-3  # pitch^2 / (8 r) = 4e-4 a second derivative


@given(st.lists(st.floats(-5, 5), min_size=3, max_size=3))
def test_beyond_the_grid_it_never_reaches_past_the_surface(point):
    position = np.array([point])
    value, true = ball()(position)[0], sd.sphere(position, 0.5)[0]
    assert value <= true + 2e-2
    if np.abs(position).max() > 0.8:
        assert value > 0


def test_bound_holds_the_solid_and_scaling_scales():
    grid = ball()
    assert 0.5 <= grid.bound <= 0.6
    twice = grid.scaled(2.0)
    points = np.random.default_rng(1).uniform(-1.5, 1.5, size=(50, 3))
    np.testing.assert_allclose(twice(points), 2 * grid(points / 2), rtol=1e-6, atol=1e-7)
    assert twice.bound == pytest.approx(2 * grid.bound)
    empty = SampledDistance(np.ones((2, 2, 2), dtype=np.float32), np.zeros(3), 1.0)
    assert empty.bound == 0.0


@pytest.mark.parametrize(
    ("values", "pitch", "told"),
    [
        (np.ones((2, 2)), 1.0, "shape"),
        (np.ones((1, 2, 2)), 1.0, "2 nodes"),
        (np.full((2, 2, 2), np.nan), 1.0, "finite"),
        (np.ones((2, 2, 2)), 0.0, "pitch"),
        (-np.ones((2, 2, 2)), 1.0, "sides"),
    ],
)
def test_what_is_no_grid_is_refused(values, pitch, told):
    with pytest.raises(ValueError, match=told):
        SampledDistance(values.astype(np.float32), np.zeros(3), pitch)
    with pytest.raises(ValueError, match="factor"):
        ball().scaled(0.0)
