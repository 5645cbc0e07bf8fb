"""What ``unghost clean`` can be told besides what to clean."""

import json
import re

import numpy as np
import pytest

from unghost import cli
from unghost.cleaning.keep_mask import KeepMask
from unghost.cli import cleaning
from unghost.fields.adapters.grids import load_grid, save_grid

BOX = np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
SIDE = 2 / 32


@pytest.fixture(scope="module")
def cleaned(tmp_path_factory):
    """A floor and two balls in the air, cleaned once."""
    folder = tmp_path_factory.mktemp("grid")
    axis = (np.arange(32) + 0.5) * SIDE - 1
    places = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    floor = places[..., 2] < -0.8
    balls = [np.linalg.norm(places - [x, 0.0, 0.3], axis=-1) < 0.2 for x in (-0.5, 0.5)]
    save_grid(folder / "g.npz", (60.0 * (floor | balls[0] | balls[1])).astype(np.float32), BOX)
    assert cli.main(["clean", str(folder / "g.npz")]) == 0
    return folder, floor, balls


def clean(folder, *words, name="again.npz"):
    assert cli.main(["clean", str(folder / "g.npz"), "-o", str(folder / name), *words]) == 0
    return load_grid(folder / name)[0]


def test_a_mask_repeats_the_cleaning_without_a_denoiser(cleaned, capsys):
    folder, floor, balls = cleaned
    first = load_grid(folder / "g-clean.npz")[0]
    assert not (first[balls[0] | balls[1]]).any()
    assert (first[floor] == 60).all()
    words = ["--mask", str(folder / "g-keep.npz"), "--denoiser", "no such file"]
    assert (clean(folder, *words) == first).all()
    assert "keep mask" not in capsys.readouterr().out


def test_boxes_are_left_alone_or_taken_back(cleaned, capsys):
    folder, floor, balls = cleaned
    boxes = ["--keep-box", "-0.8", "-0.3", "0", "-0.2", "0.3", "0.6"]
    for words in ([], ["--mask", str(folder / "g-keep.npz"), "--keep", str(folder / "new.npz")]):
        found = clean(folder, *words, *boxes)
        assert (found[balls[0] | floor] == 60).all()
        assert not found[balls[1]].any()
    assert "1 boxes taken back" in capsys.readouterr().out
    assert KeepMask.load(folder / "new.npz").details["restored"] == [[[-0.8, -0.3, 0.0], [-0.2, 0.3, 0.6]]]
    both = clean(folder, *boxes, "--keep-box", "0.2", "-0.3", "0", "0.8", "0.3", "0.6")
    assert (both == load_grid(folder / "g.npz")[0]).all()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--keep-box", "1", "0", "0", "0", "1", "1"], "--keep-box"),
        (["--mask", "g-clean.npz"], "is not a keep mask"),
        (["--mask", "g-keep.npz", "--keep", "g-keep.npz"], "mask and keep are the same file"),
        (["--mask", "other.npz"], "clean: the mask's box must be g.npz's"),
    ],
)
def test_impossible_words(cleaned, words, message, capsys, monkeypatch):
    folder, _, _ = cleaned
    monkeypatch.chdir(folder)
    KeepMask(2 * BOX, 0.5, np.ones((8, 8, 8), bool)).save("other.npz")
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert cli.main(["clean", "g.npz", "-o", "never.npz", *words]) != 0
    assert re.search(message, capsys.readouterr().err)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_cameras_of_other_tools_are_brought_into_the_world_of_the_file(tmp_path):
    """Inria's cameras.json; and what nerfstudio's motion, beside the file to be cleaned, makes of it."""
    entry = {"id": 0, "img_name": "a", "width": 64, "height": 48, "fx": 60.0, "fy": 60.0}
    entry |= {"position": [1, 2, 3], "rotation": np.eye(3).tolist()}
    (tmp_path / "model").mkdir()
    (tmp_path / "model" / "cameras.json").write_text(json.dumps([entry]))
    (tmp_path / "export").mkdir()
    words = ("views", 0, 0.5, tmp_path / "model" / "cameras.json", tmp_path / "export" / "splat.ply")
    assert cleaning._judging(*words)["cameras"].origins.tolist() == [[1, 2, 3]]
    motion = {"transform": [[1, 0, 0, 10], [0, 1, 0, 0], [0, 0, 1, 0]], "scale": 0.5}
    (tmp_path / "export" / "dataparser_transforms.json").write_text(json.dumps(motion))
    assert cleaning._judging(*words)["cameras"].origins.tolist() == [[5.5, 1, 1.5]]


def test_cameras_that_do_not_fit_are_warned_of(tmp_path):
    from unghost import clean
    from unghost.core.cameras import Cameras, look_at
    from unghost.denoisers import load_denoiser

    poses = look_at(np.array([[80.0, 0, 0], [0, 80, 0]]), np.zeros((2, 3)))
    cameras = Cameras.create(poses, [60.0, 60, 32, 24], 64, 48)
    with pytest.warns(UserWarning, match="clean: the cameras do not fit the scene"):
        clean(
            lambda positions: np.zeros(len(positions)),
            [[-1, -1, -1], [1, 1, 1]],
            denoiser=load_denoiser("views"),
            cameras=cameras,
            resolution=32,
        )
