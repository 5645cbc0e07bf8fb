"""Sparse points in nerfstudio's trained world, without nerfstudio."""

import sys

import numpy as np
import pytest
from unghost_tests.colmap_models import motion, moved, write_model

from unghost.core.cameras import Cameras, look_at
from unghost.integrations.nerfstudio import load_training_points

NAMES = [f"{letter}.png" for letter in "abcdefgh"]
TRAIN = [6, 0, 2, 1, 5]
POINTS = np.random.default_rng(4).normal(0, 0.2, size=(40, 3))
TRACKS = [sorted(np.random.default_rng([5, n]).choice(8, 3, replace=False)) for n in range(40)]
KEPT = [n for n in range(40) if len(set(TRACKS[n]) & set(TRAIN)) >= 2]


def poses():
    rng = np.random.default_rng(0)
    eyes = rng.normal(size=(8, 3)) * [1, 1, 0.2] + [0, 0, 2]
    return look_at(eyes, rng.normal(0, 0.1, size=(8, 3)))


@pytest.fixture
def capture(tmp_path):
    """A model of eight photos in its own world, five of which are trained on in another world, at half the size."""
    pytest.importorskip("pycolmap")
    write_model(tmp_path / "sparse" / "0", poses(), NAMES, POINTS, TRACKS)
    return tmp_path, motion(np.random.default_rng(3), 0.4)


def trained(similarity):
    return Cameras.create(moved(poses(), similarity)[TRAIN], np.array([90.0, 90.0, 50.0, 37.5]), 100, 75)


def photos(folder):
    return [folder / NAMES[k] for k in TRAIN]


def check(points, similarity):
    np.testing.assert_allclose(points.xyz, (POINTS @ similarity[:3, :3].T + similarity[:3, 3])[KEPT], atol=1e-6)
    for number, original in enumerate(KEPT):
        seen = points.camera[points.point == number].tolist()
        assert seen == sorted(TRAIN.index(photo) for photo in TRACKS[original] if photo in TRAIN)


@pytest.mark.parametrize("where", ["images", "images_4", "images/left"])
def test_points_of_training_cameras_in_their_world(capture, where):
    folder, similarity = capture
    found = load_training_points(photos(folder / where), trained(similarity))
    check(found.points, similarity)
    assert 0 < len(KEPT) < 40
    assert found.about.startswith(f"{len(KEPT)} points with ")
    assert "by 5 cameras" in found.about
    assert "3 of its photos are not trained on" in found.about
    assert "not leak-free" in found.about


def test_a_model_of_the_training_photos_alone_comes_first(capture):
    folder, similarity = capture
    position = {photo: k for k, photo in enumerate(TRAIN)}
    tracks = [[position[p] for p in TRACKS[n] if p in position] for n in KEPT]
    own = [NAMES[k] for k in TRAIN]
    write_model(folder / "sparse" / "unghost-train", poses()[TRAIN], [f"images/{n}" for n in own], POINTS[KEPT], tracks)
    write_model(folder / "sparse" / "unghost-few", poses()[TRAIN[:2]], own[:2], POINTS[:1], [(0, 1)])
    for where in ("images", "images_2"):  # its names are those of transforms.json, whatever copy is trained on
        found = load_training_points(photos(folder / where), trained(similarity))
        check(found.points, similarity)
        assert found.about.endswith("unghost-train")
    given = load_training_points(photos(folder / "images"), trained(similarity), model=folder / "sparse" / "0")
    assert "not leak-free" in given.about


def test_photos_that_are_links_lead_to_their_capture(capture, tmp_path_factory):
    folder, similarity = capture
    (folder / "images").mkdir()
    elsewhere = tmp_path_factory.mktemp("written")
    linked = []
    for number, photo in enumerate(photos(folder / "images")):
        photo.write_bytes(b"")
        linked.append(elsewhere / f"frame_{number}.png")
        linked[-1].symlink_to(photo)
    check(load_training_points(linked, trained(similarity)).points, similarity)


def test_without_a_usable_model_it_says_why_and_a_given_one_is_an_error(capture, tmp_path_factory):
    folder, similarity = capture
    nowhere = tmp_path_factory.mktemp("nothing")
    found = load_training_points(photos(nowhere / "a" / "b" / "c" / "images"), trained(similarity))
    assert found.points is None
    assert found.about.startswith("no COLMAP model with points beside the photos")
    other = Cameras.create(poses()[TRAIN][::-1].copy(), np.array([90.0, 90.0, 50.0, 37.5]), 100, 75)
    found = load_training_points(photos(folder / "images"), other)
    assert found.points is None
    assert "posed otherwise" in found.about
    with pytest.raises(ValueError, match="posed otherwise"):
        load_training_points(photos(folder / "images"), other, model=folder)
    with pytest.raises(FileNotFoundError, match=r"unghost_points: .* has no COLMAP model with points"):
        load_training_points(photos(folder / "images"), other, model=nowhere)
    (folder / "sparse" / "0" / "points3D.txt").write_text("1 0 0 0 9 9 9 .4 4 0 5 0\n")  # by evaluation photos
    with pytest.raises(ValueError, match=r"no point of .* was observed by two training cameras"):
        load_training_points(photos(folder / "images"), trained(similarity), model=folder)


def test_without_pycolmap_it_says_so(capture, monkeypatch):
    folder, similarity = capture
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    found = load_training_points(photos(folder / "images"), trained(similarity))
    assert found.points is None
    assert "pip install unghost[capture]" in found.about
    with pytest.raises(ImportError, match=r"pip install unghost\[capture\]"):
        load_training_points(photos(folder / "images"), trained(similarity), model=folder)
