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

pycolmap = pytest.importorskip("pycolmap")

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


def model_of(names):
    """A reconstruction that has poses of these photos and nothing else."""
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=1, model="PINHOLE", width=64, height=48, params=np.array([60.0, 60, 32, 24]))
    )
    for number, name in enumerate(names, start=1):
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.0, 0.1 * number, 0])), np.array([0.1, 0, 4.0]))
        model.add_image_with_trivial_frame(pycolmap.Image(name=name, camera_id=1, image_id=number), pose)
    return model


def write_parts(folder, parts):
    for number, names in enumerate(parts):
        (folder / str(number)).mkdir(parents=True)
        model_of(names).write_binary(folder / str(number))
    return [model_of(names) for names in parts]


SWEEPS = {"train": ["a1", "a2", "a3", "a4"], "eval": ["b1", "b2", "b3"]}


@pytest.fixture
def colmap(monkeypatch):
    """COLMAP's costly steps replaced: ``set(incremental, joined)`` gives the photos of the parts of each mapping."""
    calls = []

    def set_parts(incremental, joined):
        def map_globally(database, folder, parts, options):
            calls.append("global")
            if isinstance(joined, BaseException):
                raise joined
            write_parts(parts, joined)

        def map_incrementally(colmap, database, folder, parts, *_):
            calls.append("incremental")
            return write_parts(parts, incremental)

        monkeypatch.setattr(posing_module, "_map", map_incrementally)
        monkeypatch.setattr(pycolmap, "global_mapping", map_globally)
        return calls

    monkeypatch.setattr(posing_module, "_with_simple_lenses", lambda colmap, database, target: target)
    for step in ("_extract", "match_pairs"):
        monkeypatch.setattr(posing_module, step, lambda *_, **__: None)
    return set_parts


SPLIT = [["a1", "a2", "a3", "b1"], ["b2", "b3", "a4"]]


@pytest.mark.parametrize(
    ("incremental", "joined", "posed", "line"),
    [
        (
            SPLIT,
            [["a1", "a2", "a3", "a4", "b2", "b3"]],
            6,
            "global mapping, 6 photos; incremental mapping split them into parts of 4, 3",
        ),
        (SPLIT, [SPLIT[0]], 4, "incremental mapping, 4 photos of parts of 4, 3; global mapping joined 4"),
        (SPLIT, [], 4, "incremental mapping, 4 photos of parts of 4, 3; global mapping joined 0"),
        (SPLIT, RuntimeError("no"), 4, "incremental mapping, 4 photos of parts of 4, 3; global mapping joined 0"),
        ([SPLIT[0]], [], 4, "incremental mapping, 4 photos"),
    ],
)
def test_of_both_mappings_the_one_with_more_photos_is_taken_and_said(
    tmp_path, colmap, incremental, joined, posed, line
):
    calls = colmap(incremental, joined)
    how = PosingSettings(minimum_share=0.25)
    posing = pose_jointly(tmp_path, SWEEPS, out=tmp_path / "out", settings=how, work=tmp_path)
    assert sum(map(len, posing.posed.values())) == posed
    assert posing.mapping == line
    assert calls == ["incremental", "global"][: len(incremental)]
    assert pycolmap.Reconstruction(tmp_path / "out").num_reg_images() == posed
    again = pose_jointly(tmp_path, SWEEPS, out=tmp_path / "out", settings=how, work=tmp_path)
    assert (again.posed, again.mapping) == (posing.posed, posing.mapping)
    assert len(calls) == len(incremental)  # both are stored


def test_a_pycolmap_without_global_mapping_does_without(tmp_path, colmap, monkeypatch):
    calls = colmap(SPLIT, [["a1"]])
    monkeypatch.delattr(pycolmap, "global_mapping")
    posing = pose_jointly(tmp_path, SWEEPS, out=tmp_path / "out", settings=PosingSettings(minimum_share=0.25))
    assert posing.mapping.startswith("incremental mapping, 4 photos of parts of 4, 3")
    assert calls == ["incremental"]


def test_parts_of_both_mappings_are_told_apart_where_none_will_do(tmp_path, colmap):
    colmap(SPLIT, [["a1", "a2", "a3", "a4"]])
    with pytest.raises(
        ValueError, match=r"part 1: train 3 of 4, eval 1 of 3; .*by global mapping, part 3: train 4 of 4"
    ):
        pose_jointly(tmp_path, SWEEPS, out=tmp_path / "out", settings=PosingSettings(minimum_share=0.9))


def test_an_interrupted_global_mapping_is_begun_again_and_one_that_took_the_process_down_is_not(tmp_path, colmap):
    how = {"out": tmp_path / "out", "settings": PosingSettings(minimum_share=0.25), "work": tmp_path}
    colmap(SPLIT, KeyboardInterrupt())
    with pytest.raises(KeyboardInterrupt):
        pose_jointly(tmp_path, SWEEPS, **how)
    assert not (tmp_path / "out").exists()
    calls = colmap(SPLIT, [["a1", "a2", "a3", "a4", "b1"]])
    assert pose_jointly(tmp_path, SWEEPS, **how).mapping.startswith("global mapping, 5 photos")
    state = posing_module._State(tmp_path)
    state.save(tried=True, joined=False)  # as a killed process leaves it
    before = len(calls)
    assert pose_jointly(tmp_path, SWEEPS, **how).mapping.startswith("incremental mapping, 4 photos")
    assert len(calls) == before


@pytest.mark.slow
def test_global_mapping_poses_rendered_sweeps_as_they_were(posed, room, tmp_path, monkeypatch):
    if not hasattr(pycolmap, "global_mapping"):
        pytest.skip("this pycolmap has no global mapping")
    folder, sweeps, true, *_ = posed
    split = [names[:3] for names in sweeps.values()]
    monkeypatch.setattr(posing_module, "_map", lambda *arguments: write_parts(arguments[3], split))
    settings = PosingSettings(threads=1, minimum_share=0.1)
    posing = pose_jointly(folder / "images", sweeps, out=tmp_path / "sparse" / "0", settings=settings)
    assert posing.mapping == "global mapping, 14 photos; incremental mapping split them into parts of 3, 3"
    _, found, poses = read_frames(read_model(tmp_path / "sparse" / "0"), "the model")
    order = [found.index(name) for names in sweeps.values() for name in names]
    distance, angle = room.similarity_error(poses[order], true)
    assert np.median(distance) < 0.02
    assert np.median(angle) < 2
    lenses = pycolmap.Reconstruction(tmp_path / "sparse" / "0").cameras.values()
    assert [lens.model.name for lens in lenses] == ["SIMPLE_RADIAL"] * 2
    np.testing.assert_allclose([lens.mean_focal_length() for lens in lenses], room.FOCAL, rtol=0.03)
