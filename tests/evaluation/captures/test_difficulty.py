"""Difficulty of a capture, by hand; and the picture of its sweeps from above."""

import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from unghost.core.cameras import Cameras
from unghost.evaluation.captures.birds_eye import draw_birds_eye, ground_plane
from unghost.evaluation.captures.difficulty import (
    difficulty,
    difficulty_rows,
    difficulty_text,
    every_nth,
    normalising_factor,
)
from unghost.evaluation.captures.loading import load_capture

SHARED = Path(__file__).parents[3].parent / "shared" / "data" / "captures" / "snowmiku_plush"


def turn(degrees):
    """About +Y."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def cameras(*places_and_turns):
    poses = [np.column_stack([turn(degrees), place]) for place, degrees in places_and_turns]
    return Cameras.create(np.reshape(poses, (-1, 3, 4)), [20.0, 20.0, 8.0, 6.0], 16, 12)


TRAIN = cameras(([0, 0, 0], 0), ([4, 0, 0], 10))
SCORED = cameras(([0, 3, 0], 30), ([4, 1, 0], 10))


def test_by_hand():
    # origins (0,0,0), (4,0,0), (0,3,0), (4,1,0): mean (2,1,0), farthest coordinate 2 (x of each, y of (0,3,0))
    assert normalising_factor(TRAIN, SCORED) == pytest.approx(1 / 2)
    found = difficulty(TRAIN, SCORED)
    np.testing.assert_allclose(found.translation, [3 / 2, 1 / 2], atol=1e-12)  # to the first; to the second
    np.testing.assert_allclose(found.rotation_deg, [30, 0], atol=1e-9)
    np.testing.assert_array_equal(found.nearest, [0, 1])


def test_rows_and_their_table():
    train = cameras(*(([k, 0, 0], 5 * k) for k in range(9)))
    scored = cameras(([0, 4, 0], 20), ([8, 4, 0], 40))
    # 11 origins, mean x 4, mean y 8/11: farthest coordinate 4
    two, eighth = difficulty_rows(train, scored)
    assert (two["train_photos"], two["photos"]) == (9, 2)
    assert two["translation_to_nearest"] == pytest.approx(1)
    assert two["rotation_to_nearest_deg"] == pytest.approx(10)  # 20 and 0
    assert two["rotation_to_nearest_deg_largest"] == pytest.approx(20)
    assert (eighth["method"], eighth["train_photos"], eighth["photos"]) == ("every 8th training photo", 7, 2)
    assert eighth["translation_to_nearest"] == pytest.approx(1 / 4)  # its neighbour, in the same units
    assert eighth["rotation_to_nearest_deg"] == pytest.approx(5)
    text = difficulty_text([two, eighth])
    assert "the other sweep 2" in " ".join(text.split())
    assert "1.000 (1.000)" in text
    assert "no test of novel views" not in text


def test_identical_trajectories_have_no_difficulty_and_that_is_said():
    # a tripod: the first and the last stand in one place and look elsewhere
    sweep = cameras(([0, 0, 0], 0), ([1, 0, 0], 40), ([0, 0, 0], 90))
    found = difficulty(sweep, sweep)
    np.testing.assert_array_equal(found.translation, 0)
    np.testing.assert_array_equal(found.rotation_deg, 0)
    np.testing.assert_array_equal(found.nearest, [0, 1, 2])
    assert "this is no test of novel views" in difficulty_text(difficulty_rows(sweep, sweep))


def test_cameras_in_one_place_and_single_cameras_are_defined():
    found = difficulty(cameras(([1, 2, 3], 0)), cameras(([1, 2, 3], 25)))
    assert found.translation.tolist() == [0]
    assert found.rotation_deg.tolist() == [pytest.approx(25)]
    (row,) = difficulty_rows(cameras(([0, 0, 0], 0)), cameras(([0, 0, 2], 180)))  # no 8th of one photo
    assert row["translation_to_nearest"] == pytest.approx(2)  # at -1 and +1
    assert row["rotation_to_nearest_deg"] == pytest.approx(180)


def test_a_sweep_without_cameras_is_refused():
    with pytest.raises(ValueError, match="train has no cameras"):
        difficulty(TRAIN.select([]), SCORED)
    with pytest.raises(ValueError, match="evaluation has no cameras"):
        difficulty(TRAIN, SCORED.select([]))


@given(st.floats(0.01, 100), st.floats(-180, 180), st.integers(0, 2**31))
def test_the_worlds_unit_and_place_do_not_matter(unit, degrees, seed):
    shift = np.random.default_rng(seed).normal(size=3)

    def moved(rig):
        poses = rig.camera_to_world.copy()
        poses[:, :, :3] = turn(degrees) @ poses[:, :, :3]
        poses[:, :, 3] = poses[:, :, 3] * unit + shift
        return Cameras.create(poses, rig.intrinsics, 16, 12)

    here, there = difficulty(TRAIN, SCORED), difficulty(moved(TRAIN), moved(SCORED))
    np.testing.assert_allclose(there.translation, here.translation, rtol=1e-6)
    np.testing.assert_allclose(there.rotation_deg, here.rotation_deg, atol=1e-5)


@pytest.mark.parametrize(
    ("count", "n", "train", "held_out"),
    [(9, 8, [1, 2, 3, 4, 5, 6, 7], [0, 8]), (1, 8, [], [0]), (0, 8, [], []), (5, 2, [1, 3], [0, 2, 4])],
)
def test_every_nth(count, n, train, held_out):
    found = every_nth(count, n=n)
    assert [indices.tolist() for indices in found] == [train, held_out]


def test_every_nth_refuses():
    with pytest.raises(ValueError, match="n >= 2, got 5 and 1"):
        every_nth(5, n=1)


def test_the_ground_is_below_upright_cameras():
    plane = ground_plane(TRAIN, SCORED)
    np.testing.assert_allclose(plane @ plane.T, np.eye(2), atol=1e-12)
    np.testing.assert_allclose(np.cross(*plane), [0, 1, 0], atol=1e-12)  # seen from above: right-handed
    np.testing.assert_allclose(np.abs(plane[0]), [1, 0, 0], atol=1e-12)  # along which they spread


def test_the_ground_of_cameras_whose_ups_cancel_is_where_they_spread():
    """Straight down, each turned differently: rotations about z of a camera with +Y in the plane."""
    poses = []
    for k in range(4):
        angle = np.pi / 2 * k
        c, s = np.cos(angle), np.sin(angle)
        poses.append(np.column_stack([[[c, -s, 0], [s, c, 0], [0, 0, 1]], [2 * c, s, 0.01 * k]]))
    rig = Cameras.create(np.array(poses), [20.0, 20.0, 8.0, 6.0], 16, 12)
    assert abs(np.cross(*ground_plane(rig))[2]) > 0.99
    one = ground_plane(TRAIN.select([0]))
    np.testing.assert_allclose(one @ one.T, np.eye(2), atol=1e-12)


def _colour_count(path, colour):
    from matplotlib.image import imread

    pixels = np.rint(imread(path)[..., :3] * 255).astype(int)
    return int((pixels == colour).all(axis=-1).sum())


@pytest.mark.slow
@pytest.mark.parametrize("train", [TRAIN, TRAIN.select([0]), SCORED])
def test_both_sweeps_are_drawn(tmp_path, train):
    draw_birds_eye(tmp_path / "new" / "plot.png", train, SCORED, title="two sweeps")
    assert _colour_count(tmp_path / "new" / "plot.png", (0x1A, 0x1A, 0x1A)) > 30
    assert _colour_count(tmp_path / "new" / "plot.png", (0xD6, 0x27, 0x28)) > 60


def test_without_matplotlib_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    monkeypatch.setitem(sys.modules, "matplotlib.backends.backend_agg", None)
    with pytest.raises(ImportError, match=r"pip install unghost\[eval\]"):
        draw_birds_eye(tmp_path / "plot.png", TRAIN, SCORED)


@pytest.mark.shared_data
@pytest.mark.skipif(not SHARED.exists(), reason="the data folder beside the project is absent")
def test_every_8th_photo_hides_the_difficulty_of_the_real_capture():
    capture = load_capture(SHARED)
    train, scored = (capture.cameras.select(capture.split(f"trajectory_{number}")) for number in (1, 3))
    two, eighth = difficulty_rows(train, scored)
    assert two["translation_to_nearest"] > 2 * eighth["translation_to_nearest"]
    assert two["rotation_to_nearest_deg"] > 2 * eighth["rotation_to_nearest_deg"]
