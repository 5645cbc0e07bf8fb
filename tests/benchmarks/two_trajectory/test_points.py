"""Sparse points of the training photos alone: where they come from, and what rivals make of them."""

import dataclasses
import functools
import json

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("torch")

import torch
from unghost_tests.depth_points import depth_points

from benchmarks.fit_cache import FitCache
from benchmarks.two_trajectory import points as module
from benchmarks.two_trajectory import rivals, scenes
from benchmarks.two_trajectory.changes import changed_share
from benchmarks.two_trajectory.idle import idle_lines
from benchmarks.two_trajectory.job import Job, fine_tuned, sight_lines, visibility
from benchmarks.two_trajectory.tables import independent
from unghost.core.sparse_points import SparsePoints
from unghost.evaluation.captures.loading import load_capture
from unghost.fields.filtered import FilteredField
from unghost.fields.radiance import RadianceConfig, RadianceField


@pytest.fixture
def scene(monkeypatch):
    monkeypatch.setattr(scenes, "FEWEST_SEEN", 0.0)
    return scenes.synthetic_scene(2026, "room-1", photos=4, views=2, width=16, resolution=24)


@pytest.fixture
def job(scene):
    base = RadianceField(RadianceConfig(resolution=24, color_resolution=16, initial_opacity=0.1))
    return Job(dataclasses.replace(scene, points=depth_points(scene)), base, 0, 2, threads=1)


@pytest.fixture
def asked(monkeypatch):
    """Calls of ``triangulate``, which finds one place that every photo shows."""
    calls = []

    def fake(capture, indices, *, longest_side):
        calls.append((capture, [*map(int, indices)], longest_side, capture.images(indices)))
        count = len(indices)
        return SparsePoints.create(np.zeros((1, 3)), point=[0] * count, camera=np.arange(count))

    monkeypatch.setattr(module, "triangulate", fake)
    return calls


@pytest.mark.slow
def test_no_photo_of_the_evaluation_sweep_is_matched(scene, asked, tmp_path):
    cache = FitCache(tmp_path)
    found = module.with_points(scene, cache, match_width=32, fewest=1)
    ((capture, indices, side, photos),) = asked
    assert len(capture) == len(scene.train.cameras) == 4  # no other photo is on disk
    assert (indices, side, photos.shape) == ([0, 1, 2, 3], 32, (4, 24, 32, 3))
    assert np.allclose(capture.cameras.camera_to_world, scene.train.cameras.camera_to_world)  # as told, noise and all
    assert np.allclose(capture.cameras.intrinsics, 2 * scene.train.cameras.intrinsics)
    small = photos.reshape(4, 12, 2, 16, 2, 3).mean(axis=(2, 4))
    assert np.abs(small - scene.train.photos).mean() < 0.05  # the same photos, but for noise and exposure
    other = scenes.Sweep(scene.evaluation.cameras, 1 - scene.evaluation.photos)
    again = module.with_points(dataclasses.replace(scene, evaluation=other), cache, match_width=32, fewest=1)
    assert len(asked) == 1  # from the cache: nothing of the evaluation sweep decides
    assert again.points.camera.tolist() == found.points.camera.tolist() == [0, 1, 2, 3]


@pytest.mark.slow
def test_other_photos_or_sizes_are_triangulated_anew(scene, asked, tmp_path):
    cache = FitCache(tmp_path)
    module.with_points(scene, cache, match_width=32, fewest=1)
    module.with_points(scene, cache, match_width=16, fewest=1)
    part = dataclasses.replace(module.with_points(scene, cache, match_width=32, fewest=1)).every_nth(2)
    assert part.points is None
    assert len(asked) == 2
    assert module.with_points(part, cache, match_width=32, fewest=1).points.camera.max() == len(part.train.photos) - 1
    assert len(asked) == 3


def test_a_scene_with_too_few_points_is_refused(scene, asked, tmp_path):
    with pytest.raises(ValueError, match="1 points come out of the 4 training photos of room-1, fewer than 30"):
        module.with_points(scene, FitCache(tmp_path), match_width=16)


@pytest.fixture
def capture(tmp_path):
    """Sweeps of five and of two photos."""
    folder = tmp_path / "tiny"
    folder.mkdir()
    frames = []
    for index in range(7):
        Image.new("RGB", (24, 18), (30 * index, 90, 40)).save(folder / f"{index}.png")
        pose = np.eye(4)
        pose[:3, 3] = [0.5 * index - 1, 0.2 * (index % 2), 1.5]
        frames.append({"file_path": f"{index}.png", "transform_matrix": pose.tolist()})
    (folder / "transforms.json").write_text(json.dumps({"fl_x": 20.0, "w": 24, "h": 18, "frames": frames}))
    sweeps = {"one": ["1.png", "3.png", "4.png", "5.png", "6.png"], "two": ["0.png", "2.png"]}
    (folder / "splits.json").write_text(json.dumps(sweeps))
    return folder


def test_of_a_capture_the_training_sweep_is_matched(capture, asked, tmp_path):
    scene = scenes.captured_scene(capture, "one", "two", downscale=2)
    module.with_points(scene, FitCache(tmp_path / "cache"), match_side=20, fewest=1)
    part = scene.every_nth(2)
    module.with_points(part, FitCache(tmp_path / "cache"), match_side=20, fewest=1)
    assert [(indices, side) for _, indices, side, _ in asked] == [([1, 3, 4, 5, 6], 20), (part.taught.tolist(), 20)]
    assert sorted([*part.taught, *part.held_out]) == [1, 3, 4, 5, 6]
    assert independent(scene.name) == "tiny"


def test_points_that_are_stored_for_the_sweep_are_taken(capture, asked, tmp_path, monkeypatch):
    scene = scenes.captured_scene(capture, "one", "two", downscale=2)
    folder = capture / "sparse" / "unghost-one"
    folder.mkdir(parents=True)
    (folder / "points3D.txt").write_text("")
    stored = SparsePoints.create(np.ones((1, 3)), point=[0, 0], camera=[0, 4])
    monkeypatch.setattr(type(scene.capture), "points_of", lambda self, split: {"one": stored}[split])
    found = module.with_points(scene, FitCache(tmp_path / "cache"), fewest=1)
    assert (asked, found.points.camera.tolist()) == ([], [0, 4])


@pytest.mark.slow
def test_points_of_a_synthetic_room_lie_on_its_surfaces(monkeypatch, tmp_path):
    pytest.importorskip("pycolmap")
    monkeypatch.setattr(scenes, "FEWEST_SEEN", 0.0)
    scene = scenes.synthetic_scene(2026, "room-1", photos=8, views=2, width=16, resolution=24)
    found = module.with_points(scene, FitCache(tmp_path), match_width=192, fewest=5).points
    off = np.abs(scene.photographed.scene.signed_distance(found.xyz))
    assert np.median(off) < 0.15  # cameras lie in [-1, 1]
    assert found.share_in_view(scene.train.cameras) > 0.9
    assert set(found.camera.tolist()) <= set(range(8))


TERMS = ("ds_nerf", "urban", "nearest_point", "floater_score")


@pytest.mark.parametrize("name", TERMS)
def test_each_rival_uses_the_points(job, name, monkeypatch):
    monkeypatch.setattr(rivals, "POINT_RAYS", 32)
    monkeypatch.setattr(rivals, "POINT_PLACES", 512)
    field = job.base
    losses = [getattr(rivals, name)(job)(field, step) for step in (0, 0, 1)]
    losses[0].backward()
    assert losses[0] > 0
    assert losses[0] == losses[1] != losses[2]
    assert torch.isfinite(field.density_table.grad).all()
    assert field.density_table.grad.abs().max() > 0
    doubled = dataclasses.replace(job.weights, **{name: 2 * getattr(job.weights, name)})
    assert getattr(rivals, name)(dataclasses.replace(job, weights=doubled))(field, 0).item() == pytest.approx(
        2 * losses[0].item()
    )
    without = dataclasses.replace(job, scene=dataclasses.replace(job.scene, points=None))
    with pytest.raises(ValueError, match="room-1 has no sparse points"):
        getattr(rivals, name)(without)


def test_lines_are_counted_where_they_pass_and_where_they_end(job):
    cameras = job.scene.train.cameras
    goal = np.full((1, 3), 0.1)
    points = SparsePoints.create(goal, point=[0, 0], camera=[0, 1], cameras=cameras)
    counts = rivals.LineCounts(dataclasses.replace(job, scene=dataclasses.replace(job.scene, points=points)))
    middle = (cameras.origins[:1] + goal) / 2
    through, ending = counts.at(np.concatenate([goal, middle, -middle]))
    assert ending.tolist() == [2, 0, 0]
    assert through[0] == 0
    assert through[1] >= 1
    assert through[2] == 0
    away = np.linalg.norm(cameras.origins[:2] - goal, axis=1)
    assert rivals.point_reach(points, cameras) == pytest.approx(0.1 * away.mean())


@pytest.mark.slow
def test_what_a_method_changed(job):
    base = job.base
    other = fine_tuned(job).field
    assert changed_share(base, base) == 0
    assert changed_share(other, base) > 0
    assert changed_share(RadianceField(base.config), base) == 0
    everything = FilteredField(base, lambda places: torch.ones(len(places), dtype=bool))
    half = FilteredField(base, lambda places: places[:, 0] > 0)
    assert changed_share(everything, base) == 0
    assert changed_share(half, base) == pytest.approx(0.5, abs=0.05)
    assert changed_share(RadianceField(RadianceConfig(resolution=12, color_resolution=16)), base) == 1


@pytest.mark.slow
def test_losses_that_do_nothing_are_named(job):
    def nothing(job):
        def term(field, step):
            return torch.zeros(())

        return term

    outcome = fine_tuned(job, visibility, nothing(job))
    assert outcome.idle == ("test_losses_that_do_nothing_are_named",)
    assert fine_tuned(job, sight_lines).idle == ()
    blind = SparsePoints.create(job.scene.points.xyz)  # without observations there is no line
    with pytest.warns(UserWarning, match="no line is left"):
        found = fine_tuned(dataclasses.replace(job, scene=dataclasses.replace(job.scene, points=blind)), sight_lines)
    assert found.idle == ("sight_lines",)


def row(method, scene, changed, steps=0, **more):
    return {"method": method, "scene": scene, "seed": 0, "changed_share": changed, "trained_steps": steps, **more}


def test_rows_that_test_nothing_are_named():
    cells = [
        row("fitted", "a", 0.0),
        row("clean", "a", 0.0),
        row("clean", "b", 0.1),
        row("components", "a", 0.0),
        row("components", "b", 0.0),
        row("field", "a", 0.0, 2),
        row("visibility+tv", "a", 0.3, 2, idle=["tv"]),
        row("visibility", "a", 0.3, 2),
        {"method": "old", "scene": "a", "seed": 0, "trained_steps": 2},
    ]
    assert idle_lines(cells) == [
        "tests nothing: field on a, seed 0: no weight of the field changed",
        "tests nothing: visibility+tv on a, seed 0: tv was 0 at every step",
        "tests nothing: components changed no cell on any scene",
    ]


def test_written_captures_are_read_back(scene, tmp_path):
    module.write_capture(tmp_path, scene.train.photos, scene.train.cameras)
    capture = load_capture(tmp_path, downscale=1, normalize=False)
    assert np.allclose(capture.cameras.camera_to_world, scene.train.cameras.camera_to_world)
    assert np.abs(capture.images() - scene.train.photos).max() <= 0.5 / 255 + 1e-6


@pytest.mark.slow
def test_each_pair_of_a_capture_has_points_of_its_own_training_sweep(capture, asked, tmp_path, monkeypatch):
    from benchmarks.two_trajectory import run

    field = RadianceField(RadianceConfig(resolution=16, color_resolution=16, initial_opacity=0.2))
    sweeps = []

    def fitted(options, cache, stage_name, scene, sweep, seed, steps):
        sweeps.append((stage_name, len(sweep.photos), steps))
        return field, 1.0

    monkeypatch.setattr(run, "fitted", fitted)
    monkeypatch.setattr(run, "with_points", functools.partial(module.with_points, fewest=1))
    options = run.Options(
        scenes=(),
        capture_pairs=(f"{capture}:one:two", f"{capture}:two:one"),
        downscale=2,
        capture_steps=(7, 1),
        out=tmp_path,
        cache=tmp_path / "cache",
    )
    stages = list(run.stages(options, FitCache(options.cache)))
    assert [indices for _, indices, _, _ in asked] == [[1, 3, 4, 5, 6], [0, 2]]
    assert [len(stage.scene.points.camera) for stage in stages] == [5, 2]
    assert sweeps == [("pseudo", 7, 7)] * 2  # both sweeps stand for the truth, and nothing else learns of the second
    assert [stage.pseudo.depth.shape for stage in stages] == [(2, 9, 12), (5, 9, 12)]
    keys = [run.Ledger(options).key(stage, 0, method) for stage in stages for method in ("field", "scratch+all")]
    assert ["points" in key for key in keys] == [False, True] * 2
    assert keys[1]["factor"] == [0.03, 0.01, 0.1]
    assert keys[1]["points"] != keys[3]["points"]

    asked.clear()
    without = dataclasses.replace(options, methods=("field", "clean"))
    assert [stage.scene.points for stage in run.stages(without, FitCache(options.cache))] == [None, None]
    assert asked == []  # nobody asks for points
