import json

import numpy as np
import pytest
from unghost_tests.colmap_models import motion, moved, write_model

from unghost.core.cameras import look_at
from unghost.evaluation.captures.alignment import align_poses
from unghost.evaluation.captures.loading import load_cameras, load_points


@pytest.fixture
def poses():
    rng = np.random.default_rng(0)
    eyes = rng.normal(size=(6, 3)) * [1, 1, 0.2] + [0, 0, 2]
    return look_at(eyes, rng.normal(0, 0.1, size=(6, 3)))


@pytest.mark.parametrize("scale", [1e-3, 1.0, 40.0])
def test_a_similarity_is_found_again(poses, scale):
    similarity = motion(np.random.default_rng(1), scale)
    found = align_poses(poses, moved(poses, similarity), label="m")
    np.testing.assert_allclose(found, similarity, atol=1e-9 * max(scale, 1))
    straight = poses.copy()
    straight[:, :, 3] = np.linspace(0, 1, 6)[:, None] * [1.0, 2.0, 0.0]  # turned only by the cameras' own rotations
    np.testing.assert_allclose(
        align_poses(straight, moved(straight, similarity), label="m"), similarity, atol=1e-8 * max(scale, 1)
    )


def test_other_poses_and_too_few_are_refused(poses):
    with pytest.raises(ValueError, match="m: its photos are posed otherwise than the cameras"):
        align_poses(poses, poses[::-1].copy(), label="m")
    for few in (poses[:1], np.repeat(poses[:1], 3, axis=0)):
        with pytest.raises(ValueError, match="m: at least two photos from different places"):
            align_poses(few, few, label="m")


@pytest.fixture
def capture(tmp_path, poses):
    """A transforms.json in one world, at half the size and in another order, and a model in another world."""
    pytest.importorskip("pycolmap")
    similarity = motion(np.random.default_rng(3), 2.5)
    names = [f"{letter}.png" for letter in "abcdef"]
    points = np.random.default_rng(4).normal(0, 0.2, size=(30, 3))
    tracks = [sorted(np.random.default_rng([5, n]).choice(6, 3, replace=False)) for n in range(30)]
    write_model(tmp_path / "sparse" / "0", poses, names, points, tracks)
    here = moved(poses, similarity)
    order = [4, 0, 2, 1, 5]  # one photo of the model is not among the cameras
    frames = [{"file_path": f"images/{names[n]}", "transform_matrix": [*here[n].tolist(), [0, 0, 0, 1]]} for n in order]
    lens = {"fl_x": 90, "fl_y": 90, "cx": 50, "cy": 37.5, "w": 100, "h": 75}
    (tmp_path / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))
    return tmp_path, points @ similarity[:3, :3].T + similarity[:3, 3], tracks, order


def test_points_come_in_the_world_and_with_the_indices_of_the_cameras(capture):
    folder, expected, tracks, order = capture
    cameras = load_cameras(folder)
    for path in (None, folder, folder / "sparse" / "0"):
        points = load_points(path, folder)
        np.testing.assert_allclose(points.xyz, expected, atol=1e-6)
        for number in range(len(points)):
            seen = points.camera[points.point == number].tolist()
            assert seen == sorted(order.index(photo) for photo in tracks[number] if photo in order)
    assert points.share_in_view(cameras) == 1.0
    half_a_pixel = 0.5 / 180 * np.linalg.norm(expected - cameras.origins.mean(axis=0), axis=1)
    determined = np.isfinite(points.uncertainty)
    assert determined.sum() > 20
    assert (points.uncertainty / half_a_pixel)[determined].min() > 0.2  # of the model's photos, not of half their size
    assert np.median((points.uncertainty / half_a_pixel)[determined]) < 2


def test_what_does_not_fit_is_named(capture, tmp_path, poses):
    folder, *_ = capture
    with pytest.raises(FileNotFoundError, match=r"load_points: .* has no COLMAP model with points"):
        load_points(tmp_path / "nothing", folder)
    other = tmp_path / "other"
    write_model(other, poses, [f"{n}.jpg" for n in range(6)], np.zeros((1, 3)), [(0, 1)])
    with pytest.raises(ValueError, match=r"load_points: no photo of .* is among the 5 cameras, such as images/e.png"):
        load_points(other, folder)
    turned = tmp_path / "turned"
    write_model(turned, poses[::-1], [f"{letter}.png" for letter in "abcdef"], np.zeros((1, 3)), [(0, 1)])
    with pytest.raises(ValueError, match="posed otherwise than the cameras"):
        load_points(turned, folder)
    (folder / "sparse" / "0" / "points3D.txt").write_text("# none\n")
    assert load_points(None, folder) is None
