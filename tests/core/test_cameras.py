import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from unghost.core.cameras import (
    Cameras,
    distort,
    largest_radius,
    look_at,
    undistort,
    warn_if_elsewhere,
    warn_if_turned_away,
)
from unghost.core.frames import random_rotations

PHONE = np.array([0.05, -0.08, 0.01, 0.002, 0.0006, -0.0004])


def camera(*, distortion=None, pose=None, width=8, height=6):
    pose = np.eye(4)[None] if pose is None else pose
    return Cameras.create(pose, np.array([10.0, 20.0, 4.0, 3.0]), width, height, distortion)


def test_projection_by_hand():
    # One unit right, one up, five ahead: u = 4 + 10 * 1/5, v = 3 - 20 * 1/5 (rows grow downwards).
    pixels, depth, visible = camera().project(0, np.array([[1.0, 0.1, -5.0]]))
    np.testing.assert_allclose(pixels[0], [6.0, 3.0 - 20 * 0.1 / 5])
    assert depth[0] == 5.0
    assert visible[0]


def test_behind_on_the_plane_and_outside_are_not_visible():
    points = np.array([[0, 0, 1.0], [0, 0, 0.0], [3.0, 0, -5], [0, 2.0, -5], [0, 0, -1e-6]])
    pixels, _, visible = camera().project(0, points)
    assert np.isfinite(pixels).all()
    assert visible.tolist() == [False, False, False, False, True]


def test_first_pixel_centre_is_at_half():
    origins, directions = camera().rays(0)
    assert directions.shape == (6, 8, 3)
    expected = np.array([(0.5 - 4) / 10, -(0.5 - 3) / 20, -1.0])
    np.testing.assert_allclose(directions[0, 0], expected / np.linalg.norm(expected))
    assert not origins.any()


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 100_000), bent=st.booleans())
def test_rays_and_projection_are_inverse(seed, bent):
    rng = np.random.default_rng(seed)
    pose = np.concatenate([random_rotations(rng, 2), rng.normal(size=(2, 3, 1))], axis=2)
    view = camera(pose=pose, distortion=PHONE if bent else None)
    pixels = rng.uniform([0, 0], [8, 6], size=(20, 2))
    origins, directions = view.rays(1, pixels)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1.0)
    distance = rng.uniform(0.1, 50, size=(20, 1))
    found, depth, visible = view.project(1, origins + distance * directions)
    np.testing.assert_allclose(found, pixels, atol=1e-6)
    assert (depth > 0).all()
    assert (depth <= distance[:, 0] * (1 + 1e-9)).all()
    assert visible.all()


def test_distortion_by_hand_and_back():
    # r2 = 0.25; radial = 1 + 0.1 * 0.25; tangential 2 p1 x y + p2 (r2 + 2 x^2) with y = 0.
    u, v = distort(np.array([0.5]), np.array([0.0]), np.array([0.1, 0, 0, 0, 0.01, 0.02]))
    np.testing.assert_allclose([u[0], v[0]], [0.5 * 1.025 + 0.02 * 0.75, 0.01 * 0.25])
    x, y = undistort(*distort(np.array([0.3, -0.6]), np.array([0.2, 0.4]), PHONE), PHONE)
    np.testing.assert_allclose([x, y], [[0.3, -0.6], [0.2, 0.4]], atol=1e-9)


def test_points_folded_back_by_the_polynomial_are_not_visible():
    barrel = np.array([-0.3, 0, 0, 0, 0, 0])  # r (1 - 0.3 r^2) turns back at r^2 = 1 / 0.9
    assert largest_radius(barrel) == pytest.approx(np.sqrt(1 / 0.9))
    assert largest_radius(np.zeros(6)) == np.inf
    wide = Cameras.create(np.eye(4)[None], np.array([10.0, 10.0, 4.0, 4.0]), 8, 8, barrel)
    far_out = np.array([[1.8, 0.0, -1.0]])  # folds onto u = 1.8 * (1 - 0.972) = 0.05, well inside the picture
    assert distort(np.array([1.8]), np.array([0.0]), barrel)[0][0] == pytest.approx(0.0504)
    assert not wide.project(0, far_out)[2][0]


def test_view_count_counts_and_respects_depth():
    pose = np.tile(np.eye(4), (2, 1, 1))
    pose[1, :3, :3] = np.diag([-1.0, 1.0, -1.0])  # the second looks along +z
    views = camera(pose=pose)
    points = np.array([[[0, 0, -2.0], [0, 0, 2.0]], [[0, 0.0, -9.0], [50, 0, -1.0]]])
    assert views.view_count(points).tolist() == [[1, 1], [1, 0]]
    depth = np.full((2, 6, 8), 5.0)
    assert views.view_count(points, depth_maps=depth).tolist() == [[1, 1], [0, 0]]


def test_resized_cameras_see_the_same_rays():
    half = camera().resized(0.5)
    assert (half.width, half.height) == (4, 3)
    np.testing.assert_allclose(half.rays(0, np.array([1.0, 1.0]))[1], camera().rays(0, np.array([2.0, 2.0]))[1])


def test_select_keeps_the_axis():
    views = Cameras.create(np.tile(np.eye(4), (3, 1, 1)), np.array([1.0, 1, 0, 0]), 2, 2)
    assert len(views.select(1)) == 1
    assert len(views.select([0, 2])) == 2


@pytest.mark.parametrize(
    ("pose", "lens", "words"),
    [
        (np.eye(4), [1, 1, 0, 0], "camera_to_world must have shape"),
        (np.eye(4)[None] * np.nan, [1, 1, 0, 0], "camera_to_world must be finite"),
        (2 * np.eye(4)[None], [1, 1, 0, 0], "orthonormal"),
        (np.eye(4)[None], [0, 1, 0, 0], "fx, fy > 0"),
    ],
)
def test_impossible_cameras_are_refused(pose, lens, words):
    with pytest.raises(ValueError, match=words):
        Cameras.create(pose, np.array(lens, dtype=float), 4, 4)


def inward(count=12, radius=2.0):
    """A ring of cameras that look at the origin; and the same poses as OpenCV writes them."""
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    origins = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(count, 0.5)], axis=1)
    poses = look_at(origins, np.zeros((count, 3)))
    lens = np.array([60.0, 60, 40, 30])
    return Cameras.create(poses, lens, 80, 60), Cameras.create(poses * [1, -1, -1, 1], lens, 80, 60)


def test_opencv_poses_are_noticed_and_others_are_not():
    box = np.array([[-0.6] * 3, [0.6] * 3])
    right, wrong = inward()
    outward = Cameras.create(look_at(np.zeros((8, 3)) + 0.01, right.origins[:8]), right.intrinsics[0], 80, 60)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_if_turned_away(right, box, caller="me")
        warn_if_turned_away(outward, box, caller="me")
        warn_if_turned_away(None, box, caller="me")
        warn_if_turned_away(right.select(slice(0, 0)), box, caller="me")
        warn_if_turned_away(wrong, box + 100.0, caller="me")  # a box that nobody looks at, however turned
    with pytest.warns(UserWarning, match=r"me: the cameras have 0.0% of the aabb in view.*OpenCV"):
        warn_if_turned_away(wrong, box, caller="me")


def test_cameras_of_another_world_are_noticed_and_others_are_not():
    box = np.array([[-0.6] * 3, [0.6] * 3])
    right, wrong = inward()
    outward = Cameras.create(look_at(np.zeros((8, 3)) + 0.01, right.origins[:8]), right.intrinsics[0], 80, 60)
    some = Cameras.create(right.camera_to_world, right.intrinsics, 80, 60)
    corner = np.array([[0.4, 0.4, 0.4], [0.6, 0.6, 0.6]])  # a small part of what they see
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for rig in (right, outward, None, right.select(slice(0, 0)), wrong):  # of the last, the other check speaks
            warn_if_elsewhere(rig, box, caller="me")
        warn_if_elsewhere(some, corner, caller="me")
    far = Cameras.create(right.camera_to_world * np.array([1, 1, 1, 60.0]), right.intrinsics, 80, 60)
    with pytest.warns(UserWarning, match=r"me: the cameras do not fit .* 5\d\.\d of its diagonals away.*dataparser"):
        warn_if_elsewhere(far, box, caller="me")
    with pytest.warns(UserWarning, match=r"together they have 0% of its aabb in view"):
        warn_if_elsewhere(right, box + np.array([0, 0, 8.0]), caller="me")
