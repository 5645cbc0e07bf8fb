import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from unghost.data_recipes.meshes import voxels as module
from unghost.data_recipes.meshes.voxels import voxelize_batch, voxelize_triangles, voxelize_triangles_slowly


@settings(max_examples=150, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    resolution=st.integers(1, 20),
    count=st.integers(0, 4),
    reach=st.sampled_from([0.01, 0.2, 1.0, 6.0]),
    kind=st.sampled_from(["plain", "needle", "point", "upright", "line"]),
)
def test_equals_the_thirteen_axes_voxel_by_voxel(seed, resolution, count, reach, kind):
    rng = np.random.default_rng(seed)
    triangles = rng.normal(size=(count, 1, 3)) * 0.3 + rng.normal(size=(count, 3, 3)) * reach
    if kind == "needle":
        triangles[:, 2] = triangles[:, 1]
    if kind == "point":
        triangles[:] = triangles[:, :1]
    if kind == "line":  # no area but for rounding, and no two corners alike
        triangles[:, 2] = triangles[:, 0] + 0.3 * (triangles[:, 1] - triangles[:, 0])
    if kind == "upright":
        triangles[:, :, 0] = triangles[:, :1, 0]
    np.testing.assert_array_equal(
        voxelize_triangles(triangles, resolution), voxelize_triangles_slowly(triangles, resolution)
    )


@settings(max_examples=150, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    resolution=st.sampled_from([1, 2, 8, 16]),
    count=st.integers(1, 4),
    step=st.sampled_from([2, 8, 16, 32]),
    reach=st.integers(1, 3),
)
def test_ties_on_faces_edges_and_corners_of_voxels_are_exact(seed, resolution, count, step, reach):
    """Corners on a lattice that voxel faces and centres lie on: touching is everywhere, and always counts."""
    triangles = np.random.default_rng(seed).integers(-reach * step, reach * step + 1, size=(count, 3, 3)) / (2 * step)
    np.testing.assert_array_equal(
        voxelize_triangles(triangles, resolution), voxelize_triangles_slowly(triangles, resolution)
    )


def test_a_triangle_in_the_face_between_two_voxels_marks_both():
    triangle = np.array([[[0.0, 0.05, 0.05], [0.0, 0.2, 0.05], [0.0, 0.05, 0.2]]])  # the plane x = 0
    assert np.argwhere(voxelize_triangles(triangle, 4)).tolist() == [[1, 2, 2], [2, 2, 2]]


def test_a_point_at_a_corner_of_voxels_marks_all_eight_and_at_a_corner_of_the_cube_one():
    assert voxelize_triangles(np.zeros((1, 3, 3)), 4).sum() == 8
    assert np.argwhere(voxelize_triangles(np.full((1, 3, 3), 0.5), 4)).tolist() == [[3, 3, 3]]
    assert not voxelize_triangles(np.full((1, 3, 3), 0.5 + 1e-12), 4).any()


def test_a_slanted_edge_through_a_corner_touches_and_just_beyond_it_does_not():
    """The plane x + y = 0 seen along z: voxels off the diagonal touch it in one edge, and count."""
    touching = np.array([[[-1.0, 1, 0.1], [1, -1, 0.1], [0, 0, 0.1]]])
    columns = voxelize_triangles(touching, 4)[:, :, 2]
    i, j = np.indices((4, 4))
    np.testing.assert_array_equal(columns, abs(i + j - 3) <= 1)
    beyond = voxelize_triangles(touching + np.array([1e-9, 0, 0]), 4)[:, :, 2]
    np.testing.assert_array_equal(beyond, (i + j == 3) | (i + j == 4))


@pytest.mark.parametrize("block", [1, 50, 1 << 16])
def test_batch_equals_one_by_one_whatever_the_block(monkeypatch, block):
    monkeypatch.setattr(module, "_BLOCK", block)
    rng = np.random.default_rng(3)
    triangles = rng.normal(size=(90, 1, 3)) * 0.2 + rng.normal(size=(90, 3, 3)) * 0.1
    cubes = rng.integers(0, 6, size=90) * 2  # the odd ones stay empty
    batch = voxelize_batch(triangles, cubes, 12, resolution=16)
    for cube in range(12):
        np.testing.assert_array_equal(batch[cube], voxelize_triangles(triangles[cubes == cube], 16))
    assert batch[::2].any(axis=(1, 2, 3)).all()


def test_bad_batches_are_refused():
    triangles = np.zeros((2, 3, 3))
    assert voxelize_batch(triangles[:0], np.zeros(0, dtype=int), 0).shape == (0, 32, 32, 32)
    with pytest.raises(ValueError, match=r"cubes must lie in \[0, 2\), got 0 to 2"):
        voxelize_batch(triangles, [0, 2], 2)
    with pytest.raises(ValueError, match=r"whole numbers of shape \(2,\), got float64 \(2,\)"):
        voxelize_batch(triangles, [0.0, 1.0], 2)
    with pytest.raises(ValueError, match="count must be >= 0, got -1"):
        voxelize_batch(triangles[:0], np.zeros(0, dtype=int), -1)


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
