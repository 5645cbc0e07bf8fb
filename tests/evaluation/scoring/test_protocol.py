import numpy as np
import pytest

from unghost.core.cameras import Cameras
from unghost.evaluation.metrics import pixelwise as metrics
from unghost.evaluation.scoring import protocol

WIDTH, HEIGHT, WALL = 20, 16, 4.0


def _cameras(offsets, *, focal=20.0, distortion=None):
    """Cameras at ``offsets (n, 3)``, all looking along -z."""
    poses = np.tile(np.eye(4), (len(offsets), 1, 1))
    poses[:, :3, 3] = offsets
    return Cameras.create(poses, np.array([focal, focal, WIDTH / 2, HEIGHT / 2]), WIDTH, HEIGHT, distortion)


def _wall_depth(cameras, z=-WALL):
    """Distance along unit rays to the plane z."""
    depths = []
    for index in range(len(cameras)):
        origins, directions = cameras.rays(index)
        depths.append((z - origins[..., 2]) / directions[..., 2])
    return np.stack(depths)


TRAIN = _cameras([[0.0, 0, 0], [1.0, 0, 0]])
EVAL = _cameras([[0.5, 0, 0], [3.0, 0, 0]])
LIMIT = 6.0  # origins reach from x = 0 to x = 3


def _render(depth, colour):
    return [{"rgb": c, "depth": d} for c, d in zip(colour, depth)]


def _scene(seed=0):
    photos = np.random.default_rng(seed).random((2, HEIGHT, WIDTH, 3))
    pseudo = _wall_depth(EVAL)
    visible = protocol.visibility_masks(EVAL, pseudo, TRAIN)
    return photos, pseudo, visible


def test_depth_limit_is_twice_the_widest_baseline_over_both_sweeps():
    assert protocol.depth_limit(TRAIN, EVAL) == pytest.approx(LIMIT)
    assert protocol.depth_limit(TRAIN, TRAIN) == pytest.approx(2.0)
    with pytest.raises(ValueError, match="two distinct camera origins"):
        protocol.depth_limit(_cameras([[0.0, 0, 0]]), _cameras([[0.0, 0, 0]]))


def test_visibility_of_a_wall_by_hand():
    # half the image is 10 pixels of 1 / 20, so a frustum is z / 2 = 2 to either side at the wall
    _, _, visible = _scene()
    for index, eye in enumerate((0.5, 3.0)):
        points = eye + (np.arange(WIDTH) + 0.5 - WIDTH / 2) / 20 * WALL
        seen = (np.abs(points) <= 2) | (np.abs(points - 1) <= 2)
        np.testing.assert_array_equal(visible[index], np.broadcast_to(seen, (HEIGHT, WIDTH)))
    assert visible[0].all()
    assert 0 < visible[1].mean() < 1


def test_visibility_can_ask_for_more_views():
    pseudo = _wall_depth(EVAL)
    twice = protocol.visibility_masks(EVAL, pseudo, TRAIN, minimum_views=2)
    once = protocol.visibility_masks(EVAL, pseudo, TRAIN)
    assert twice.sum() < once.sum()
    assert not (twice & ~once).any()
    with pytest.raises(ValueError, match="minimum_views must be >= 1, got 0"):
        protocol.visibility_masks(EVAL, pseudo, TRAIN, minimum_views=0)


def test_a_pixel_without_surface_is_taken_to_be_far_away():
    away = np.diag([-1.0, 1.0, -1.0, 1.0])[None]  # turned about y: looks along +z
    lens = np.array([20.0, 20.0, WIDTH / 2, HEIGHT / 2])
    nothing = np.full((1, HEIGHT, WIDTH), np.inf)
    behind = Cameras.create(away, lens, WIDTH, HEIGHT)
    eye = _cameras([[1.0, 0.0, 0.0]])
    # a camera with a wider view, one unit aside, sees every far point; one looking away sees none
    assert protocol.visibility_masks(eye, nothing, _cameras([[0.0, 0, 0]], focal=15.0)).all()
    assert not protocol.visibility_masks(eye, nothing, behind).any()


def test_a_lens_that_bends_changes_what_is_visible():
    bent = _cameras([[3.0, 0, 0]], distortion=np.array([-0.2, 0, 0, 0, 0, 0]))
    straight = _cameras([[3.0, 0, 0]])
    masks = [protocol.visibility_masks(each, _wall_depth(each), TRAIN) for each in (straight, bent)]
    assert (masks[0] != masks[1]).any()


def test_occlusion_aware_visibility_hides_what_stands_behind_something():
    pseudo = _wall_depth(EVAL)
    open_view = protocol.visibility_masks(EVAL, pseudo, TRAIN, train_depth=_wall_depth(TRAIN))
    np.testing.assert_array_equal(open_view, protocol.visibility_masks(EVAL, pseudo, TRAIN))
    blocked = protocol.visibility_masks(EVAL, pseudo, TRAIN, train_depth=_wall_depth(TRAIN, z=-1.0))
    assert not blocked.any()


def test_a_perfect_rendering_scores_perfectly():
    photos, pseudo, visible = _scene()
    found = protocol.score(_render(pseudo, photos), photos, pseudo, EVAL, visible=visible, limit=LIMIT)
    assert found["psnr"] == float("inf")
    assert found["ssim"] == pytest.approx(1)
    assert found["depth_mse"] == found["disparity_mae"] == 0
    assert found["normal_mean_deg"] == pytest.approx(0, abs=1e-4)
    assert found["normal_pct_30"] == 1
    assert found["coverage"] == pytest.approx((visible & (pseudo < LIMIT)).mean())
    assert found["views_scored"] == 2
    assert found["convention"] == "paper masks (visible, depth < 6), means over views, ssim map_mean"


def test_scores_are_means_over_views_of_the_metrics():
    photos, pseudo, visible = _scene()
    rendered = _render(pseudo * 1.1, np.clip(photos + np.reshape([0.1, -0.2], (2, 1, 1, 1)), 0, 1))
    found = protocol.score(rendered, photos, pseudo, EVAL, visible=visible, limit=LIMIT)
    masks = visible & (pseudo * 1.1 < LIMIT)
    parts = [metrics.psnr(rendered[i]["rgb"], photos[i], masks[i], data_range=1.0) for i in range(2)]
    assert found["psnr"] == pytest.approx(np.mean(parts))
    errors = [np.mean((0.1 * pseudo[i][masks[i]]) ** 2) for i in range(2)]
    assert found["depth_mse"] == pytest.approx(np.mean(errors))
    wanted = {
        "psnr",
        "ssim",
        "depth_mse",
        "disparity_mae",
        "normal_mean_deg",
        "normal_median_deg",
        "normal_pct_30",
        "coverage",
        "convention",
        "psnr_visible",
        "views_scored",
    }
    assert set(found) == wanted


def test_removing_everything_gives_no_coverage_and_no_number():
    photos, pseudo, visible = _scene()
    rendered = _render(np.full_like(pseudo, np.inf), np.zeros_like(photos))
    found = protocol.score(rendered, photos, pseudo, EVAL, visible=visible, limit=LIMIT)
    assert found["coverage"] == 0
    assert found["views_scored"] == 0
    assert all(np.isnan(found[key]) for key in ("psnr", "ssim", "depth_mse", "disparity_mae", "normal_mean_deg"))
    assert np.isfinite(found["psnr_visible"])  # black where the photo is not: removal is not free there
    assert protocol.json_ready(found)["psnr"] is None


def test_pseudo_depth_is_clipped_so_that_no_error_exceeds_the_limit():
    photos, pseudo, visible = _scene()
    endless = np.full_like(pseudo, 1e4)
    found = protocol.score(_render(pseudo, photos), photos, endless, EVAL, visible=visible, limit=LIMIT)
    assert 0 < found["depth_mse"] < LIMIT**2
    assert np.isnan(found["normal_mean_deg"])  # no surface to compare with


def test_common_pixels_make_methods_comparable():
    photos, pseudo, visible = _scene()
    colours = np.clip(photos + 0.1, 0, 1)
    holed = pseudo.copy()
    holed[:, :, :10] = np.inf
    masks = [visible & protocol.depth_masks(each, LIMIT) for each in (pseudo, holed)]
    shared = protocol.common_mask(masks)
    np.testing.assert_array_equal(shared, masks[1])
    scores = [
        protocol.score(_render(each, colours), photos, pseudo, EVAL, visible=visible, limit=LIMIT, common=shared)
        for each in (pseudo, holed)
    ]
    assert scores[0]["psnr"] != scores[1]["psnr"]
    assert scores[0]["psnr_common"] == scores[1]["psnr_common"] == pytest.approx(scores[1]["psnr"])
    assert scores[0]["coverage_common"] == pytest.approx(scores[1]["coverage"])
    assert scores[1]["coverage"] < scores[0]["coverage"]


def test_errors_name_what_is_wrong():
    photos, pseudo, visible = _scene()
    rendered = _render(pseudo, photos)
    with pytest.raises(ValueError, match="score: photos must have shape"):
        protocol.score(rendered, photos[:1], pseudo, EVAL, visible=visible, limit=LIMIT)
    with pytest.raises(ValueError, match="score: pseudo_depth must have shape"):
        protocol.score(rendered, photos, pseudo[:1], EVAL, visible=visible, limit=LIMIT)
    spoilt = pseudo.copy()
    spoilt[0, 0, 0] = np.nan
    with pytest.raises(ValueError, match=r"pseudo_depth must be > 0 .* 1 values are not"):
        protocol.score(rendered, photos, spoilt, EVAL, visible=visible, limit=LIMIT)
    with pytest.raises(ValueError, match="limit must be > 0, got 0"):
        protocol.depth_masks(pseudo, 0)
    with pytest.raises(ValueError, match="at least one mask"):
        protocol.common_mask([])
    with pytest.raises(ValueError, match="must have one shape"):
        protocol.common_mask([visible, visible[:1]])


def test_json_ready_turns_what_json_lacks_into_null():
    nested = {"a": float("nan"), "b": [np.float32(1.5), float("inf")], "c": (np.int64(2), "text", None, True)}
    assert protocol.json_ready(nested) == {"a": None, "b": [1.5, None], "c": [2, "text", None, True]}
