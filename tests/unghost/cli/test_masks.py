"""A wall, one camera that trained and one that is scored: what both see is a rectangle that can be computed."""

import json

import numpy as np
import pytest
from PIL import Image

from unghost import cli
from unghost.evaluation.scoring.pseudo_truth import load_pseudo_truth

WIDTH, HEIGHT, FOCAL = 32, 24, 32.0
WALL = 4.0  # in front of both cameras
SHIFT = 2.0  # of the evaluation camera, to the right: half of the 4 units that a photo shows of the wall


@pytest.fixture
def capture(tmp_path):
    folder = tmp_path / "capture"
    folder.mkdir()
    frames = []
    for name, x in (("train", 0.0), ("eval", SHIFT)):
        Image.new("RGB", (WIDTH, HEIGHT)).save(folder / f"{name}.png")
        pose = [[1, 0, 0, x], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
        frames.append({"file_path": f"{name}.png", "transform_matrix": pose})
    (folder / "transforms.json").write_text(json.dumps({"fl_x": FOCAL, "w": WIDTH, "h": HEIGHT, "frames": frames}))
    (folder / "splits.json").write_text(json.dumps({"train": ["train.png"], "eval": ["eval.png"]}))
    return folder


def run(capture, *words):
    return cli.main(["masks", str(capture), "--downscale", "1", "--no-normalize", *map(str, words)])


def test_half_of_the_wall_was_seen(capture, tmp_path, capsys):
    np.savez(tmp_path / "depth.npz", depth=np.full((1, HEIGHT, WIDTH), WALL))
    out = tmp_path / "masks"
    assert run(capture, "--depth", tmp_path / "depth.npz", "--depth-along", "axis", "--out", out) == 0
    assert "coverage 0.500 (worst 0.500, eval.png)" in capsys.readouterr().out
    mask = np.array(Image.open(out / "eval.png.mask.png"))
    assert mask.shape == (HEIGHT, WIDTH)
    assert (mask[:, : WIDTH // 2] == 255).all()
    assert (mask[:, WIDTH // 2 :] == 0).all()
    stored = load_pseudo_truth(out / "masks.npz")
    np.testing.assert_array_equal(stored.visible(occlusion=False)[0], mask > 0)
    corner = np.hypot(np.hypot(15.5, 11.5) / FOCAL * WALL, WALL)  # along the ray, not the axis
    assert stored.depth[0, 0, 0] == pytest.approx(corner, rel=1e-6)


def test_what_something_hides_was_not_seen(capture, tmp_path, capsys):
    np.save(tmp_path / "depth.npy", np.full((1, HEIGHT, WIDTH), WALL))
    near = np.full((1, HEIGHT, WIDTH), WALL)
    near[:, : HEIGHT // 2] = 1.0  # a board before the upper half of the training photo
    np.save(tmp_path / "train.npy", near)
    words = ["--depth", tmp_path / "depth.npy", "--train-depth", tmp_path / "train.npy", "--depth-along", "axis"]
    assert run(capture, *words, "--out", tmp_path / "masks") == 0
    assert "coverage 0.250" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--depth", "absent.npy"], "masks: no file"),
        (["--depth", "flat.npy"], "(views, height, width), got shape (3, 4)"),
        (["--depth", "other.npz"], "holds z, but no 'depth'"),
        (["--depth", "text.npy"], "is no .npy or .npz of numbers"),
        (["--depth", "small.npy"], "must have shape (1, 24, 32), got (1, 2, 2)"),
        (["--depth", "good.npy", "--eval-split", "third"], "no split 'third'"),
        (["--depth", "zero.npy"], "must be > 0"),
    ],
)
def test_mistakes_are_a_line_and_write_nothing(words, message, capture, tmp_path, capsys):
    np.save(tmp_path / "flat.npy", np.ones((3, 4)))
    np.save(tmp_path / "small.npy", np.ones((1, 2, 2)))
    np.save(tmp_path / "good.npy", np.ones((1, HEIGHT, WIDTH)))
    np.save(tmp_path / "zero.npy", np.zeros((1, HEIGHT, WIDTH)))
    np.savez(tmp_path / "other.npz", z=np.ones((1, 2, 2)))
    (tmp_path / "text.npy").write_text("no array")
    words = [words[0], str(tmp_path / words[1]), *words[2:]]
    assert run(capture, *words, "--out", tmp_path / "masks") == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not (tmp_path / "masks").exists()
