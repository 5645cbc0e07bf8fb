"""What ``unghost clean`` can be told besides what to clean."""

import json
import re

import numpy as np
import pytest

from unghost import cli
from unghost.cleaning.keep_mask import KeepMask
from unghost.cli import cleaning
from unghost.core.file_kinds import file_kind
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
        (["--out", "never.splat"], "grids are written as .npz, got --out never.splat"),
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


def test_a_grid_is_one_whatever_its_name(cleaned, tmp_path):
    folder, _, _ = cleaned
    KeepMask(BOX, 0.5, np.arange(64).reshape(4, 4, 4) > 9).save(tmp_path / "k.npz")
    for name, out in (("g.PLY", "g-clean.npz"), ("h.NPZ", "h-clean.NPZ"), ("i", "i-clean.npz")):
        (tmp_path / name).write_bytes((folder / "g.npz").read_bytes())
        assert cli.main(["clean", str(tmp_path / name), "--mask", str(tmp_path / "k.npz")]) == 0
        density = load_grid(tmp_path / out)[0]
        assert not density[:8, :8].any()
        assert density.any()


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.npz", b"\x93NUMPY\x01\x00", "a single .npy array: save it with its box"),
        ("a.ply", b"version https://git-lfs.github.com/spec/v1\n", "a git-lfs pointer.*git lfs pull"),
        ("a.spz", b"NGSP" + bytes(60), r"a compressed splat file \(.spz\): convert it to a 3DGS .ply, with SuperSplat"),
        ("a.npz", b"PK\x03\x04", "an .npz or .sog archive without its end"),
        ("a.npz", b"text", "of no known format"),
        ("folder", None, "a folder: name a file in it"),
    ],
)
def test_other_files_are_named_with_what_to_do(tmp_path, capsys, name, content, message):
    source = tmp_path / name
    source.mkdir() if content is None else source.write_bytes(content)
    assert cli.main(["clean", str(source)]) == 2
    error = capsys.readouterr().err
    assert re.search(message, error)
    assert error.count("\n") == 1
    assert "pickle" not in error
    for read in (load_grid, KeepMask.load):
        with pytest.raises((ValueError, OSError)) as caught:
            read(source)
        assert file_kind(source).name in str(caught.value)
        assert "pickle" not in str(caught.value)
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_the_keep_mask_is_not_what_is_cleaned(cleaned, capsys):
    folder, _, _ = cleaned
    assert cli.main(["clean", str(folder / "g-keep.npz")]) == 2
    assert "is a keep mask: name the file that was cleaned, and this one with --mask" in capsys.readouterr().err


@pytest.mark.slow
def test_cameras_that_nobody_uses_are_one_line(cleaned, tmp_path, capsys):
    folder, _, _ = cleaned
    frames = [{"file_path": f"{i}.png", "transform_matrix": np.eye(4).tolist()} for i in range(3)]
    lens = {"w": 8, "h": 8, "fl_x": 8.0, "fl_y": 8.0, "cx": 4.0, "cy": 4.0, "camera_model": "OPENCV"}
    (tmp_path / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))
    words = ["--cameras", str(tmp_path / "transforms.json"), "--keep", str(tmp_path / "k.npz")]
    for denoiser, warned in (("default", True), ("views", False)):
        clean(folder, *words, "--denoiser", denoiser)
        error = capsys.readouterr().err
        lines = [line for line in re.split(r"[\r\n]", error) if line.startswith("warning: clean: cameras are not used")]
        assert len(lines) == warned
        assert not warned or "--denoiser views" in lines[0]


def test_cameras_of_other_tools_are_brought_into_the_world_of_the_file(tmp_path):
    """Inria's cameras.json; and what nerfstudio's motion, beside the file to be cleaned, makes of it."""
    entry = {"id": 0, "img_name": "a", "width": 64, "height": 48, "fx": 60.0, "fy": 60.0}
    entry |= {"position": [1, 2, 3], "rotation": np.eye(3).tolist()}
    (tmp_path / "model").mkdir()
    (tmp_path / "model" / "cameras.json").write_text(json.dumps([entry]))
    (tmp_path / "export").mkdir()
    words = ("views", 0, 0.5, tmp_path / "model" / "cameras.json", None, tmp_path / "export" / "splat.ply")
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
