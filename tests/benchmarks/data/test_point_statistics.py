"""Measures of sparse points have the values that they must, and real and simulated ones are told apart."""

import dataclasses
import json

import numpy as np
import pytest

pytest.importorskip("torch")

from unghost_tests.benches import check_short, refusal

from benchmarks.data import harvest_page, point_figure, point_statistics
from benchmarks.data.point_measures import Measured, PointSet, measure, photo_contrast, pixel_size, texture
from unghost.core.cameras import Cameras, look_at
from unghost.core.sparse_points import SparsePoints


def floor_points(lifted=0):
    """A hundred points of the plane z = 0 that four cameras see, the first ``lifted`` 0.3 above it, and photos."""
    eyes = np.array([[0.6, 0.0, 1.0], [-0.6, 0.0, 1.0], [0.0, 0.6, 1.0], [0.0, -0.6, 1.0]])
    cameras = Cameras.create(look_at(eyes, np.zeros((4, 3))), np.array([100.0, 100.0, 50.0, 50.0]), 100, 100)
    rng = np.random.default_rng(0)
    xyz = np.append(rng.uniform(-0.3, 0.3, size=(100, 2)), np.zeros((100, 1)), axis=1)
    xyz[:lifted, 2] = 0.3
    point = np.repeat(np.arange(100), np.tile([2, 3, 3, 4], 25))
    camera = np.concatenate([np.arange(count) for count in np.tile([2, 3, 3, 4], 25)])
    points = SparsePoints.create(xyz, point=point, camera=camera, cameras=cameras, error=np.full(100, 0.6))
    return PointSet(points, cameras, {0: rng.random((100, 100))}, lambda positions: positions[:, 2])


def measured(**numbers):
    return Measured({"points": 9.0, **numbers}, {"error": np.arange(5.0)})


def test_short():
    check_short(point_statistics, scenes=("room-1",), harvest=1)


def test_what_is_missing(monkeypatch, capsys):
    assert "needs CAPTURES" in refusal(point_statistics, monkeypatch, capsys)
    assert "no nowhere" in refusal(point_statistics, monkeypatch, capsys, "--short", "--captures", "nowhere=a")


def test_tracks_errors_and_wrong_points():
    numbers = measure(floor_points(lifted=20), np.random.default_rng(0)).numbers
    assert numbers["points"] == 100
    assert numbers["views"] == pytest.approx(3.0)
    assert [numbers[f"views_{count}"] for count in (2, 3, 4, 5)] == [0.25, 0.5, 0.25, 0.0]
    assert [numbers[f"error_{key}"] for key in ("p10", "p50", "p90")] == pytest.approx([0.6] * 3)
    assert numbers["wrong"] == pytest.approx(0.2)  # 0.3 of the scene is far more than 5 pixels of 0.012
    assert numbers["off_pixels_p50"] == pytest.approx(0.0, abs=1e-9)
    right = measure(floor_points(), np.random.default_rng(0)).numbers
    assert right["wrong"] == 0.0
    assert right["off_sigmas_p90"] == pytest.approx(0.0, abs=1e-9)


def test_unknown_surface_leaves_its_measures_out():
    known = floor_points()
    names = {*measure(known, np.random.default_rng(0)).numbers}
    less = {*measure(dataclasses.replace(known, surface=None), np.random.default_rng(0)).numbers}
    assert names - less == {
        "wrong",
        *(f"off_{unit}_{key}" for unit in ("pixels", "sigmas") for key in ("p10", "p50", "p90")),
    }


def test_side_of_a_pixel():
    pose = look_at(np.array([[0.0, 0.0, 2.0], [0.0, 1.0, 4.0]]), np.zeros((2, 3)))
    cameras = Cameras.create(pose, np.array([100.0, 100.0, 50.0, 50.0]), 100, 100)
    points = SparsePoints.create(np.zeros((1, 3)), point=[0], camera=[0])
    assert pixel_size(points, cameras) == pytest.approx([0.02])  # 2 units away, 100 pixels focal length


def test_contrast_of_a_ramp_is_nothing_and_of_noise_something():
    ramp = np.tile(np.linspace(0, 1, 40), (30, 1))
    rng = np.random.default_rng(0)
    pixels = np.array([[20.0, 15.0], [7.3, 9.8], [1.0, 15.0]])
    assert photo_contrast(ramp, pixels) == pytest.approx([0.0, 0.0], abs=1e-6)  # the third is too near the border
    assert photo_contrast(rng.random((30, 40)), pixels[:2]).min() > 0.05
    # saddle x y of step 1.5 pixels: mixed differences 1.5^2 (x, y), and at its centre both eigenvalues are equal
    x, y = np.meshgrid(np.arange(21) + 0.5 - 10.5, np.arange(21) + 0.5 - 10.5)
    assert photo_contrast(0.01 * x * y, np.array([[10.5, 10.5]])) == pytest.approx([0.01 * 1.5**2 / 2])


def test_points_where_texture_is_rank_high():
    found = floor_points()
    photo = np.full((100, 100), 0.5)
    pixels, _, _ = found.cameras.project(0, found.points.xyz)
    spots = np.zeros((100, 100), dtype=bool)
    for column, row in np.floor(pixels).astype(int):
        spots[row - 4 : row + 5, column - 4 : column + 5] = True
    photo[spots] = np.random.default_rng(1).random(int(spots.sum()))
    ratio, rank = texture(dataclasses.replace(found, photos={0: photo}), np.random.default_rng(0))
    assert ratio > 10
    assert 0.6 < rank <= 1.0
    _, anywhere = texture(dataclasses.replace(found, photos={0: np.full((100, 100), 0.5)}), np.random.default_rng(0))
    assert anywhere == 0.5


def test_medians_that_lie_farther_apart_than_real_sets_do():
    rows = [
        point_statistics.Row("triangulated, capture", "a", [measured(views=3.0, error=0.5)]),
        point_statistics.Row("triangulated, synthetic", "b", [measured(views=3.4, error=0.7)]),
        point_statistics.Row("simulated", "b", [measured(views=2.4, error=0.6), measured(views=2.6, error=0.9)]),
    ]
    found = point_statistics.compared(rows)
    assert found["views"]["real"] == [3.0, 3.2, 3.4]
    assert found["views"]["simulated"][1] == pytest.approx(2.5)
    assert (found["views"]["outside"], found["error"]["outside"]) == (True, False)
    summary = rows[2].summary()
    assert (summary["sets"], summary["views"], summary["spread"]["views"]) == (2, 2.5, [2.42, 2.58])
    assert "spread" not in rows[0].summary()


def test_simulated_sets_are_in_the_frame_of_the_matched_photos(monkeypatch):
    from unghost.scenes.generator import photograph, random_scene

    rng = np.random.default_rng([0, 3])
    shot = photograph(rng, random_scene(rng), count=8, width=32, height=24)
    (found,) = point_statistics.simulated_sets(3, shot, {}, width=128, fixed=True, draws=1)
    assert found.cameras.size(0) == (128, 96)
    assert found.points.share_in_view(found.cameras) > 0.95
    off = np.abs(found.surface(found.points.xyz)) / pixel_size(found.points, found.cameras)
    assert np.median(off) < 8
    monkeypatch.setattr(point_statistics, "FEWEST", len(found.points) + 1)
    assert [*point_statistics.simulated_sets(3, shot, {}, width=128, fixed=True, draws=1)] == []


def test_photos_of_the_middle_of_a_sweep():
    assert point_statistics.spread_over(20, 4) == [4, 8, 11, 15]
    assert point_statistics.spread_over(2, 4) == [0, 1]


def test_sets_of_a_row_weigh_the_same():
    many, few = Measured({}, {"error": np.zeros(9000)}), Measured({}, {"error": np.ones(10)})
    assert point_figure.pooled([many, few], "error").mean() == 0.5


def test_a_table_of_the_measures(tmp_path):
    (tmp_path / "results").mkdir()
    rows = [
        point_statistics.Row("triangulated, capture", "a", [measured(views=3.0)]),
        point_statistics.Row("simulated", "b", [measured(views=2.5)]),
    ]
    stored = {"rows": [row.summary() for row in rows], "compared": point_statistics.compared(rows), "command": "again"}
    (tmp_path / "results" / "points.json").write_text(json.dumps(stored), encoding="utf-8")
    lines = harvest_page.points_table(tmp_path)
    assert "| photos that observed a point, mean | 3.00 (3.00 to 3.00) | 2.50 (2.50 to 2.50) | yes |" in lines
    assert lines[-1] == "`again`"
