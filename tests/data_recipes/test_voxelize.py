import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from unghost.data_recipes.voxelize import voxelize_triangles, voxelize_triangles_slowly


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**31), resolution=st.integers(1, 7), count=st.integers(0, 4),
    reach=st.sampled_from([0.01, 0.2, 1.0, 6.0]), kind=st.sampled_from(["plain", "needle", "point", "upright"]),
)  # fmt: skip
def test_equals_the_thirteen_axes_voxel_by_voxel(seed, resolution, count, reach, kind):
    rng = np.random.default_rng(seed)
    triangles = rng.normal(size=(count, 1, 3)) * 0.3 + rng.normal(size=(count, 3, 3)) * reach
    if kind == "needle":
        triangles[:, 2] = triangles[:, 1]
    if kind == "point":
        triangles[:] = triangles[:, :1]
    if kind == "upright":
        triangles[:, :, 0] = triangles[:, :1, 0]
    np.testing.assert_array_equal(
        voxelize_triangles(triangles, resolution), voxelize_triangles_slowly(triangles, resolution)
    )


def test_axis_aligned_square_fills_one_layer():
    z = 0.5 / 8 - 0.5 + 3 / 8  # centre of layer 3
    corners = np.array([[-1, -1, z], [1, -1, z], [1, 1, z], [-1, 1, z]])
    occupancy = voxelize_triangles(corners[[[0, 1, 2], [0, 2, 3]]], 8)
    assert occupancy[:, :, 3].all()
    assert occupancy.sum() == 64


def test_small_triangle_marks_its_own_voxel():
    center = (np.array([5, 2, 7]) + 0.5) / 10 - 0.5
    triangle = center + np.array([[0.01, 0, 0], [0, 0.01, 0], [0, 0, 0.01]])
    assert np.argwhere(voxelize_triangles(triangle[None], 10)).tolist() == [[5, 2, 7]]


def test_points_on_the_triangles_are_covered_and_order_does_not_matter():
    rng = np.random.default_rng(0)
    triangles = rng.uniform(-0.5, 0.5, size=(50, 1, 3)) + rng.normal(size=(50, 3, 3)) * 0.2
    occupancy = voxelize_triangles(triangles)
    weights = rng.dirichlet(np.ones(3), size=(50, 2000))
    points = np.einsum("fpc,fcx->fpx", weights, triangles).reshape(-1, 3)
    points = points[(np.abs(points) < 0.5).all(axis=1)]
    index = np.floor((points + 0.5) * 32).astype(int)
    assert occupancy[tuple(index.T)].all()
    np.testing.assert_array_equal(occupancy, voxelize_triangles(triangles[::-1, [1, 2, 0]]))


def test_outside_and_empty():
    assert not voxelize_triangles(np.zeros((0, 3, 3))).any()
    assert not voxelize_triangles(np.ones((1, 3, 3)) * 2 + np.eye(3)).any()


def test_bad_triangles_are_refused():
    with pytest.raises(ValueError, match=r"must have shape \(F, 3, 3\), got \(3, 3\)"):
        voxelize_triangles(np.zeros((3, 3)))
    with pytest.raises(ValueError, match="must be finite, got 9 other"):
        voxelize_triangles(np.full((1, 3, 3), np.nan))
    with pytest.raises(ValueError, match="resolution must be >= 1, got 0"):
        voxelize_triangles(np.zeros((1, 3, 3)), 0)
