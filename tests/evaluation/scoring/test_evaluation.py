"""``evaluate`` on arrays and folders; the command is in tests/unghost/cli/test_evaluation.py."""

import csv
import importlib
import json
import types

import numpy as np
import pytest
from PIL import Image

import unghost.evaluation
from unghost.core.cameras import Cameras
from unghost.evaluation import Method, Renders, SceneExtent, Truth, evaluate, score_scene
from unghost.evaluation.metrics.perceptual import Lpips

HEIGHT, WIDTH = 12, 16
NAMES = ("a", "b", "c")


def truth(**more):
    photos = np.random.default_rng(0).random((3, HEIGHT, WIDTH, 3)).astype(np.float32)
    return Truth(photos, names=NAMES, **more)


def noisy(scale, seed=1, **maps):
    photos = truth().photos
    error = np.random.default_rng(seed).normal(scale=scale, size=photos.shape)
    return Renders(np.clip(photos + error, 0, 1), **maps)


def run(renders, against=None, **options):
    options = {"resamples": 20, "side_by_side": False, **options}
    return evaluate(renders, truth() if against is None else against, **options)


def test_arrays_are_scored_as_score_scene_scores_them():
    said = []
    results = run({"ours": noisy(0.05), "theirs": noisy(0.1)}, progress=said.append)
    assert said == ["2 methods, 3 views, convention whole_image"]
    assert results.convention == "whole_image"
    assert results.references == ("ours",)
    wanted = score_scene(noisy(0.1), truth(), None, convention="whole_image")
    assert results.scores["theirs"]["psnr"] == pytest.approx(wanted.means()["psnr"])
    assert [each.name for each in results.views["theirs"]] == list(NAMES)
    assert [each.scores["ssim"] for each in results.views["theirs"]] == pytest.approx(wanted.values("ssim"))
    assert [each.pixels for each in results.views["theirs"]] == [HEIGHT * WIDTH] * 3
    assert {(row["method"], row["against"]) for row in results.differences} == {("theirs", "ours")}
    assert results.left_out["ours"] == {"lpips": "no LPIPS network was given (see load_lpips)"}
    assert results.notes[0].startswith("Scored as whole_image: proper needs masks of what the training photos saw")
    assert results.curves["ours"].is_point
    assert results.conventions == {}


def test_a_render_equal_to_its_photo_is_infinite_and_json_says_so():
    results = run(Renders(truth().photos))
    assert list(results.scores) == ["renders"]
    assert results.scores["renders"]["psnr"] == float("inf")
    assert results.views["renders"][0].scores["psnr"] == float("inf")
    row = json.loads(json.dumps(results.to_json(command="c"), allow_nan=False))["rows"][0]
    assert (row["psnr"], "psnr" in row["infinite"]) == (None, True)
    assert " inf" in results.table()


def test_names_come_from_a_mapping_a_method_or_the_place_in_a_sequence():
    two = [noisy(0.1), noisy(0.2)]
    assert list(run(two).scores) == ["renders 1", "renders 2"]
    assert list(run([Method("mine", two[0])], against=None).scores) == ["mine"]
    assert list(run({"b": two[0]}, against=truth()).scores) == ["b"]
    results = evaluate({"b": two[0]}, truth(), against={"a": two[1]}, side_by_side=False, resamples=20)
    assert (list(results.scores), results.references) == (["a", "b"], ("a",))


def test_maps_and_lengths_allow_the_proper_convention():
    poses = np.tile(np.eye(4), (3, 1, 1))
    cameras = Cameras.create(poses, np.array([16.0, 16.0, WIDTH / 2, HEIGHT / 2]), WIDTH, HEIGHT)
    axis = np.full((3, HEIGHT, WIDTH), 2.0)
    rays = np.stack([2.0 / -cameras.rays(index)[1][..., 2] for index in range(3)])
    known = truth(visible=np.ones(axis.shape, dtype=bool), depth=rays, cameras=cameras)
    extent = SceneExtent(limit=6.0, unit=1.0)
    results = run({"ours": noisy(0.1, depth=axis)}, against=known, extent=extent, depth_along="axis")
    assert results.convention == "proper"
    assert results.scores["ours"]["depth_mse"] == pytest.approx(0, abs=1e-12)
    assert results.scores["ours"]["coverage"] == 1
    assert results.notes == ()
    with pytest.raises(ValueError, match="depth_along axis needs the cameras"):
        run({"ours": noisy(0.1, depth=axis)}, depth_along="axis")
    sure = Method("sure", noisy(0.1, depth=rays), np.random.default_rng(0).random(axis.shape))
    curve = run(sure, against=known, extent=extent).curves["sure"]
    assert (len(curve.coverage), curve.metric) == (10, "psnr")


def test_folders_give_the_same_numbers_as_arrays(tmp_path):
    for folder, images in (("photos", truth().photos), ("ours", noisy(0.1).colours)):
        (tmp_path / folder).mkdir()
        for name, image in zip(NAMES, images):
            Image.fromarray(np.round(image * 255).astype(np.uint8)).save(tmp_path / folder / f"{name}.png")
    from_text = evaluate(str(tmp_path / "ours"), str(tmp_path / "photos"), side_by_side=False, resamples=20)
    from_path = evaluate([tmp_path / "ours"], tmp_path / "photos", side_by_side=False, resamples=20)
    named = evaluate({"ours": tmp_path / "ours"}, tmp_path / "photos", side_by_side=False, resamples=20)
    assert from_text.rows == from_path.rows == named.rows
    stored = [
        np.stack([np.asarray(Image.open(tmp_path / folder / f"{name}.png")) / 255 for name in NAMES])
        for folder in ("ours", "photos")
    ]
    arrays = run({"ours": Renders(stored[0])}, against=Truth(stored[1]))
    assert arrays.scores["ours"]["psnr"] == pytest.approx(named.scores["ours"]["psnr"], abs=1e-4)


def test_write_and_page(tmp_path):
    results = run({"ours": noisy(0.05), "theirs": noisy(0.1)})
    results.write(tmp_path / "out", pairs=1, command="mine")
    stored = json.loads((tmp_path / "out" / "results.json").read_text(encoding="utf-8"))
    assert (stored["command"], stored["seeds"]) == ("mine", [0])
    assert stored["evaluation"]["gt"] == "photos in memory"
    assert stored["evaluation"]["notes"] == list(results.notes)
    with (tmp_path / "out" / "images.csv").open(newline="") as stream:
        table = list(csv.DictReader(stream))
    assert [(line["method"], line["view"]) for line in table] == [(m, v) for m in ("ours", "theirs") for v in NAMES]
    results.page(tmp_path / "page.html", pairs=1, command="mine")
    assert (tmp_path / "page.html").read_bytes() == (tmp_path / "out" / "report.html").read_bytes()
    lines = results.table().splitlines()
    assert [line.split()[0] for line in lines[:3]] == ["method", "ours", "theirs"]


def test_a_network_of_the_callers_own_is_used():
    squares = Lpips("squares", lambda first, second: ((first - second) ** 2).mean(axis=-1))
    results = run(noisy(0.1), lpips=squares, metrics=["lpips", "psnr"])
    assert results.scores["renders"]["lpips"] > 0
    assert results.rows[0]["lpips_backbone"] == "squares"
    assert results.sort == "psnr"


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: run([]), "evaluate: no folder of renders is given"),
        (lambda: run(noisy(0.1), sort="flip", metrics=["ssim"]), "sort must be one of the metrics ssim, got 'flip'"),
        (lambda: run(noisy(0.1), sort="depth_mse"), "no view of renders has a depth_mse to sort by, but psnr"),
        (lambda: run({"a": noisy(0.1)}, convention="proper"), "'proper' needs what is not there"),
        (lambda: run([Method("a", noisy(0.1))] * 2), "two methods are called 'a'"),
        (
            lambda: evaluate({"a": noisy(0.1)}, truth(), against={"a": noisy(0.1)}),
            "two methods are called 'a', one of them in against",
        ),
        (
            lambda: run(noisy(0.1), downscale=2.0, masks="masks.npz"),
            r"masks, downscale must be left out with ground truth in memory \(Truth\)",
        ),
        (lambda: run(Renders(truth().photos[:2])), "renders must have the photos' shape"),
    ],
)
def test_mistakes_are_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_inputs_are_left_alone():
    renders, known = noisy(0.1), truth()
    before = renders.colours.copy(), known.photos.copy()
    run({"a": renders}, against=known, side_by_side=True)
    np.testing.assert_array_equal(renders.colours, before[0])
    np.testing.assert_array_equal(known.photos, before[1])


def test_the_same_seed_gives_the_same_intervals():
    first, second = (run({"a": noisy(0.1), "b": noisy(0.2)}) for _ in range(2))
    assert first.rows == second.rows
    assert first.differences == second.differences


def test_no_module_shadows_the_function():
    importlib.import_module("unghost.evaluation.scoring.evaluation")
    assert isinstance(unghost.evaluation.evaluate, types.FunctionType)
