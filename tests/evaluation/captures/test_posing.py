"""Poses by COLMAP of rendered and of real photos, against the known ones up to a similarity."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from unghost.evaluation.captures import posing as posing_module
from unghost.evaluation.captures.colmap import read_model
from unghost.evaluation.captures.loading import load_capture
from unghost.evaluation.captures.posing import PosingSettings, pose_jointly
from unghost.evaluation.captures.transforms import read_frames

pytest.importorskip("pycolmap")

SHARED = Path(__file__).parents[3].parent / "shared" / "data" / "captures" / "snowmiku_plush"


def _save(folder, prefix, photos):
    folder.mkdir(exist_ok=True)
    names = [f"{prefix}{number:02d}.png" for number in range(len(photos))]
    for name, photo in zip(names, photos):
        Image.fromarray(photo).save(folder / name)
    return names


@pytest.fixture(scope="module")
def posed(room, tmp_path_factory):
    """Two arcs about the corner of a painted room, posed on one thread."""
    folder = tmp_path_factory.mktemp("room")
    rigs = {"train": room.arc(np.linspace(15, 60, 8), 1.0), "eval": room.arc(np.linspace(30, 70, 6), 1.5, 2.6)}
    sweeps = {
        sweep: _save(folder / "images", sweep, room.photograph(rig, room.walls(0))) for sweep, rig in rigs.items()
    }
    true = np.concatenate([rig.camera_to_world for rig in rigs.values()])
    told = []
    posing = pose_jointly(
        folder / "images",
        sweeps,
        out=folder / "sparse" / "0",
        settings=PosingSettings(threads=1),
        progress=lambda *step: told.append(step),
    )
    return folder, sweeps, true, posing, told


@pytest.mark.slow
def test_rendered_sweeps_are_posed_together_as_they_were(posed, room):
    folder, sweeps, true, posing, _ = posed
    assert posing.posed == {sweep: tuple(names) for sweep, names in sweeps.items()}
    assert posing.unposed == ()
    assert posing.reprojection_error < 0.6
    capture = load_capture(folder, downscale=1)
    index = [capture.names.index(f"images/{name}") for names in sweeps.values() for name in names]
    distance, angle = room.similarity_error(capture.cameras.camera_to_world[index], true)
    assert np.median(distance) < 0.005
    assert distance.max() < 0.02
    assert np.median(angle) < 1
    np.testing.assert_allclose(capture.cameras.intrinsics[:, :2], room.FOCAL, rtol=0.02)
    lenses = np.unique(np.concatenate([capture.cameras.intrinsics, capture.cameras.distortion], axis=1), axis=0)
    assert len(lenses) == 2  # one a sweep
    assert (folder / "sparse" / "0" / "points3D.ply").stat().st_size > 10 * posing.points


@pytest.mark.slow
def test_progress_counts_to_the_end(posed):
    told = posed[-1]
    assert list(dict.fromkeys(stage for stage, _, _ in told)) == ["features", "pairs", "poses"]
    for stage, total in (("features", 14), ("pairs", 14 * 13 // 2), ("poses", 14)):
        steps = [done for name, done, of in told if name == stage and of == total]
        assert steps == sorted(steps)
        assert steps[-1] == total


@pytest.mark.slow
def test_on_one_thread_a_seed_gives_the_same_poses(posed, tmp_path):
    folder, sweeps, *_ = posed
    pose_jointly(folder / "images", sweeps, out=tmp_path / "again", settings=PosingSettings(threads=1))
    for name in ("cameras.bin", "images.bin"):
        assert (tmp_path / "again" / name).read_bytes() == (folder / "sparse" / "0" / name).read_bytes()


@pytest.mark.slow
def test_sweeps_of_two_rooms_are_not_joined_and_counted(room, tmp_path):
    sweeps = {
        "train": _save(tmp_path / "in", "a", room.photograph(room.arc([20, 28, 36, 44], 1.0), room.walls(1))),
        "eval": _save(tmp_path / "in", "b", room.photograph(room.arc([40, 50, 60], 1.2), room.walls(2))),
    }
    with pytest.raises(ValueError, match=r"no part joins at least 50% of each sweep.*train \d of 4, eval 0 of 3"):
        pose_jointly(tmp_path / "in", sweeps, out=tmp_path / "out", settings=PosingSettings(one_lens=True))
    assert not (tmp_path / "out").exists()


def test_photos_that_show_nothing_are_not_posed(tmp_path):
    sweeps = {
        sweep: _save(tmp_path / "in", sweep, np.full((3, 96, 128, 3), 90, np.uint8)) for sweep in ("train", "eval")
    }
    with pytest.raises(ValueError, match=r"COLMAP posed no photos \(train 0 of 3, eval 0 of 3\)"):
        pose_jointly(tmp_path / "in", sweeps, out=tmp_path / "out")


def test_one_photo_alone_has_no_pose(tmp_path):
    names = _save(tmp_path / "in", "a", np.full((1, 96, 128, 3), 90, np.uint8))
    with pytest.raises(ValueError, match=r"posed no photos \(train 0 of 1\)"):
        pose_jointly(tmp_path / "in", {"train": names}, out=tmp_path / "out")


@pytest.mark.parametrize("sweeps", [{}, {"a": []}, {"a": ["1.png"], "b": ["1.png"]}, {"a": ["1.png"], "b": []}])
def test_sweeps_that_make_no_sense_are_refused(tmp_path, sweeps):
    with pytest.raises(ValueError, match="sweeps must have a photo each and share none"):
        pose_jointly(tmp_path, sweeps, out=tmp_path / "out")
    with pytest.raises(ValueError, match=r"no spaces in them, got 'my photo\.png'"):
        pose_jointly(tmp_path, {"a": ["my photo.png"]}, out=tmp_path / "out")


@pytest.mark.parametrize("changes", [{"minimum_share": 0}, {"longest_side": 8}, {"seed": -1}, {"threads": -1}])
def test_settings_that_make_no_sense_are_refused(changes):
    with pytest.raises(ValueError, match=next(iter(changes))):
        PosingSettings(**changes)


@pytest.mark.slow
@pytest.mark.shared_data
@pytest.mark.skipif(not SHARED.exists(), reason="the data folder beside the project is absent")
def test_two_dozen_photos_of_a_real_capture_get_the_poses_that_it_came_with(room, tmp_path):
    splits = json.loads((SHARED / "splits.json").read_text())
    chosen = {"train": splits["trajectory_1"][::2], "eval": splits["trajectory_3"][::3][:12]}
    (tmp_path / "in").mkdir()
    for file in (*chosen["train"], *chosen["eval"]):
        with Image.open(SHARED / file) as photo:
            photo.resize((504, 378), Image.Resampling.LANCZOS).save(tmp_path / "in" / Path(file).name, quality=95)
    sweeps = {sweep: [Path(file).name for file in files] for sweep, files in chosen.items()}
    assert [len(names) for names in sweeps.values()] == [12, 12]
    posing = pose_jointly(tmp_path / "in", sweeps, out=tmp_path / "out")
    assert sum(map(len, posing.posed.values())) >= 20
    _, found, poses = read_frames(read_model(tmp_path / "out"), "the model")
    capture = load_capture(SHARED)
    true = capture.cameras.camera_to_world[[capture.names.index(f"images/{name}") for name in found]]
    distance, angle = room.similarity_error(poses, true)
    assert np.median(distance) < 0.01  # of the capture's extent; 0.0028 reached
    assert np.median(angle) < 1  # 0.42 reached
    assert angle.max() < 2


@pytest.mark.slow
def test_what_was_killed_goes_on_to_the_same_poses(posed, tmp_path, monkeypatch):
    folder, sweeps, _, posing, _ = posed
    arguments = {"settings": PosingSettings(threads=1), "work": tmp_path / "work"}
    (tmp_path / "work").mkdir()
    monkeypatch.setattr(posing_module, "MATCH_AT_ONCE", 40)

    def killed(stage, done, total):
        if (stage, done) == ("pairs", 40):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        pose_jointly(folder / "images", sweeps, out=tmp_path / "out", progress=killed, **arguments)
    steps = []
    for _ in range(2):  # the second time, from the stored model
        again = pose_jointly(
            folder / "images", sweeps, out=tmp_path / "out", progress=lambda *step: steps.append(step), **arguments
        )
        assert again.posed == posing.posed
        assert again.reprojection_error == pytest.approx(posing.reprojection_error, rel=0.05)
    assert [step for step in steps if step[0] == "pairs" and step[1] == 0] == []
    assert "features" not in {stage for stage, _, _ in steps}
    assert steps[-1][0] == "pairs"
