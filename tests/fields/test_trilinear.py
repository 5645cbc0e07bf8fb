import sys

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from unghost.fields.trilinear import trilinear


def table_and_points(resolution, channels, count, dtype=torch.float32, seed=0):
    generator = torch.Generator().manual_seed(seed)
    table = torch.randn(resolution**3, channels, generator=generator, dtype=dtype)
    points = torch.rand(count, 3, generator=generator, dtype=dtype) * (resolution - 1)
    return table.requires_grad_(), points


def by_grid_sample(table, points, resolution):
    """torch's own lookup, which orders the last axis of its coordinates first."""
    volume = table.T.reshape(1, -1, resolution, resolution, resolution)
    grid = (points / (resolution - 1) * 2 - 1).flip(-1).view(1, -1, 1, 1, 3)
    return torch.nn.functional.grid_sample(volume, grid, align_corners=True)[0, :, :, 0, 0].T


@pytest.fixture(params=["scipy", "index_add"])
def backward_path(request, monkeypatch):
    if request.param == "index_add":
        monkeypatch.setitem(sys.modules, "scipy.sparse", None)  # the import then raises ImportError
    else:
        pytest.importorskip("scipy.sparse")
    return request.param


@pytest.mark.parametrize(("resolution", "channels"), [(2, 1), (5, 3), (9, 12)])
def test_value_and_gradient_equal_grid_sample(resolution, channels, backward_path):
    table, points = table_and_points(resolution, channels, 200)
    oracle = table.detach().clone().requires_grad_()
    weight = torch.randn(200, channels, generator=torch.Generator().manual_seed(1))
    value, expected = trilinear(table, points, resolution), by_grid_sample(oracle, points, resolution)
    torch.testing.assert_close(value, expected, atol=1e-5, rtol=1e-5)
    (value * weight).sum().backward()
    (expected * weight).sum().backward()
    torch.testing.assert_close(table.grad, oracle.grad, atol=1e-5, rtol=1e-5)


def test_gradient_equals_finite_differences(backward_path):
    table, points = table_and_points(3, 2, 7, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda values: trilinear(values, points, 3), (table,))


def test_both_gradients_are_the_same(monkeypatch):
    pytest.importorskip("scipy.sparse")
    grads = []
    for blocked in (False, True):
        if blocked:
            monkeypatch.setitem(sys.modules, "scipy.sparse", None)
        table, points = table_and_points(4, 2, 500)  # 500 points on 64 nodes: many duplicates
        trilinear(table, points, 4).square().sum().backward()
        grads.append(table.grad)
    torch.testing.assert_close(*grads, atol=1e-4, rtol=1e-5)


def test_nodes_return_their_own_row():
    table, _ = table_and_points(4, 2, 1)
    nodes = torch.cartesian_prod(*[torch.arange(4.0)] * 3)
    torch.testing.assert_close(trilinear(table, nodes, 4), table, atol=1e-6, rtol=0)


@given(st.lists(st.floats(-3.0, 6.0, width=32), min_size=3, max_size=3))
@settings(max_examples=50, deadline=None)
def test_a_linear_function_is_exact_inside_and_outside(position):
    nodes = torch.cartesian_prod(*[torch.arange(4.0, dtype=torch.float64)] * 3)
    slope = torch.tensor([0.5, -2.0, 3.0], dtype=torch.float64)
    table = (nodes @ slope + 1.0)[:, None]
    point = torch.tensor([position], dtype=torch.float64)
    np.testing.assert_allclose(trilinear(table, point, 4).item(), (point @ slope + 1.0).item(), atol=1e-9)


def test_empty_batch_keeps_the_graph():
    table, points = table_and_points(3, 5, 0)
    value = trilinear(table, points, 3)
    assert value.shape == (0, 5)
    value.sum().backward()
    assert table.grad.shape == table.shape
    assert not table.grad.any()


def test_nan_gives_nan_and_leaves_its_neighbours_alone():
    table, points = table_and_points(64, 1, 3)
    expected = trilinear(table, points, 64)
    points[1, 2] = float("nan")
    value = trilinear(table, points, 64)
    assert value[1].isnan().all()
    torch.testing.assert_close(value[[0, 2]], expected[[0, 2]])


def test_no_gradient_to_coordinates_and_arguments_unchanged():
    table, points = table_and_points(3, 1, 10)
    kept = points.clone()
    points.requires_grad_()
    trilinear(table, points, 3).sum().backward()
    assert points.grad is None
    torch.testing.assert_close(points.detach(), kept, atol=0, rtol=0)


def test_wrong_table_is_refused():
    with pytest.raises(ValueError, match=r"trilinear: table must have 27 rows for resolution 3, got 26"):
        trilinear(torch.zeros(26, 1), torch.zeros(1, 3), 3)
