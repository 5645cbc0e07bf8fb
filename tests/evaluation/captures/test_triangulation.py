import json

import numpy as np
import pytest
from PIL import Image
from unghost_tests import textured_room

from unghost import cli
from unghost.core.cameras import Cameras
from unghost.evaluation.captures.loading import load_capture
from unghost.evaluation.captures.points import points_folder
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
    assert f"{len(points)} points" in capsys.readouterr().out
    again = load_capture(room, downscale=2).points_of("train")
    np.testing.assert_allclose(again.xyz, points.xyz, atol=1e-9)
    np.testing.assert_array_equal(again.camera, points.camera)
    assert cli.main(["points", str(room)]) == 2
    assert "is there already: remove it" in capsys.readouterr().err
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
