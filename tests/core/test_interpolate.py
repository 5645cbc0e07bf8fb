import itertools

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import map_coordinates

from unghost.core.interpolate import corner_weights, interpolate_grid, lower_nodes, trilinear_corners

SHAPES = [(2, 2, 2), (4, 5, 3), (1, 3, 2), (1, 1, 1)]
LIBRARIES = [np.asarray, torch.as_tensor]


def slow_twin(values, position):
    """The interpolant at one position by its definition: one loop over corners, Python numbers."""
    total = 0.0
    within = [min(max(float(c), 0.0), n - 1.0) for c, n in zip(position, values.shape)]
    for corner in itertools.product((0, 1), repeat=3):
        weight, node = 1.0, []
        for place, upper, length in zip(within, corner, values.shape):
            lower = min(int(place), max(length - 2, 0))
            weight *= place - lower if upper else 1.0 - (place - lower)
            node.append(min(lower + upper, length - 1))
        total += weight * float(values[tuple(node)])
    return total


def grid_and_positions(shape, count=60, seed=0):
    rng = np.random.default_rng(seed)
    return rng.normal(size=shape), rng.uniform(-1.5, np.array(shape[:3]) + 0.5, size=(count, 3))


@pytest.mark.parametrize("library", LIBRARIES)
@pytest.mark.parametrize("shape", SHAPES)
def test_against_the_slow_twin_inside_and_beyond(shape, library):
    values, positions = grid_and_positions(shape)
    result = interpolate_grid(library(values), library(positions))
    expected = [slow_twin(values, position) for position in positions]
    np.testing.assert_allclose(np.asarray(result), expected, atol=1e-14)


def test_against_scipy():
    values, positions = grid_and_positions((6, 4, 5))
    expected = map_coordinates(values, positions.T, order=1, mode="nearest")
    np.testing.assert_allclose(interpolate_grid(values, positions), expected, atol=1e-13)


@pytest.mark.parametrize("library", LIBRARIES)
def test_channels_are_interpolated_one_by_one(library):
    values, positions = grid_and_positions((4, 5, 3, 2))
    positions = library(positions[:, :3].reshape(3, 20, 3))
    result = interpolate_grid(library(values), positions)
    assert result.shape == (3, 20, 2)
    for channel in range(2):
        single = interpolate_grid(library(np.ascontiguousarray(values[..., channel])), positions)
        np.testing.assert_array_equal(np.asarray(result[..., channel]), np.asarray(single))


def test_known_value_by_hand():
    values = np.arange(8.0).reshape(2, 2, 2)  # the value is 4 x + 2 y + z
    assert interpolate_grid(values, np.array([0.25, 0.5, 0.75])) == 4 * 0.25 + 2 * 0.5 + 0.75
    assert interpolate_grid(values, np.array([-3.0, 0.5, 9.0])) == 2 * 0.5 + 1.0
    index, weights = trilinear_corners(np.array([0.25, 0.5, 0.75]), (2, 2, 2))
    assert index.tolist() == list(range(8))  # 000, 001, .., 111 of xyz
    np.testing.assert_allclose(weights[[0, 1, 7]], [0.75 * 0.5 * 0.25, 0.75 * 0.5 * 0.75, 0.25 * 0.5 * 0.75])


@given(st.integers(0, 2**32), st.tuples(*[st.integers(1, 6)] * 3))
@settings(max_examples=40, deadline=None)
def test_nodes_give_back_their_own_values(seed, shape):
    values = np.random.default_rng(seed).normal(size=shape).astype(np.float32)
    nodes = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1)
    for library in LIBRARIES:
        result = interpolate_grid(library(values), library(nodes.astype(np.float32)))
        np.testing.assert_array_equal(np.asarray(result), values)


@given(st.lists(st.floats(-4.0, 7.0), min_size=3, max_size=3))
@settings(max_examples=50, deadline=None)
def test_corners_extrapolate_a_linear_function_exactly(position):
    slope, shape = np.array([0.5, -2.0, 3.0]), (4, 2, 3)
    values = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1) @ slope
    for library in LIBRARIES:
        index, weights = map(np.asarray, trilinear_corners(library(np.array([position])), shape))
        assert weights.sum() == pytest.approx(1.0, abs=1e-9)
        np.testing.assert_allclose((values.reshape(-1)[index] * weights).sum(), position @ slope, atol=1e-9)


def test_corners_and_interpolation_agree_bit_for_bit_within_the_grid():
    values, positions = grid_and_positions((4, 5, 3))
    positions = np.clip(positions, 0.0, np.array(values.shape) - 1.0)
    index, weights = trilinear_corners(positions, values.shape)
    total = np.zeros(len(positions))
    for corner in range(8):
        total += weights[:, corner] * values.reshape(-1)[index[:, corner]]
    np.testing.assert_array_equal(interpolate_grid(values, positions), total)


def test_gradients_equal_finite_differences():
    values, positions = grid_and_positions((3, 4, 2), count=8)
    positions = np.clip(positions, 0.1, None)
    assert (np.abs(positions - np.rint(positions)) > 1e-3).all()  # no kink at a node
    tensors = [torch.as_tensor(array).requires_grad_() for array in (values, positions)]
    assert torch.autograd.gradcheck(interpolate_grid, tensors)
    assert torch.autograd.gradcheck(lambda place: trilinear_corners(place, (3, 4, 2))[1], tensors[1:])


def test_gradient_beyond_the_grid_is_zero_and_reaches_the_nearest_node():
    values, place = torch.zeros(2, 2, 2, requires_grad=True), torch.tensor([[-1.0, 5.0, 0.5]], requires_grad=True)
    interpolate_grid(values, place).sum().backward()
    assert place.grad[0, :2].tolist() == [0.0, 0.0]
    assert values.grad[0, 1].tolist() == [0.5, 0.5]
    assert values.grad.sum() == 1.0


@pytest.mark.parametrize("library", LIBRARIES)
def test_dtypes(library):
    values, positions = (array.astype(np.float32) for array in grid_and_positions((4, 5, 3)))
    place = library(positions.astype(np.float64))
    double = interpolate_grid(library(values), place, dtype=place.dtype)
    assert interpolate_grid(library(values), place).dtype == library(values).dtype
    assert double.dtype == place.dtype
    index, weights = trilinear_corners(place, (4, 5, 3))
    assert weights.dtype == place.dtype
    assert str(index.dtype).endswith("int64" if library is np.asarray else "int32")
    assert str(trilinear_corners(place, (2**11, 2**11, 2**10))[0].dtype).endswith("int64")


@pytest.mark.parametrize("library", LIBRARIES)
def test_values_that_are_not_finite(library):
    values, positions = library(np.ones((3, 3, 3))), np.ones((4, 3))
    positions[1, 2], positions[2], positions[3, 0] = np.nan, np.inf, -np.inf
    place = library(positions)
    np.testing.assert_array_equal(np.asarray(interpolate_grid(values, place)), [1.0, np.nan, 1.0, 1.0])
    index, weights = trilinear_corners(place[1], (3, 3, 3))
    assert 0 <= index.min() <= index.max() < 27
    assert np.isnan(np.asarray(weights)).all()


@pytest.mark.parametrize("library", LIBRARIES)
def test_empty_batches_and_inputs_unchanged(library):
    values, positions = grid_and_positions((4, 5, 3))
    copies = values.copy(), positions.copy()
    interpolate_grid(library(values), library(positions))
    trilinear_corners(library(positions), (4, 5, 3))
    np.testing.assert_array_equal(values, copies[0])
    np.testing.assert_array_equal(positions, copies[1])
    assert interpolate_grid(library(values), library(np.zeros((0, 3)))).shape == (0,)
    assert [part.shape for part in trilinear_corners(library(np.zeros((0, 3))), (4, 5, 3))] == [(0, 8), (0, 8)]


def test_lower_nodes_by_hand():
    nodes, shares = lower_nodes([np.array([-0.5, 0.0, 1.75, 2.0, 7.0])] * 3, (3, 3, 1))
    assert nodes[0].tolist() == [0, 0, 1, 1, 1]
    assert shares[0].tolist() == [-0.5, 0.0, 0.75, 1.0, 6.0]
    assert nodes[2].tolist() == [0] * 5
    total = sum(corner_weights([share[:4] for share in shares]))
    np.testing.assert_allclose(total, 1.0)


def test_refusals():
    grid, place = np.zeros((2, 2, 2)), np.zeros((5, 3))
    for wrong in (np.zeros((2, 2)), np.zeros((2, 0, 2)), np.zeros((2,) * 5)):
        with pytest.raises(ValueError, match=r"interpolate_grid: values must have shape \(X, Y, Z\) or"):
            interpolate_grid(wrong, place)
    with pytest.raises(ValueError, match=r"interpolate_grid: coordinates must have shape \(..., 3\), got \(5, 2\)"):
        interpolate_grid(grid, place[:, :2])
    with pytest.raises(TypeError, match="must both be numpy arrays or both be tensors"):
        interpolate_grid(torch.as_tensor(grid), place)
