"""Options of benchmarks/two_trajectory/pictures.py."""

import json

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("torch")

from unghost_tests.benches import check_short, refusal

from benchmarks.two_trajectory import pictures, scenes
from benchmarks.two_trajectory.scores import Stage


def test_short():
    check_short(pictures, scene="room-1", views=2)


def test_what_is_missing(monkeypatch, capsys):
    assert "no nowhere" in refusal(pictures, monkeypatch, capsys, "--capture", "nowhere")


def test_photos_are_as_wide_as_asked_whatever_the_field_was_trained_on(monkeypatch):
    monkeypatch.setattr(scenes, "FEWEST_SEEN", 0.0)
    scene = scenes.synthetic_scene(2026, "room-1", photos=3, views=3, width=16, resolution=24)
    cameras, truth = pictures.larger_truth(Stage(scene, None, None, 1, 1), 32, [2, 0])
    assert truth["rgb"].shape == (2, 24, 32, 3)
    small = truth["rgb"].reshape(2, 12, 2, 16, 2, 3).mean(axis=(2, 4))
    assert np.abs(small - scene.evaluation.photos[[2, 0]]).mean() < 0.03
    assert (cameras.width, cameras.height) == (32, 24)
    assert np.array_equal(cameras.origins, scene.evaluation.cameras.origins[[2, 0]])
    near = truth["depth"].reshape(2, 12, 2, 16, 2).min(axis=(2, 4))
    assert (near <= scene.pseudo(None).depth[[2, 0]] * 1.2).mean() > 0.9


def test_photos_of_a_capture_are_read_larger(tmp_path):
    frames = []
    for index in range(4):
        Image.new("RGB", (64, 48), (60 * index, 90, 40)).save(tmp_path / f"{index}.png")
        pose = np.eye(4)
        pose[0, 3] = 0.5 * index
        frames.append({"file_path": f"{index}.png", "transform_matrix": pose.tolist()})
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 50.0, "w": 64, "h": 48, "frames": frames}))
    (tmp_path / "splits.json").write_text(json.dumps({"one": ["0.png", "1.png"], "two": ["2.png", "3.png"]}))
    scene = scenes.captured_scene(tmp_path, "one", "two", downscale=8)
    shape = scene.evaluation.photos.shape
    stage = Stage(scene, None, None, 1, 1, lambda cameras: np.ones((len(cameras), cameras.height, cameras.width)))
    cameras, truth = pictures.larger_truth(stage, 32, [1])
    assert (shape, truth["rgb"].shape, truth["depth"].shape) == ((2, 6, 8, 3), (1, 24, 32, 3), (1, 24, 32))
    assert truth["rgb"][0, 0, 0, 0] == pytest.approx(180 / 255)  # the second photo of the evaluation sweep
    assert np.allclose(cameras.origins, scene.evaluation.cameras.origins[[1]])
    _, whole = pictures.larger_truth(stage, 999, [1])
    assert whole["rgb"].shape == (1, 48, 64, 3)  # never more pixels than the photo has
