import dataclasses

import numpy as np
import pytest

from unghost.core.cameras import Cameras
from unghost.evaluation.metrics import pixelwise as metrics
from unghost.evaluation.metrics.perceptual import Lpips
from unghost.evaluation.scoring import engine as scoring
from unghost.evaluation.scoring.conventions import CONVENTIONS, DEPTH_KEYS, NORMAL_KEYS, SceneExtent, evaluation_masks
from unghost.evaluation.scoring.protocol import common_mask, visibility_masks
from unghost.evaluation.scoring.views import Renders, Truth

SIZE = (16, 20)
EXTENT = SceneExtent(limit=6.0, unit=1.5)  # the text's limit is 6, the code's 3
SQUARES = Lpips("squares", lambda first, second: ((first - second) ** 2).mean(axis=-1))


def _cameras(count=2):
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 3] = np.arange(count)
    return Cameras.create(poses, np.array([20.0, 20.0, SIZE[1] / 2, SIZE[0] / 2]), SIZE[1], SIZE[0])


def _scene(seed=0):
    """Two views; the left half is seen, the upper three quarters are nearer than 6, the upper half nearer than 3."""
    rng = np.random.default_rng(seed)
    photos = np.round(rng.random((2, *SIZE, 3)) * 255) / 255
    colours = np.round(np.clip(photos + rng.normal(scale=0.1, size=photos.shape), 0, 1) * 255) / 255
    depth = np.full((2, *SIZE), 2.0)
    depth[:, 8:12], depth[:, 12:] = 5.0, np.inf
    visible = np.zeros((2, *SIZE), dtype=bool)
    visible[:, :, :10] = True
    accumulation = np.where(np.isfinite(depth), 0.99, 0.5)
    pseudo = np.full((2, *SIZE), 2.5)
    renders = Renders(colours, depth, accumulation)
    return renders, Truth(photos, visible, pseudo, cameras=_cameras(), names=("a", "b"))


def _area(convention, renders, truth):
    rows, columns = {
        "proper": (12, 10),
        "paper_text": (12, 10),
        "paper_code": (8, 10),
        "bayes_rays_masked": (8, 10),
        "bayes_rays_unmasked": (8, 20),
        "free_space_prior": (12, 20),
        "nerfbaselines": (12, 10),
    }[convention]
    return np.s_[:rows, :columns]


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_each_convention_by_its_own_definition(convention):
    renders, truth = _scene()
    found = scoring.score_scene(renders, truth, EXTENT, convention=convention, network=SQUARES)
    area = _area(convention, renders, truth)
    for index, row in enumerate(found.images):
        preds, target = renders.colours[index][area], truth.photos[index][area]
        squared = (preds - target) ** 2
        share = squared[..., 0].size / (SIZE[0] * SIZE[1])
        assert row["pixels"] == squared[..., 0].size
        wanted = {
            "pooled": -10 * np.log10(squared.mean()),
            "per_channel": np.mean([-10 * np.log10(squared[..., c].mean()) for c in range(3)]),
            "all_pixels": -10 * np.log10(squared.mean() * share),
        }[CONVENTIONS[convention].psnr]
        # truncation to 8 bits may lose a level where the product rounds down
        assert row["psnr"] == pytest.approx(wanted, abs=0.15 if convention == "nerfbaselines" else 1e-9)
        assert row["lpips"] == pytest.approx(squared.mean() * (share if convention == "nerfbaselines" else 1), rel=0.05)


@pytest.mark.parametrize(
    ("convention", "wanted"),
    [
        ("proper", 12 * 10 / (16 * 20)),
        ("paper_text", 12 * 10 / (16 * 20)),
        ("paper_code", 8 / 16),
        ("bayes_rays_masked", 8 / 16),
        ("bayes_rays_unmasked", 8 / 16),
        ("free_space_prior", 12 / 16),
    ],
)
def test_coverage_of_each(convention, wanted):
    found = scoring.score_scene(*_scene(), EXTENT, convention=convention).means()
    assert found["coverage"] == pytest.approx(wanted)


def test_dice_and_what_was_published_under_its_name():
    renders, truth = _scene()
    proper = scoring.score_scene(renders, truth, EXTENT, convention="proper").means()
    # claimed: 12 rows; visible: 10 columns; both: 12 x 10
    assert proper["dice"] == pytest.approx(2 * 120 / (240 + 160))
    assert proper["iou"] == pytest.approx(120 / (240 + 160 - 120))
    assert (proper["mask_precision"], proper["mask_recall"]) == pytest.approx((0.5, 0.75))
    published = scoring.score_scene(renders, truth, EXTENT, convention="free_space_prior").means()
    # predicted: 12 rows; visible: 10 columns; they agree on 12 x 10 and on 4 x 10 of 320
    assert published["dice"] == pytest.approx((120 + 40) / 320)


def test_geometry_is_clipped_properly_and_not_in_the_code():
    renders, truth = _scene()
    pseudo = truth.depth.copy()
    pseudo[:, :4] = 100.0
    truth = dataclasses.replace(truth, depth=pseudo)
    proper = scoring.score_scene(renders, truth, EXTENT, convention="proper").means()
    # of 12 rows: 4 see depth 2 against min(100, 6), 4 see 2 against 2.5, 4 see 5 against 2.5
    assert proper["depth_mse"] == pytest.approx((16 + 0.25 + 6.25) / 3)
    assert proper["disparity_mae"] == pytest.approx((1 / 2 - 1 / 6 + 1 / 2 - 1 / 2.5 + 1 / 2.5 - 1 / 5) / 3)
    code = scoring.score_scene(renders, truth, EXTENT, convention="paper_code").means()
    assert code["depth_mse"] == pytest.approx((98**2 + 0.25) / 2)
    assert code["disparity_mae"] == pytest.approx((1 / 2 - 1 / 100 + 1 / 2 - 1 / 2.5) / 2)
    assert proper["normal_pct_30"] is not None


def test_stored_normals_beyond_the_limit_do_not_count():
    renders, truth = _scene()
    given = np.broadcast_to([0.0, 0.0, 1.0], (*truth.depth.shape, 3)).copy()
    given[:, :4] = (0.0, 1.0, 0.0)
    pseudo = truth.depth.copy()
    pseudo[:, :4] = 100.0
    told = dataclasses.replace(renders, normals=np.broadcast_to([0.0, 0.0, 1.0], given.shape))
    truth = dataclasses.replace(truth, depth=pseudo, normals=given)
    assert scoring.score_scene(told, truth, EXTENT, convention="proper").means()["normal_mean_deg"] == 0.0
    uncut = scoring.score_scene(told, truth, EXTENT, convention="paper_code").means()["normal_mean_deg"]
    assert uncut == pytest.approx(45.0)


def test_given_normals_are_used_and_need_no_cameras():
    renders, truth = _scene()
    tilt = np.radians(40)
    up, tilted = np.zeros((2, *SIZE, 3)), np.zeros((2, *SIZE, 3))
    up[..., 2], tilted[..., 2], tilted[..., 0] = 1, np.cos(tilt), np.sin(tilt)
    truth = dataclasses.replace(truth, normals=up, cameras=None)
    found = scoring.score_scene(
        dataclasses.replace(renders, normals=tilted), truth, EXTENT, convention="proper"
    ).means()
    assert found["normal_mean_deg"] == pytest.approx(40)
    assert found["normal_pct_30"] == 0


def test_bits():
    image = np.array([0.0, 0.4999 / 255, 0.5 / 255, 1.2 / 255, 254.6 / 255, 1.0])
    assert (scoring._through_bits(image, "round") * 255).tolist() == [0, 0, 1, 1, 255, 255]
    assert (scoring._through_bits(image, "truncate") * 255).tolist() == [0, 0, 0, 1, 254, 255]
    assert scoring._through_bits(image, None) is image


def test_an_empty_mask_is_a_defined_row_and_no_nan_in_a_mean():
    renders, truth = _scene()
    depth = renders.depth.copy()
    depth[1] = np.inf
    gone = dataclasses.replace(renders, depth=depth, accumulation=np.zeros_like(depth))
    for convention, rule in CONVENTIONS.items():
        found = scoring.score_scene(gone, truth, EXTENT, convention=convention, network=SQUARES)
        row = found.images[1]
        assert row["pixels"] == 0
        assert all(row[key] is None for key in rule.keys if key not in ("coverage", "dice", "iou", "mask_recall"))
        assert row.get("coverage", 0) == 0
        means = found.means()
        if convention == "free_space_prior":
            assert (means["psnr"], means["images_scored"], means["coverage"]) == (None, 0, 0)
        else:
            assert means["psnr"] == found.images[0]["psnr"]
            assert (means["images"], means["images_scored"]) == (2, 1)
            assert "coverage" not in rule.keys or means["coverage"] == found.images[0]["coverage"] / 2
        assert not any(isinstance(value, float) and np.isnan(value) for value in means.values())


def test_nothing_visible_leaves_coverage_undefined_where_it_is_a_share_of_it():
    renders, truth = _scene()
    blind = dataclasses.replace(truth, visible=np.zeros_like(truth.visible))
    assert scoring.score_scene(renders, blind, EXTENT, convention="paper_code").means()["coverage"] is None
    assert scoring.score_scene(renders, blind, EXTENT, convention="paper_text").means()["coverage"] == 0


def test_missing_maps_are_named():
    renders, truth = _scene()
    photos = Truth(truth.photos)
    with pytest.raises(ValueError, match=r"'paper_text' needs truth.visible, renders.depth"):
        scoring.score_scene(Renders(renders.colours), photos, EXTENT, convention="paper_text")
    no_depth = dataclasses.replace(truth, depth=None)
    found = scoring.score_scene(renders, no_depth, EXTENT, convention="proper")
    assert set(found.notes) == {"lpips", *DEPTH_KEYS, *NORMAL_KEYS}
    assert found.means()["depth_mse"] is None
    assert found.means()["psnr"] is not None
    with pytest.raises(ValueError, match=r"depth_mse was asked for, but there is no truth.depth"):
        scoring.score_scene(renders, no_depth, EXTENT, convention="proper", keys=["depth_mse"])
    with pytest.raises(ValueError, match="lpips was asked for, but no LPIPS network"):
        scoring.score_scene(renders, truth, EXTENT, convention="proper", keys=["lpips"])
    with pytest.raises(ValueError, match="'nerfbaselines' does not define 'coverage'; it has psnr, ssim, lpips"):
        scoring.score_scene(renders, truth, EXTENT, convention="nerfbaselines", keys=["coverage"])
    everything = scoring.score_under_all(renders, Truth(truth.photos), EXTENT)
    assert everything["bayes_rays_unmasked"].means()["psnr"] > 0
    assert everything["proper"].notes == {"masks": "it needs truth.visible"}
    assert everything["proper"].means()["psnr"] is None


def test_only_the_asked_metrics_are_computed():
    found = scoring.score_scene(*_scene(), EXTENT, convention="proper", keys=["psnr", "coverage"]).means()
    assert {key for key in CONVENTIONS["proper"].keys if found[key] is not None} == {"psnr", "coverage"}


def test_bad_input_is_refused_with_reasons():
    renders, truth = _scene()
    with pytest.raises(ValueError, match=r"photos' shape \(2, 16, 20, 3\), got \(2, 15, 20, 3\)"):
        scoring.score_scene(Renders(renders.colours[:, 1:]), truth, EXTENT, convention="proper")
    spoilt = renders.depth.copy()
    spoilt[0, 0, :3] = np.nan
    with pytest.raises(ValueError, match=r"Renders: depth must be > 0 .* 3 values are not \(3 NaN\)"):
        dataclasses.replace(renders, depth=spoilt)
    with pytest.raises(ValueError, match="divide by 255"):
        Renders((renders.colours * 255).astype(np.uint8))
    with pytest.raises(ValueError, match=r"colours must lie in \[0, 1\]"):
        Renders(renders.colours * 255)
    with pytest.raises(ValueError, match="visible must be bool"):
        Truth(truth.photos, visible=np.ones((2, *SIZE)))
    with pytest.raises(ValueError, match=r"cameras must be \(2, 16, 20\) \(n, H, W\), got \(3, 16, 20\)"):
        Truth(truth.photos, cameras=_cameras(3))
    with pytest.raises(ValueError, match=r"names must be 2 different ones, got 2 \(1\)"):
        Truth(truth.photos, names=("a", "a"))
    with pytest.raises(ValueError, match=r"name must be one of proper, paper_text, .* got 'psnr'"):
        scoring.score_scene(renders, truth, EXTENT, convention="psnr")


def test_perfect_renders_score_perfectly_under_every_convention():
    _, truth = _scene()
    exact = Renders(truth.photos.copy(), truth.depth.copy(), np.ones_like(truth.depth))
    for name in CONVENTIONS:
        found = scoring.score_scene(exact, truth, EXTENT, convention=name, network=SQUARES).means()
        assert found["psnr"] == float("inf"), name
        assert found["ssim"] == pytest.approx(1), name
        assert found["lpips"] == 0, name
        assert found.get("flip", 0) == found.get("depth_mse", 0) == found.get("disparity_mae", 0) == 0


def test_a_row_averages_scenes_or_images_as_its_convention_says():
    first, second = _scene(0), _scene(1)
    short = (Renders(second[0].colours[:1], second[0].depth[:1]), Truth(second[1].photos[:1], second[1].visible[:1]))
    for convention in ("proper", "paper_text"):
        scenes = {
            "one": scoring.score_scene(*first, EXTENT, convention=convention),
            "two": scoring.score_scene(*short, EXTENT, convention=convention),
        }
        row = scoring.summarize("field", scenes, np.random.default_rng(0), resamples=50)
        values = [each.values("psnr") for each in scenes.values()]
        wanted = (
            np.mean([np.mean(each) for each in values]) if convention == "proper" else np.mean([*values[0], *values[1]])
        )
        assert row["psnr"] == pytest.approx(wanted)
        assert row["intervals"]["psnr"][0] <= row["psnr"] <= row["intervals"]["psnr"][1]
        assert row["intervals"]["lpips"] == [None, None]
        assert (row["method"], row["convention"], row["images"], row["images_scored"]) == ("field", convention, 3, 3)
        assert row["per_scene"]["two"]["psnr"] == values[1][0]


def test_two_conventions_or_backbones_do_not_mix():
    scenes = {name: scoring.score_scene(*_scene(), EXTENT, convention=name) for name in ("proper", "paper_code")}
    with pytest.raises(ValueError, match=r"one convention only, got 'proper' \(scene 'proper'\) and 'paper_code'"):
        scoring.summarize("field", scenes, np.random.default_rng(0))
    other = Lpips("alex", SQUARES.distance_map)
    scenes = {
        str(index): scoring.score_scene(*_scene(), EXTENT, convention="proper", network=network)
        for index, network in enumerate((SQUARES, other))
    }
    with pytest.raises(ValueError, match=r"one lpips_backbone only, got 'squares' .* and 'alex'"):
        scoring.summarize("field", scenes, np.random.default_rng(0))
    with pytest.raises(ValueError, match="at least one scene"):
        scoring.summarize("field", {}, np.random.default_rng(0))


def test_inputs_are_left_alone():
    renders, truth = _scene()
    before = [each.copy() for each in (renders.colours, renders.depth, truth.photos, truth.depth, truth.visible)]
    scoring.score_under_all(renders, truth, EXTENT, network=SQUARES)
    after = [renders.colours, renders.depth, truth.photos, truth.depth, truth.visible]
    assert all(np.array_equal(a, b) for a, b in zip(before, after))


def test_flip_stands_in_the_proper_column():
    renders, truth = _scene()
    row = scoring.score_scene(renders, truth, EXTENT, convention="proper").images[0]
    mask = truth.visible[0] & (renders.depth[0] < 6)
    assert row["flip"] == metrics.flip(renders.colours[0], truth.photos[0], mask)


WALL, WALL_LIMIT = 4.0, SceneExtent(limit=6.0, unit=1.5)


def _wall():
    """Photos of noise, the depth of a wall along unit rays, and what cameras at x = 0 and 1 saw of it."""
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, 0, 3] = 0.5, 3.0
    lens = np.array([20.0, 20.0, SIZE[1] / 2, SIZE[0] / 2])
    cameras = Cameras.create(poses, lens, SIZE[1], SIZE[0])
    poses[:, 0, 3] = 0.0, 1.0
    depth = np.stack([-WALL / cameras.rays(index)[1][..., 2] for index in range(2)])
    visible = visibility_masks(cameras, depth, Cameras.create(poses, lens, SIZE[1], SIZE[0]))
    photos = np.random.default_rng(0).random((2, *SIZE, 3))
    return Truth(photos, visible, depth, cameras=cameras)


@pytest.mark.parametrize("convention", ["paper_text", "proper"])
def test_a_perfect_rendering_of_a_wall_scores_perfectly(convention):
    truth = _wall()
    found = scoring.score_scene(Renders(truth.photos, truth.depth), truth, WALL_LIMIT, convention=convention).means()
    assert found["psnr"] == float("inf")
    assert found["ssim"] == pytest.approx(1)
    assert found["depth_mse"] == found["disparity_mae"] == 0
    assert found["normal_mean_deg"] == pytest.approx(0, abs=1e-4)
    assert found["normal_pct_30"] == 1
    assert found["coverage"] == pytest.approx((truth.visible & (truth.depth < WALL_LIMIT.limit)).mean())
    assert found["images_scored"] == 2
    assert found["convention"] == convention


@pytest.mark.parametrize("convention", ["paper_text", "proper"])
def test_scores_are_means_over_views_of_the_metrics(convention):
    truth = _wall()
    depth = truth.depth * 1.1
    colours = np.clip(truth.photos + np.reshape([0.1, -0.2], (2, 1, 1, 1)), 0, 1)
    found = scoring.score_scene(Renders(colours, depth), truth, WALL_LIMIT, convention=convention).means()
    masks = truth.visible & (depth < WALL_LIMIT.limit)
    parts = [metrics.psnr(colours[i], truth.photos[i], masks[i], data_range=1.0) for i in range(2)]
    assert found["psnr"] == pytest.approx(np.mean(parts))
    errors = [np.mean((0.1 * truth.depth[i][masks[i]]) ** 2) for i in range(2)]
    assert found["depth_mse"] == pytest.approx(np.mean(errors))
    assert set(found) == {"convention", "images", "images_scored", *CONVENTIONS[convention].keys}


@pytest.mark.parametrize("convention", ["paper_text", "proper"])
def test_removing_everything_gives_no_coverage_and_no_number(convention):
    truth = _wall()
    gone = Renders(np.zeros_like(truth.photos), np.full_like(truth.depth, np.inf))
    found = scoring.score_scene(gone, truth, WALL_LIMIT, convention=convention).means()
    assert (found["coverage"], found["images_scored"]) == (0, 0)
    assert all(found[key] is None for key in ("psnr", "ssim", *DEPTH_KEYS, "normal_mean_deg"))
    visible = scoring.score_scene(gone, truth, None, convention="visible_only", keys=["psnr"]).means()
    assert np.isfinite(visible["psnr"])  # black where the photo is not: removal is not free there


def test_clipped_pseudo_depth_leaves_no_error_above_the_limit():
    truth = _wall()
    endless = dataclasses.replace(truth, depth=np.full_like(truth.depth, 1e4))
    renders = Renders(truth.photos, truth.depth)
    clipped = scoring.score_scene(renders, endless, WALL_LIMIT, convention="proper").means()
    assert 0 < clipped["depth_mse"] < WALL_LIMIT.limit**2
    assert clipped["normal_mean_deg"] is None  # no surface to compare with
    unclipped = scoring.score_scene(renders, endless, WALL_LIMIT, convention="paper_text").means()
    assert unclipped["depth_mse"] > 0.99e8


def test_common_pixels_make_methods_comparable():
    truth = _wall()
    colours = np.clip(truth.photos + 0.1, 0, 1)
    holed = truth.depth.copy()
    holed[:, :, :10] = np.inf
    renders = [Renders(colours, each) for each in (truth.depth, holed)]
    rule = CONVENTIONS["paper_text"]
    shared = common_mask([evaluation_masks(rule, each, truth, WALL_LIMIT) for each in renders])
    own, common = (
        [scoring.score_scene(each, truth, WALL_LIMIT, convention="paper_text", within=mask).means() for each in renders]
        for mask in (None, shared)
    )
    assert own[0]["psnr"] != own[1]["psnr"]
    assert common[0]["psnr"] == common[1]["psnr"] == pytest.approx(own[1]["psnr"])
    assert common[0]["coverage"] == pytest.approx(own[1]["coverage"])
    assert own[1]["coverage"] < own[0]["coverage"]
