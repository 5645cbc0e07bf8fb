import numpy as np
import pytest

from unghost.core.cameras import Cameras
from unghost.evaluation.metrics import geometry


def _camera(width=30, height=24, pose=None):
    pose = np.eye(4)[None] if pose is None else pose
    return Cameras.create(pose, np.array([25.0, 25.0, width / 2, height / 2]), width, height)


def test_depth_and_disparity_known_values():
    preds = np.array([[1.0, 2.0], [4.0, np.inf]])
    target = np.array([[2.0, 2.0], [1.0, np.inf]])
    mask = np.array([[True, True], [True, False]])
    assert geometry.depth_mse(preds, target, mask) == pytest.approx((1 + 0 + 9) / 3)
    assert geometry.disparity_mae(preds, target, mask) == pytest.approx((0.5 + 0 + 0.75) / 3)
    assert geometry.disparity_mae(preds, target, np.ones((2, 2), dtype=bool)) == pytest.approx(1.25 / 4)
    with pytest.raises(ValueError, match="must be > 0"):
        geometry.disparity_mae(preds - 1, target, mask)


def test_backprojection_lands_on_the_plane_it_came_from():
    camera = _camera()
    _, directions = camera.rays(0)
    depth = 3.0 / -directions[..., 2]  # the plane z = -3, as distance along unit rays
    positions = geometry.backproject(depth, camera, 0)
    np.testing.assert_allclose(positions[..., 2], -3.0, atol=1e-12)
    depth[2, 3] = np.inf
    assert np.isnan(geometry.backproject(depth, camera, 0)[2, 3]).all()


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.3, -0.4, 0.8), (-0.6, 0.1, 0.5)])
def test_normals_of_a_tilted_plane_are_exact_and_face_the_camera(normal):
    unit = np.array(normal) / np.linalg.norm(normal)
    camera = _camera()
    _, directions = camera.rays(0)
    depth = -2.0 / (directions @ unit)  # unit . (d t) = -2
    assert (depth > 0).all()
    normals = geometry.normals_from_depth(depth, camera, 0)
    np.testing.assert_allclose(normals, np.broadcast_to(unit, normals.shape), atol=1e-9)


def test_normals_turn_with_the_camera():
    turn = np.array([[0.0, 0.0, 1.0, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]])
    camera = _camera(pose=turn[None])
    _, directions = _camera().rays(0)
    normals = geometry.normals_from_depth(3.0 / -directions[..., 2], camera, 0)
    np.testing.assert_allclose(normals, np.broadcast_to(turn[:3, 2], normals.shape), atol=1e-9)


def test_normals_are_missing_beside_a_hole():
    camera = _camera()
    depth = np.full((24, 30), 2.0)
    depth[10, 10] = np.inf
    missing = np.isnan(geometry.normals_from_depth(depth, camera, 0)).any(axis=-1)
    assert sorted(map(tuple, np.argwhere(missing))) == [(9, 10), (10, 9), (10, 10), (10, 11), (11, 10)]


def test_normal_errors_known_values():
    angles = np.radians([[0.0, 20.0, 40.0], [180.0, 0.0, 0.0]])
    preds = np.stack([np.sin(angles), np.zeros_like(angles), np.cos(angles)], axis=-1)
    target = np.zeros_like(preds)
    target[..., 2] = 1
    target[1, 1] = np.nan
    mask = np.array([[True, True, True], [True, True, False]])
    found = geometry.normal_errors(preds, target, mask)  # 0, 20, 40, 180
    assert found["normal_mean_deg"] == pytest.approx(60)
    assert found["normal_median_deg"] == pytest.approx(30)
    assert found["normal_pct_30"] == pytest.approx(0.5)


def test_a_depth_metric_sees_no_infinity_and_disparity_does():
    depth, endless = np.full((2, 2), 2.0), np.full((2, 2), np.inf)
    mask = np.ones((2, 2), dtype=bool)
    with pytest.raises(ValueError, match="depth_mse: 4 unmasked values are NaN or infinite"):
        geometry.depth_mse(depth, endless, mask)
    assert geometry.disparity_mae(depth, endless, mask) == 0.5
    with pytest.raises(ValueError, match="disparity_mae: unmasked depths must be > 0"):
        geometry.disparity_mae(depth, np.full((2, 2), np.nan), mask)


def test_normal_errors_equal_a_loop():
    rng = np.random.default_rng(0)
    preds, target = rng.normal(size=(2, 5, 6, 3))
    preds, target = (each / np.linalg.norm(each, axis=-1, keepdims=True) for each in (preds, target))
    preds[1, 2] = np.nan
    mask = rng.random((5, 6)) < 0.7
    angles = []
    for row in range(5):
        for column in range(6):
            if mask[row, column] and (row, column) != (1, 2):
                sine = np.linalg.norm(np.cross(preds[row, column], target[row, column]))
                angles.append(np.degrees(np.arctan2(sine, preds[row, column] @ target[row, column])))
    found = geometry.normal_errors(preds, target, mask)
    assert found["normal_mean_deg"] == pytest.approx(np.mean(angles))
    assert found["normal_median_deg"] == pytest.approx(np.median(angles))
    assert found["normal_pct_30"] == pytest.approx(np.mean([angle < 30 for angle in angles]))
