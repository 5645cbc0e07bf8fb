"""The verbs capture and convert: from two videos of a rendered room to a folder that is read again."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from unghost_tests import textured_room

from unghost import cli
from unghost.core.cameras import Cameras
from unghost.evaluation.captures.loading import load_capture
from unghost.evaluation.captures.transforms import write_transforms

SHARED = Path(__file__).parents[3].parent / "shared" / "data" / "captures" / "snowmiku_plush"


@pytest.fixture(scope="module")
def room():
    return textured_room


def run(*words):
    return cli.main([str(word) for word in words])


def video(path, frames):
    av = pytest.importorskip("av")
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=10)
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt, stream.bit_rate, stream.gop_size = "yuv420p", 20_000_000, 1
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode())
    return path


def blurred(photo):
    return np.asarray(Image.fromarray(photo).reduce(4).resize((photo.shape[1], photo.shape[0])))


@pytest.mark.slow
def test_two_videos_become_a_capture(room, tmp_path, capsys):
    pytest.importorskip("pycolmap")
    rigs = {"train": room.arc(np.linspace(15, 60, 8), 1.0), "eval": room.arc(np.linspace(30, 70, 6), 1.5, 2.6)}
    for sweep, rig in rigs.items():
        sharp = room.photograph(rig, room.walls(0))
        video(tmp_path / f"{sweep}.mp4", [frame for photo in sharp for frame in (blurred(photo), photo)])
    out, plot = tmp_path / "capture", tmp_path / "plot.png"
    assert (
        run("capture", tmp_path / "train.mp4", tmp_path / "eval.mp4", "--out", out, "--frames", 8, "--plot", plot) == 0
    )
    printed = capsys.readouterr().out
    assert "train: 16 pictures in train.mp4, 8 kept, 8 posed" in printed
    assert "eval: 12 pictures in eval.mp4" in printed
    assert "every 8th training photo" in printed
    assert plot.stat().st_size > 10_000
    assert {path.name for path in out.iterdir()} == {
        "images",
        "sparse",
        "transforms.json",
        "splits.json",
        "capture.json",
    }
    told = json.loads((out / "capture.json").read_text())
    assert [told["frames"][f"frame_0000{k}.jpg"] for k in range(1, 9)] == list(range(1, 17, 2))  # the sharp ones
    capture = load_capture(out, downscale=1)
    train, scored = capture.split("train"), capture.split("eval")
    assert [capture.names[k] for k in train] == [f"images/frame_0000{k}.jpg" for k in range(1, 9)]
    assert all(capture.names[k].startswith("images/frame_1_0000") for k in scored)
    taken = [told["frames"][Path(capture.names[k]).name] // 2 for k in scored]
    true = np.concatenate([rigs["train"].camera_to_world, rigs["eval"].camera_to_world[taken]])
    distance, angle = room.similarity_error(capture.cameras.camera_to_world[[*train, *scored]], true)
    assert np.median(distance) < 0.02
    assert np.median(angle) < 1
    assert np.abs(capture.cameras.origins).max() == pytest.approx(1)
    meta = json.loads((out / "transforms.json").read_text())
    assert meta["train_filenames"] == [capture.names[k] for k in train]
    assert meta["val_filenames"] == meta["test_filenames"] == [capture.names[k] for k in scored]
    assert (out / meta["ply_file_path"]).is_file()
    assert run("convert", out) == 0
    assert f"{len(train)} photos to train on, {len(scored)} to be scored on, 0 in neither" in capsys.readouterr().out


@pytest.mark.parametrize("case", ["gone", "broken", "empty", "sizes", "in use", "blank", "plot"])
def test_bad_input_is_one_line_and_leaves_nothing(case, tmp_path, capsys, monkeypatch):
    pytest.importorskip("av")
    monkeypatch.chdir(tmp_path)
    for name, side in (("a", 96), ("b", 128 if case == "sizes" else 96)):
        Path(name).mkdir()
        for number in range(3 if case != "empty" or name == "a" else 0):
            Image.new("RGB", (side, 96), (9, 9, 9)).save(Path(name, f"{number}.png"))
    Path("c.mp4").write_bytes(b"no video")
    words = {"gone": ("a", "z"), "broken": ("a", "c.mp4")}.get(case, ("a", "b"))
    if case == "in use":
        Path("out").mkdir()
        Path("out", "mine").write_text("kept")
    before = sorted(path.name for path in tmp_path.rglob("*"))
    extra = ["--plot", "plot.jpg"] if case == "plot" else []
    assert run("capture", *words, "--out", "out", *extra) == 2
    error = capsys.readouterr().err.splitlines()[-1]  # what stands before are progress bars
    message = {
        "gone": "no video or folder z to be scored on",
        "broken": "cannot read c.mp4 as a video",
        "empty": "no photos in b (looked for .jpg",
        "sizes": "train 96 x 96, eval 128 x 96",
        "in use": "out is there already and not empty",
        "plot": "--plot must end in .png",
        "blank": "COLMAP posed no photos (train 0 of 3, eval 0 of 3)",
    }[case]
    assert error.startswith("unghost capture: ")
    assert message in error
    assert sorted(path.name for path in tmp_path.rglob("*")) == before


def test_frames_of_a_video_outlive_a_failed_posing(tmp_path, capsys, monkeypatch):
    av = pytest.importorskip("av")
    monkeypatch.chdir(tmp_path)
    with av.open("walk.mp4", "w") as container:
        stream = container.add_stream("mpeg4", rate=10)
        stream.width = stream.height = 96
        for _ in range(4):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.full((96, 96, 3), 90, np.uint8), format="rgb24")))
        container.mux(stream.encode(None))
    Path("b").mkdir()
    for number in range(3):
        Image.new("RGB", (96, 96), (9, 9, 9)).save(Path("b", f"{number}.png"))
    Path("out.partial").mkdir()
    Path("out.partial", "mine").write_text("kept")
    assert run("capture", "walk.mp4", "b", "--out", "out") == 2
    error = capsys.readouterr().err.splitlines()[-1]
    (kept,) = tmp_path.glob("out.train.*")
    assert "COLMAP posed no photos" in error
    assert f"the frames are kept, those of walk.mp4 in {kept.name}: a folder can be given in a video's place" in error
    assert len(list(kept.iterdir())) == 4
    assert Path("out.partial", "mine").read_text() == "kept"  # somebody else's
    assert {path.name for path in tmp_path.iterdir()} == {"walk.mp4", "b", "out.partial", kept.name}


@pytest.fixture
def three_sweeps(tmp_path):
    """Nine training photos along x, two scored ones beside them, one of a third sweep."""
    places = [[k, 0, 0] for k in range(9)] + [[0, 4, 0], [8, 4, 0], [90, 0, 0]]
    poses = np.tile(np.eye(4)[:3], (12, 1, 1))
    poses[:, :, 3] = places
    folder = tmp_path / "capture"
    folder.mkdir()
    names = [f"{number:02d}.png" for number in range(12)]
    for name in names:
        Image.new("RGB", (16, 12)).save(folder / name)
    write_transforms(folder / "transforms.json", Cameras.create(poses, [20, 20, 8, 6], 16, 12), names, {})
    lists = {"walk": names[:9], "back": names[9:11], "third": names[11:]}
    (folder / "splits.json").write_text(json.dumps(lists))
    return folder


def test_convert_says_how_hard_and_writes(three_sweeps, tmp_path, capsys):
    words = ("--train-split", "walk", "--eval-split", "back")
    assert run("convert", three_sweeps, *words, "--out", tmp_path / "out", "--plot", tmp_path / "p.png") == 0
    printed = capsys.readouterr().out
    assert "9 photos to train on, 2 to be scored on, 1 in neither" in printed
    printed = " ".join(printed.split())
    assert "the other sweep 2 1.000 (1.000) 0.0 (0.0) deg" in printed
    assert "every 8th training photo 2 0.250 (0.250)" in printed
    assert (tmp_path / "p.png").stat().st_size > 10_000
    meta = json.loads((tmp_path / "out" / "transforms.json").read_text())
    assert len(meta["frames"]) == 11
    assert meta["test_filenames"] == ["images/09.png", "images/10.png"]
    assert run("convert", tmp_path / "out") == 0  # train and eval are there now
    assert "9 photos to train on, 2 to be scored on, 0 in neither" in capsys.readouterr().out
    assert run("convert", three_sweeps, *words, "--out", tmp_path / "out") == 2
    assert "is there already and not empty" in capsys.readouterr().err


def test_convert_holds_every_eighth_out(three_sweeps, tmp_path, capsys):
    words = ("--train-split", "walk", "--every", 8, "--out", tmp_path / "out", "--link")
    assert run("convert", three_sweeps, *words, "--plot", tmp_path / "p.png") == 0
    printed = capsys.readouterr().out
    assert "7 photos to train on, 2 to be scored on, 3 in neither" in printed
    assert "every 8th training photo 2 0.250 (0.250)" in " ".join(printed.split())
    assert "the other sweep" not in printed
    meta = json.loads((tmp_path / "out" / "transforms.json").read_text())
    assert meta["val_filenames"] == ["images/00.png", "images/08.png"]
    assert (tmp_path / "out" / "images" / "03.png").is_symlink()


def test_convert_takes_lists_and_leaves_missing_photos_out(three_sweeps, tmp_path, capsys):
    (three_sweeps / "10.png").unlink()
    (tmp_path / "lists.json").write_text(json.dumps({"train": ["00.png", "01.png"], "eval": ["01.png", "10.png"]}))
    words = ("convert", three_sweeps, "--splits", tmp_path / "lists.json")
    assert run(*words) == 2
    assert "1 of the 12 photos that transforms.json names are not in" in capsys.readouterr().err
    assert run(*words, "--missing", "drop") == 0
    printed = capsys.readouterr().out
    assert "10.png; left out" in printed
    assert "1 photos are in both sweeps: they were trained on" in printed
    assert "this is no test of novel views" in printed


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "--train-split must say which sweep is meant; the capture has walk, back, third"),
        (("--train-split", "walk"), "--eval-split must say which sweep is meant"),
        (("--train-split", "walk", "--eval-split", "nope"), "no split 'nope'; choose from walk, back, third, all"),
        (("--train-split", "walk", "--every", 1), "--every must be >= 2, got 1"),
        (("--train-split", "walk", "--every", 8, "--eval-split", "back"), "leave --eval-split out"),
        (("--train-split", "third", "--every", 8), "train has no cameras: the measure is not defined"),
        (("--splits", "gone.json"), "has no gone.json"),
    ],
)
def test_convert_names_what_is_wrong(three_sweeps, words, message, tmp_path, capsys):
    assert run("convert", three_sweeps, "--out", tmp_path / "out", *words) == 2
    error = capsys.readouterr().err
    assert error.startswith("unghost convert: ")
    assert message in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
@pytest.mark.shared_data
@pytest.mark.skipif(not SHARED.exists(), reason="the data folder beside the project is absent")
def test_two_folders_of_real_photos_become_a_capture(room, tmp_path, capsys):
    pytest.importorskip("pycolmap")
    splits = json.loads((SHARED / "splits.json").read_text())
    for sweep, files in (("train", splits["trajectory_1"][::2]), ("eval", splits["trajectory_3"][::3][:12])):
        (tmp_path / sweep).mkdir()
        for file in files:
            with Image.open(SHARED / file) as photo:
                photo.resize((504, 378), Image.Resampling.LANCZOS).save(tmp_path / sweep / Path(file).name, quality=95)
    out = tmp_path / "capture"
    assert run("capture", tmp_path / "train", tmp_path / "eval", "--out", out, "--one-lens") == 0
    printed = capsys.readouterr().out
    found, known = load_capture(out, downscale=1), load_capture(SHARED)
    assert len(found) >= 20
    was = json.loads((out / "capture.json").read_text())["frames"]
    index = [known.names.index(f"images/{was[Path(name).name]}") for name in found.names]
    true = known.cameras.camera_to_world[index]
    distance, angle = room.similarity_error(found.cameras.camera_to_world, true)
    assert np.median(distance) < 0.01
    assert np.median(angle) < 1
    assert len(np.unique(found.cameras.intrinsics, axis=0)) == 1
    assert "without a pose, and left out: frame_" in printed


def test_convert_names_its_own_options_and_says_what_is_lost(three_sweeps, tmp_path, capsys):
    (three_sweeps / "03.png").unlink()
    words = ("convert", three_sweeps, "--train-split", "all", "--every", 4)
    assert run(*words) == 2
    assert "(--missing drop leaves them out)" in capsys.readouterr().err
    meta = json.loads((three_sweeps / "transforms.json").read_text())
    (three_sweeps / "transforms.json").write_text(json.dumps({**meta, "ply_file_path": "gone.ply"}))
    assert run(*words, "--missing", "drop", "--out", tmp_path / "out") == 0
    captured = capsys.readouterr()
    assert "ply_file_path leads to no file in 1 of 1 file and is left out there" in captured.out
    assert captured.err == ""


def test_capture_names_its_own_options(tmp_path, capsys):
    for sweep in "ab":
        (tmp_path / sweep).mkdir()
    assert run("capture", tmp_path / "a", tmp_path / "b", "--out", tmp_path / "o", "--frames", 0) == 2
    assert "--frames must be >= 1, got 0" in capsys.readouterr().err
    assert run("capture", tmp_path / "a", tmp_path / "b", "--out", tmp_path / "o", "--minimum-share", 2) == 2
    assert "--minimum-share must be in (0, 1], got 2" in capsys.readouterr().err


def test_ctrl_c_says_that_nothing_is_lost(tmp_path, capsys, monkeypatch):
    from unghost.evaluation.captures import creation

    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(creation, "make_capture", interrupted)
    assert run("capture", tmp_path, tmp_path, "--out", tmp_path / "out") == 130
    said = capsys.readouterr().err
    assert f"kept beside {tmp_path / 'out'}: the same call goes on from there" in said
    assert said.endswith("unghost capture: interrupted\n")
