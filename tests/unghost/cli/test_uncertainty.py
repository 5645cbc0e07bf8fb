"""``unghost doubt``: pixels that the training photos contradict, and the curve that they make of a method."""

import json

import numpy as np
import pytest
from PIL import Image

from unghost import cli

WIDTH, HEIGHT, FOCAL, WALL = 32, 24, 32.0, 4.0
TAUGHT, SEEN = {"t0": -0.5, "t1": 0.5}, {"e0": 0.0, "e1": 0.2}


def painting(x, true_wall=WALL):
    """What a camera at (x, 0, 0) that looks along -z sees of a painted wall."""
    columns, rows = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    u, v = x + (columns - WIDTH / 2) / FOCAL * true_wall, -(rows - HEIGHT / 2) / FOCAL * true_wall
    return 0.5 + 0.4 * np.stack([np.sin(3 * u), np.cos(3 * v), np.sin(2 * (u + v))], axis=-1)


def save(path, pixels):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.round(pixels * 255).astype(np.uint8)).save(path)


@pytest.fixture
def folder(tmp_path):
    """A capture, renders with a ghost in the left half of the first view, and depth of the training views."""
    frames = []
    for name, x in {**TAUGHT, **SEEN}.items():
        save(tmp_path / "capture" / "images" / f"{name}.png", painting(x))
        pose = [[1, 0, 0, x], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
        frames.append({"file_path": f"images/{name}.png", "transform_matrix": pose})
    told = {"fl_x": FOCAL, "w": WIDTH, "h": HEIGHT, "frames": frames}
    (tmp_path / "capture" / "transforms.json").write_text(json.dumps(told))
    splits = {"train": [f"images/{name}.png" for name in TAUGHT], "eval": [f"images/{name}.png" for name in SEEN]}
    (tmp_path / "capture" / "splits.json").write_text(json.dumps(splits))
    for kind, names in (("train", TAUGHT), ("renders", SEEN)):
        (tmp_path / kind / "depth").mkdir(parents=True)
        for name, x in names.items():
            depth, picture = np.full((HEIGHT, WIDTH), WALL), painting(x)
            if name == "e0":
                depth[:, : WIDTH // 2] = 0.5 * WALL
                picture[:, : WIDTH // 2] = 1.0 - picture[:, : WIDTH // 2]
            np.save(tmp_path / kind / "depth" / f"{name}.npy", depth)
            if kind == "renders":
                error = np.random.default_rng(0).normal(scale=0.01, size=picture.shape)
                save(tmp_path / kind / f"{name}.png", np.clip(picture + error, 0, 1))
    return tmp_path


def run(folder, *more):
    words = [folder / "renders", "--gt", folder / "capture", "--train-renders", folder / "train", *more]
    return cli.main(["doubt", *map(str, words), "--depth-along", "axis", "--no-normalize"])


def test_a_ghost_is_doubted_and_the_wall_is_not(folder, capsys):
    assert run(folder) == 0
    first, second = (np.load(folder / "renders" / "uncertainty" / f"{name}.npy") for name in SEEN)
    assert first.dtype == np.float32
    right, left = first[:, WIDTH // 2 + 1 : -8], first[:, 4 : WIDTH // 2 - 1]
    assert np.median(right) < 0.02  # the error of the renders
    assert np.median(left) > 0.1
    assert np.median(second[:, 8:-8]) < 0.03
    picture = np.asarray(Image.open(folder / "renders" / "uncertainty" / "e0.png"))
    assert picture[:, 4 : WIDTH // 2].mean() > 2 * picture[:, WIDTH // 2 : -8].mean()
    said = capsys.readouterr().out
    assert "2 views, 2 photos: " in said
    assert "renders/uncertainty" in said

    words = [folder / "renders", "--gt", folder / "capture", "--depth-along", "axis", "--out", folder / "page"]
    assert cli.main(["evaluate", *map(str, words), "--convention", "whole_image", "--no-normalize"]) == 0
    (row,) = json.loads((folder / "page" / "results.json").read_text())["rows"]
    curve = row["curve"]
    assert curve[-1]["coverage"] != curve[0]["coverage"]
    half = min(curve, key=lambda point: abs(point["coverage"] - 0.5))
    assert half["psnr"] > row["psnr"] + 10  # the ghost goes first


def test_slack_lets_photos_see_further(folder, capsys):
    for name in TAUGHT:  # photos whose depth stops a fifth before the wall see nothing of it
        np.save(folder / "train" / "depth" / f"{name}.npy", np.full((HEIGHT, WIDTH), 0.8 * WALL))
    assert run(folder) == 0
    assert "a doubt of" in capsys.readouterr().out  # of the ghost, which stands before
    assert np.load(folder / "renders" / "uncertainty" / "e1.npy").min() == 1.0
    assert run(folder, "--replace", "--slack", str(0.3 * WALL)) == 0
    assert np.median(np.load(folder / "renders" / "uncertainty" / "e1.npy")[:, 8:-8]) < 0.03
    assert run(folder, "--replace", "--slack", "-1") == 2
    assert "slack must be finite and >= 0, got -1" in capsys.readouterr().err


def test_nothing_is_written_over(folder, capsys):
    assert run(folder) == 0
    assert run(folder) == 2
    assert "uncertainty is there already; say --replace" in capsys.readouterr().err
    assert run(folder, "--replace") == 0
    (folder / "renders" / "confidence").mkdir()
    (folder / "renders" / "confidence" / "e0.npy").touch()
    assert run(folder, "--replace") == 2
    assert "confidence is there already; move it away" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("kind", "name", "message"),
    [
        ("train", None, "train holds no depth maps"),
        ("renders", None, "renders holds no depth maps"),
        ("train", "t1", r"depth maps in .* 1 of 2 views have none (images/t1.png)"),
    ],
)
def test_depth_that_is_missing(folder, capsys, kind, name, message):
    for path in (folder / kind / "depth").glob(f"{name or '*'}.npy"):
        path.unlink()
    assert run(folder) == 2
    error = capsys.readouterr().err
    assert all(part in error for part in message.split(" .* "))
    assert not (folder / "renders" / "uncertainty").exists()
