import dataclasses
import json

import numpy as np
import pytest

from unghost.core.cameras import Cameras
from unghost.evaluation.metrics import pixelwise as metrics
from unghost.evaluation.scoring import comparison
from unghost.evaluation.scoring.comparison import choose_convention, compare_methods, possible_conventions
from unghost.evaluation.scoring.conventions import CONVENTIONS, PLAIN_CONVENTIONS, SceneExtent
from unghost.evaluation.scoring.renders import Method
from unghost.evaluation.scoring.views import Renders, Truth

SIZE = (16, 20)
EXTENT = SceneExtent(limit=6.0, unit=1.5)


def scene(views=3):
    rng = np.random.default_rng(0)
    photos = rng.random((views, *SIZE, 3)) * 0.8 + 0.1
    visible = np.zeros((views, *SIZE), dtype=bool)
    visible[:, :, :10] = True
    poses = np.tile(np.eye(4), (views, 1, 1))
    poses[:, 0, 3] = np.arange(views)
    cameras = Cameras.create(poses, np.array([20.0, 20, 10, 8]), SIZE[1], SIZE[0])
    return Truth(photos, visible, np.full((views, *SIZE), 2.5), cameras=cameras)


def method(name, truth, *, noise, removed=0, confidence=False, seed=1):
    """Noise that grows downwards; ``removed`` rows at the bottom have no surface; sure at the top."""
    rng = np.random.default_rng(seed)
    down = np.linspace(0.2, 1, SIZE[0])[None, :, None, None]
    colours = truth.photos + rng.normal(scale=noise, size=truth.photos.shape) * down
    depth = np.full(truth.photos.shape[:3], 2.0)
    if removed:
        depth[:, -removed:] = np.inf
    sure = np.broadcast_to(-down[..., 0], depth.shape).copy() if confidence else None
    return Method(name, Renders(np.clip(colours, 0, 1), depth, np.where(np.isfinite(depth), 1.0, 0.0)), sure)


def run(methods, truth, **settings):
    settings = {"convention": "proper", "resamples": 40, "side_by_side": False} | settings
    return compare_methods(methods, truth, EXTENT, np.random.default_rng(0), **settings)


def test_common_pixels_and_equal_coverage_by_hand():
    truth = scene()
    whole, less = method("whole", truth, noise=0.05, confidence=True), method("less", truth, noise=0.05, removed=8)
    rows = {row["method"]: row for row in run([whole, less], truth)["rows"]}
    assert rows["whole"]["coverage"] == pytest.approx(0.5)
    assert rows["less"]["coverage"] == pytest.approx(0.25)
    assert rows["less"]["psnr"] > rows["whole"]["psnr"]  # easier pixels, the very same renders
    assert rows["less"]["psnr_common"] == rows["whole"]["psnr_common"] == rows["less"]["psnr"]
    assert rows["whole"]["coverage_common"] == pytest.approx(0.25)
    at_quarter = next(each for each in rows["whole"]["curve"] if each["coverage"] == pytest.approx(0.25))
    upper = truth.visible[0] & (np.arange(SIZE[0]) < 8)[:, None]
    every = np.broadcast_to(upper, (3, *SIZE))
    pooled = metrics.psnr(
        whole.renders.colours[every][None],
        truth.photos[every][None],
        np.ones((1, every.sum()), dtype=bool),
        data_range=1.0,
    )
    assert at_quarter["psnr"] == pytest.approx(pooled)
    assert len(rows["whole"]["curve"]) == 10
    assert "curve" not in rows["less"]


def test_giving_up_whole_views_is_not_rewarded_by_a_mean_over_the_views_that_are_left():
    truth = scene(4)
    colours, noise = truth.photos.copy(), (0.01, 0.05, 0.1, 0.2)
    for view, each in enumerate(noise):
        colours[view] += each
    depth, sure = np.full((4, *SIZE), 2.0), np.broadcast_to(np.arange(4)[::-1, None, None], (4, *SIZE)).astype(float)
    (row,) = run([Method("a", Renders(np.clip(colours, 0, 1), depth, np.ones_like(depth)), sure)], truth)["rows"]
    by = {round(each["share_kept"], 2): each["psnr"] for each in row["curve"]}
    kept = {1.0: (1, 1, 1, 1), 0.8: (1, 1, 1, 0.2), 0.5: (1, 1, 0, 0)}
    exact = [np.mean((np.clip(colours[view], 0, 1) - truth.photos[view])[:, :10] ** 2) for view in range(4)]
    for share, views in kept.items():  # .2 of the last view are those first in the picture: within a tenth of a dB
        assert by[share] == pytest.approx(-10 * np.log10(np.average(exact, weights=views)), abs=0.1)
    assert row["point"]["psnr"] == pytest.approx(by[1.0])
    assert row["psnr"] == pytest.approx(np.mean(-10 * np.log10(exact)))


def test_a_curve_meets_a_point_at_the_points_coverage():
    truth = scene()
    found = run(
        [method("knob", truth, noise=0.05, confidence=True), method("point", truth, noise=0.2, removed=8)], truth
    )
    (row,) = found["against_points"]
    assert (row["method"], row["point"]) == ("knob", "point")
    assert row["coverage"] == pytest.approx(0.25)
    assert row["ahead"] > 6
    assert found["rows"][0]["at_coverage"] == pytest.approx(0.5)


def test_differences_are_paired_and_equal_renders_differ_by_nothing():
    truth = scene()
    first, worse = method("a", truth, noise=0.05), method("b", truth, noise=0.1)
    again = dataclasses.replace(first, name="again")
    found = run([first, worse, again], truth, references=["a"])
    by = {(row["method"], row["metric"]): row for row in found["differences"]}
    rows = {row["method"]: row for row in found["rows"]}
    assert by["b", "psnr"]["difference"] == pytest.approx(rows["b"]["psnr"] - rows["a"]["psnr"])
    assert by["b", "psnr"]["high"] < 0
    assert (by["again", "psnr"]["difference"], by["again", "psnr"]["low"], by["again", "psnr"]["high"]) == (0, 0, 0)
    assert rows["again"]["intervals"] == rows["a"]["intervals"]
    assert by["b", "psnr_common"]["images"] == 3


def test_an_empty_mask_is_a_row_without_numbers_and_one_empty_view_is_left_out():
    truth = scene()
    gone = method("gone", truth, noise=0.05, removed=SIZE[0], confidence=True)
    half = method("half", truth, noise=0.05)
    half.renders.depth[1] = np.inf
    found = run([gone, half], truth, references=["half"], side_by_side=True)
    rows = {row["method"]: row for row in found["rows"]}
    assert (rows["gone"]["psnr"], rows["gone"]["images_scored"], rows["gone"]["coverage"]) == (None, 0, 0)
    assert rows["gone"]["psnr_common"] is None
    assert rows["half"]["images_scored"] == 2
    assert rows["half"]["per_image"][1]["psnr"] is None
    values = [row["psnr"] for row in rows["half"]["per_image"] if row["psnr"] is not None]
    assert rows["half"]["psnr"] == pytest.approx(np.mean(values))
    assert [row["metric"] for row in found["differences"]] == [
        "coverage",
        "dice",
        "iou",
        "mask_recall",
    ]  # defined for both, and no other
    json.dumps(found, allow_nan=False)


def test_one_view_has_no_interval_and_a_perfect_render_is_infinite_not_nan():
    truth = scene(1)
    exact = Method("exact", Renders(truth.photos.copy(), np.full((1, *SIZE), 2.0)))
    found = run([exact, method("other", truth, noise=0.1)], truth, references=["other"], side_by_side=True)
    row = found["rows"][0]
    assert row["psnr"] is None
    assert row["infinite"] == ["psnr"]
    assert row["per_image"][0]["infinite"] == ["psnr"]
    assert row["intervals"]["ssim"] == [None, None]
    assert row["ssim"] == pytest.approx(1)
    assert "psnr" not in {each["metric"] for each in found["differences"]}  # infinite less a number says nothing
    json.dumps(found, allow_nan=False)


def test_every_convention_stands_beside_the_others_and_none_is_averaged():
    truth = scene()
    found = run([method("a", truth, noise=0.05, removed=8)], truth, side_by_side=True)
    table = {row["metric"]: row for row in found["conventions"]["a"]}
    assert set(table["psnr"]) == {"metric", "spread", *CONVENTIONS, *PLAIN_CONVENTIONS}
    assert table["psnr"]["proper"] == found["rows"][0]["psnr"]
    assert table["psnr"]["whole_image"] < table["psnr"]["proper"] < table["psnr"]["nerfbaselines"]
    # a quarter is left; all_pixels divides by everything: 10 log10(1 / .25) dB, but for 8 bits
    assert table["psnr"]["nerfbaselines"] - table["psnr"]["proper"] == pytest.approx(10 * np.log10(4), abs=0.1)
    assert found["rows"][0]["convention"] == "proper"
    assert set(found) == {"rows", "against_points", "differences", "conventions"}


def test_which_conventions_the_maps_allow():
    truth = scene()
    full = method("full", truth, noise=0.1)
    colours = Method("colours", Renders(full.renders.colours))
    assert possible_conventions([full], truth, EXTENT) == comparison.EVERY_CONVENTION
    assert possible_conventions([colours], truth, EXTENT) == ("visible_only", "whole_image")
    assert possible_conventions([full, colours], Truth(truth.photos), None) == ("whole_image",)
    assert choose_convention(None, [full], truth, EXTENT) == "proper"
    assert choose_convention(None, [full, colours], truth, EXTENT) == "visible_only"
    assert choose_convention("paper_code", [full], truth, EXTENT) == "paper_code"
    message = r"'proper' needs what is not there \(colours: depth beside the renders\); .* allows visible_only, whole"
    with pytest.raises(ValueError, match=message):
        choose_convention("proper", [full, colours], truth, EXTENT)
    with pytest.raises(ValueError, match="full: the cameras of both sweeps"):
        choose_convention("proper", [full], truth, None)
    with pytest.raises(ValueError, match=r"must be one of proper, .* got 'nonsense'"):
        choose_convention("nonsense", [full], truth, EXTENT)


def test_a_metric_that_is_asked_for_needs_its_maps():
    truth = scene()
    no_depth = dataclasses.replace(truth, depth=None)
    with pytest.raises(ValueError, match=r"depth_mse was asked for, but there is no truth\.depth"):
        run([method("a", truth, noise=0.1)], no_depth, keys=["depth_mse"])
    row = run([method("a", truth, noise=0.1)], no_depth)["rows"][0]
    assert row["depth_mse"] is None
    assert "no truth.depth" in row["notes"]["depth_mse"]
    only = run([method("a", truth, noise=0.1)], truth, keys=["ssim"])["rows"][0]
    assert only["psnr"] is None
    assert only["ssim"] is not None


def test_names_and_sizes_are_checked():
    truth = scene()
    one = method("a", truth, noise=0.1)
    with pytest.raises(ValueError, match="of different names, got"):
        run([one, one], truth)
    with pytest.raises(ValueError, match="of different names, got"):
        run([], truth)
    with pytest.raises(ValueError, match=r"references must be among \['a'\], got \['b'\]"):
        run([one], truth, references=["b"])
    small = Method("a", Renders(one.renders.colours[:, 1:], one.renders.depth[:, 1:]))
    with pytest.raises(ValueError, match=r"photos' shape \(3, 16, 20, 3\), got \(3, 15, 20, 3\)"):
        run([small], truth)


def test_nan_confidence_counts_only_where_a_pixel_does():
    truth = scene()
    knob = method("knob", truth, noise=0.1, confidence=True)
    knob.confidence[:, :, 10:] = np.nan  # not visible
    assert len(run([knob], truth)["rows"][0]["curve"]) == 10
    knob.confidence[0, 0, 0] = np.nan
    with pytest.raises(ValueError, match="1 confidences in the mask are NaN"):
        run([knob], truth)
