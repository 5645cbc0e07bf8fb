import json
import sys

import numpy as np
import pytest
from PIL import Image
from unghost_tests import textured_room

from unghost import cli
from unghost.core.cameras import Cameras
from unghost.evaluation.captures import triangulation
from unghost.evaluation.captures.loading import load_capture
from unghost.evaluation.captures.points import points_folder
from unghost.evaluation.captures.posing import pairs_to_match
from unghost.evaluation.captures.transforms import write_transforms
from unghost.evaluation.captures.triangulation import _lens, _quaternion, triangulate

pytest.importorskip("pycolmap")
TRAIN, EVAL = 6, 3


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """A capture of a corner of a room, whose walls are the planes x = 0, y = 0, z = 0: two sweeps."""
    folder = tmp_path_factory.mktemp("room")
    train, other = textured_room.arc(np.linspace(20, 70, TRAIN), 1.4), textured_room.arc(np.linspace(25, 60, EVAL), 1.9)
    paintings = textured_room.walls(3)
    names = []
    (folder / "images").mkdir()
    for sweep, cameras in (("train", train), ("eval", other)):
        for number, photo in enumerate(textured_room.photograph(cameras, paintings)):
            names.append(f"images/{sweep} {number}.png")
            Image.fromarray(photo).save(folder / names[-1])
    poses = np.concatenate([train.camera_to_world, other.camera_to_world])
    cameras = Cameras.create(poses, train.intrinsics[0], train.width, train.height)
    write_transforms(folder / "transforms.json", cameras, names, {})
    sweeps = {"train": names[:TRAIN], "eval": names[TRAIN:]}
    (folder / "splits.json").write_text(json.dumps(sweeps), encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def found(room):
    capture = load_capture(room, downscale=2, normalize=True)
    return capture, triangulate(capture, capture.split("train"), threads=1)


@pytest.mark.slow
def test_points_lie_on_the_walls(found):
    capture, points = found
    world = (points.xyz - capture.transform[:3, 3]) / capture.scale_factor
    off = np.abs(world).min(axis=1)  # distance to the nearest of the three planes
    assert len(points) > 200
    assert np.median(off) < 0.01  # of a room 4 units wide, cameras at 3
    assert (off < 0.1).mean() > 0.9
    assert points.share_in_view(capture.cameras.select(capture.split("train"))) > 0.99
    assert points.views().min() >= 2
    assert points.camera.max() < TRAIN


@pytest.mark.slow
def test_uncertainty_bounds_what_is_wrong(found):
    capture, points = found
    off = np.abs((points.xyz - capture.transform[:3, 3]) / capture.scale_factor).min(axis=1)
    sigma = points.uncertainty / capture.scale_factor
    assert (off < 3 * sigma).mean() > 0.8


@pytest.mark.slow
def test_nothing_of_the_other_sweep_is_read(room, found, tmp_path):
    """Evaluation photos painted over, one deleted, their poses changed: the points stay, to the last bit."""
    _, points = found
    meta = json.loads((room / "transforms.json").read_text())
    (tmp_path / "images").mkdir()
    for number, frame in enumerate(meta["frames"]):
        with Image.open(room / frame["file_path"]) as stored:
            picture = stored.copy()
        if number >= TRAIN:
            picture = Image.new("RGB", picture.size, (200, 30, number))
            frame["transform_matrix"][0][3] += 0.01 * number
        picture.save(tmp_path / frame["file_path"])
    del meta["frames"][-1]
    (tmp_path / "transforms.json").write_text(json.dumps(meta))
    sweeps = json.loads((room / "splits.json").read_text())
    (tmp_path / "splits.json").write_text(json.dumps({"train": sweeps["train"], "eval": sweeps["eval"][:-1]}))
    plain = {"downscale": 2, "normalize": False}
    changed = load_capture(tmp_path, **plain)
    one = triangulate(load_capture(room, **plain), load_capture(room, **plain).split("train"), threads=1)
    other = triangulate(changed, changed.split("train"), threads=1)
    for name in ("xyz", "point", "camera", "error", "uncertainty"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    assert len(one) == len(points)


@pytest.mark.slow
def test_the_verb_stores_them_and_the_capture_finds_them(room, found, capsys):
    capture, points = found
    assert cli.main(["points", str(room), "--threads", "1"]) == 0
    told = capsys.readouterr().out
    assert f"{len(points)} points, {len(points.point)} observations by {TRAIN} photos" in told
    assert " points dropped: " in told
    again = load_capture(room, downscale=2).points_of("train")
    np.testing.assert_allclose(again.xyz, points.xyz, atol=1e-9)
    np.testing.assert_array_equal(again.camera, points.camera)
    np.testing.assert_allclose(again.uncertainty, points.uncertainty, rtol=1e-6)  # whatever size is loaded
    assert cli.main(["points", str(room)]) == 2
    assert "is there already: remove it" in capsys.readouterr().err
    stored = points_folder(room, "train")
    before = {path.name: path.read_bytes() for path in stored.iterdir()}
    with pytest.raises(ValueError, match=r"triangulate: .* is there already: remove it, or choose another out"):
        triangulate(capture, capture.split("train"), out=stored)
    assert {path.name: path.read_bytes() for path in stored.iterdir()} == before
    with pytest.raises(FileNotFoundError, match="has no points of the photos of 'eval' alone: run unghost points"):
        capture.points_of("eval")
    with pytest.raises(FileNotFoundError, match="has no COLMAP model"):
        _ = load_capture(room).points  # not these, which know one sweep only
    points_folder(room, "train").rename(points_folder(room, "eval"))
    with pytest.raises(ValueError, match=r"holds photos that are not in 'eval', such as images/train 0\.png"):
        capture.points_of("eval")


@pytest.mark.parametrize("indices", [[], [0], [0, 0], [0, 99], [-1, 0]])
def test_fewer_than_two_photos_are_refused(room, indices):
    with pytest.raises(ValueError, match="triangulate: indices must"):
        triangulate(load_capture(room), indices)


@pytest.mark.slow
def test_photos_without_features_are_said_to_show_nothing_alike(tmp_path):
    names = ["a.png", "b.png"]
    for name in names:
        Image.new("RGB", (64, 48), (90, 90, 90)).save(tmp_path / name)
    cameras = textured_room.arc(np.array([30.0, 40.0]), 1.0)
    write_transforms(
        tmp_path / "transforms.json", Cameras.create(cameras.camera_to_world, [50, 50, 32, 24], 64, 48), names, {}
    )
    with pytest.raises(ValueError, match="nothing matches in the 2 photos"):
        triangulate(load_capture(tmp_path, downscale=1), [0, 1], out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_lenses_are_those_of_the_photos_own_size(room):
    capture = load_capture(room, downscale=4)
    model, width, height, fx, *_ = _lens(capture, 0)
    assert (model, width, height) == ("OPENCV", textured_room.WIDTH, textured_room.HEIGHT)
    assert fx == pytest.approx(textured_room.FOCAL)


def test_quaternions_turn_as_their_matrices():
    rng = np.random.default_rng(0)
    for _ in range(20):
        w, x, y, z = (given := rng.normal(size=4) / 1) / np.linalg.norm(given)
        matrix = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        expected = np.array([w, x, y, z]) * (1 if w >= 0 else -1)
        np.testing.assert_allclose(_quaternion(matrix), expected, atol=1e-12)


@pytest.mark.slow
def test_what_is_dropped_is_counted_and_is_not_in_the_model(room, found, tmp_path):
    import pycolmap

    capture, points = found
    told, options = [], {"threads": 1}
    everything = triangulate(capture, capture.split("train"), most_error=np.inf, least_angle=0, **options)
    strict = triangulate(
        capture, capture.split("train"), out=tmp_path / "out", most_error=0.5, least_angle=5, log=told.append, **options
    )
    assert len(strict) < len(points) <= len(everything)
    assert strict.error.max() <= 0.5
    assert strict.angles(capture.cameras.select(capture.split("train"))).min() >= 5
    (line,) = told
    assert line.startswith(f"{len(everything) - len(strict)} of {len(everything)} points dropped: ")
    assert pycolmap.Reconstruction(tmp_path / "out").num_points3D() == len(strict)
    with pytest.raises(ValueError, match=r"triangulate: no point is left: \d+ of \d+ points dropped"):
        triangulate(capture, capture.split("train"), out=tmp_path / "none", most_error=1e-9, **options)
    assert not (tmp_path / "none").exists()


@pytest.mark.slow
def test_sequential_matching_finds_most_of_what_every_pair_gives(room, found):
    capture, points = found
    totals = {}
    for overlap in (1, 10):
        few = triangulate(
            capture,
            capture.split("train"),
            matching="sequential",
            overlap=overlap,
            threads=1,
            progress=lambda stage, done, total: totals.__setitem__((stage, overlap), total),  # noqa: B023
        )
        if overlap == 10:
            assert len(few) == len(points)  # of six photos that is every pair
        else:
            assert 0.5 * len(points) < len(few)
    assert totals["pairs", 1] == 5 + 4 + 2  # 1, 2 and 4 further on
    assert totals["pairs", 10] == TRAIN * (TRAIN - 1) // 2


@pytest.mark.slow
def test_two_photos_give_points(room):
    capture = load_capture(room, downscale=2, normalize=False)
    points = triangulate(capture, capture.split("train")[2:4], threads=1)
    assert len(points) > 20
    assert np.median(np.abs(points.xyz).min(axis=1)) < 0.05  # distance to the nearest wall


@pytest.mark.slow
@pytest.mark.parametrize("moment", ["points", "copy"])
def test_an_interruption_leaves_nothing_half_written(room, tmp_path, monkeypatch, moment):
    capture = load_capture(room, downscale=2)

    def interrupted(*_):
        raise KeyboardInterrupt

    def progress(stage, done, total):
        if stage == moment:
            interrupted()

    if moment == "copy":
        monkeypatch.setattr(triangulation.shutil, "copyfile", interrupted)
    with pytest.raises(KeyboardInterrupt):
        triangulate(capture, capture.split("train")[:2], out=tmp_path / "out", threads=1, progress=progress)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"matching": "every"}, "matching must be one of exhaustive, sequential, got 'every'"),
        ({"overlap": 0}, "overlap must be >= 1 photo, got 0"),
        ({"most_error": 0}, "triangulate: most_error must be > 0 pixels, got 0"),
        ({"least_angle": 200}, "triangulate: least_angle must be in"),
        ({"longest_side": 8}, "longest_side must be >= 64 pixels, got 8"),
        ({"seed": -1}, "seed and threads must be >= 0"),
        ({"threads": -2}, "seed and threads must be >= 0"),
    ],
)
def test_options_out_of_range_are_refused_before_the_work(room, monkeypatch, options, message):
    monkeypatch.setattr(triangulation, "_stored_photos", None)  # not reached
    with pytest.raises(ValueError, match=message):
        triangulate(load_capture(room), [0, 1], **options)


def test_a_colmap_that_is_missing_or_too_old_is_said_before_the_work(room, monkeypatch, capsys):
    capture = load_capture(room)
    monkeypatch.setattr(triangulation, "_stored_photos", None)  # not reached
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(ImportError, match=r"triangulate: COLMAP needs pycolmap: pip install unghost\[capture\]"):
        triangulate(capture, [0, 1])
    assert cli.main(["points", str(room), "--photos-of", "eval", "--out", str(room / "new")]) == 2
    assert "pip install unghost[capture]" in capsys.readouterr().err
    assert not (room / "new").exists()
    monkeypatch.delitem(sys.modules, "pycolmap")
    import pycolmap

    monkeypatch.delattr(pycolmap, "extract_features")
    with pytest.raises(ImportError, match=r"triangulate: pycolmap .* lacks extract_features: pip install"):
        triangulate(capture, [0, 1])


def test_a_sweep_of_one_photo_and_an_unknown_one_are_one_line(room, tmp_path, capsys):
    name = load_capture(room).names[0]
    (tmp_path / "splits.json").write_text(json.dumps({"train": [name]}), encoding="utf-8")
    for options in (["--splits", str(tmp_path / "splits.json")], ["--photos-of", "nobody"]):
        assert cli.main(["points", str(room), "--out", str(tmp_path / "out"), *options]) == 2
        assert len(capsys.readouterr().err.strip().splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_pairs_of_a_sequence_grow_with_its_length_alone():
    names = [str(number) for number in range(300)]
    pairs = pairs_to_match(names, 10)
    assert len(pairs) == len(set(pairs)) == sum(300 - step for step in (*range(1, 11), 16, 32, 64, 128, 256))
    assert all(int(one) < int(other) for one, other in pairs)
    assert pairs_to_match(["a"], 10) == []
    assert set(pairs_to_match(names[:5], 10)) == set(pairs_to_match(names[:5]))
