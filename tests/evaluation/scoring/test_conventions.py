import dataclasses

import numpy as np
import pytest

from unghost.core.cameras import Cameras
from unghost.evaluation.metrics.checks import choose
from unghost.evaluation.metrics.perceptual import LPIPS_CONVENTIONS
from unghost.evaluation.metrics.pixelwise import PSNR_CONVENTIONS, SSIM_CONVENTIONS
from unghost.evaluation.scoring import conventions
from unghost.evaluation.scoring.conventions import CONVENTIONS, PLAIN_CONVENTIONS, SceneExtent, get_convention
from unghost.evaluation.scoring.views import Renders, Truth


def _cameras(origins):
    poses = np.tile(np.eye(4), (len(origins), 1, 1))
    poses[:, :3, 3] = origins
    return Cameras.create(poses, np.array([10.0, 10.0, 4, 3]), 8, 6)


def test_every_published_convention_is_there_and_frozen():
    assert set(CONVENTIONS) == {
        "proper",
        "paper_text",
        "paper_code",
        "bayes_rays_masked",
        "bayes_rays_unmasked",
        "free_space_prior",
        "nerfbaselines",
    }
    with pytest.raises(dataclasses.FrozenInstanceError):
        CONVENTIONS["proper"].visible = False
    with pytest.raises(TypeError):
        CONVENTIONS["mine"] = CONVENTIONS["proper"]
    with pytest.raises(ValueError, match=r"name must be one of proper, .*, whole_image, got 'nerfbuster'"):
        get_convention("nerfbuster")


def test_every_convention_names_rules_that_exist():
    for name, each in CONVENTIONS.items():
        assert each.name == name
        assert each.source
        assert choose("t", "psnr", each.psnr, PSNR_CONVENTIONS)
        assert choose("t", "ssim", each.ssim, SSIM_CONVENTIONS)
        assert choose("t", "lpips", each.lpips, LPIPS_CONVENTIONS)
        assert each.bits in (None, "round", "truncate")
        assert each.mean_over in ("scenes", "images")
        assert each.coverage_of in ("all", "visible")
        assert each.dice in ("dice", "pixel_accuracy")
        assert len(set(each.keys)) == len(each.keys)


def test_no_two_conventions_are_the_same():
    everything = {**CONVENTIONS, **PLAIN_CONVENTIONS}
    assert len(everything) == len(CONVENTIONS) + len(PLAIN_CONVENTIONS)
    stripped = {dataclasses.replace(each, name="", source="") for each in everything.values()}
    assert len(stripped) == len(everything)


def test_the_plain_ones_need_no_cameras_and_no_depth():
    colours = np.zeros((1, 1, 4, 3))
    renders, seen = Renders(colours), np.array([[[True, False, True, False]]])
    whole, visible = PLAIN_CONVENTIONS["whole_image"], PLAIN_CONVENTIONS["visible_only"]
    assert conventions.evaluation_masks(whole, renders, Truth(colours), None).all()
    found = conventions.evaluation_masks(visible, renders, Truth(colours, seen), None)
    np.testing.assert_array_equal(found, seen)
    assert conventions.missing_maps(visible, renders, Truth(colours)) == ("truth.visible",)
    with pytest.raises(ValueError, match=r"'proper' needs truth\.visible, renders\.depth, extent"):
        conventions.evaluation_masks(CONVENTIONS["proper"], renders, Truth(colours), None)


def test_the_two_lengths_of_a_scene_by_hand():
    # origins 0, 1 and 5 on a line: mean 2, the farthest coordinate 3, the largest distance 5
    extent = SceneExtent.of(_cameras([[0, 0, 0], [1, 0, 0]]), _cameras([[5, 0, 0]]))
    assert extent == SceneExtent(limit=10.0, unit=3.0)
    assert extent.depth_limit(CONVENTIONS["paper_text"]) == 10
    assert extent.depth_limit(CONVENTIONS["paper_code"]) == 6  # what "a value of 2" really was
    assert extent.depth_limit(CONVENTIONS["free_space_prior"]) is None


def test_the_texts_limit_is_never_the_codes():
    rng = np.random.default_rng(0)
    for _ in range(20):
        extent = SceneExtent.of(_cameras(rng.normal(size=(4, 3))), _cameras(rng.normal(size=(3, 3))))
        assert 2 * extent.unit < extent.limit <= 4 * np.sqrt(3) * extent.unit


def test_two_identical_trajectories_have_an_extent_and_one_camera_has_none():
    twice = _cameras([[0, 0, 0], [2.0, 0, 0]])
    assert SceneExtent.of(twice, twice) == SceneExtent(limit=4.0, unit=1.0)
    once = _cameras([[1.0, 2, 3]])
    with pytest.raises(ValueError, match="two distinct camera origins, got 2 cameras in one place"):
        SceneExtent.of(once, once)
    with pytest.raises(ValueError, match="unit must be finite and > 0, got 0"):
        SceneExtent(limit=1.0, unit=0.0)


def test_masks_by_hand():
    depth = np.array([[[1.0, 5.0, 9.0, np.inf]]])
    visible = np.array([[[True, True, True, False]]])
    accumulation = np.array([[[0.5, 0.98, 0.99, 1.0]]])
    colours = np.zeros((1, 1, 4, 3))
    renders, truth = Renders(colours, depth, accumulation), Truth(colours, visible)
    extent = SceneExtent(limit=8.0, unit=2.0)
    wanted = {
        "proper": [1, 1, 0, 0],
        "paper_text": [1, 1, 0, 0],
        "nerfbaselines": [1, 1, 0, 0],
        "paper_code": [1, 0, 0, 0],
        "bayes_rays_masked": [1, 0, 0, 0],
        "bayes_rays_unmasked": [1, 0, 0, 0],
        "free_space_prior": [0, 1, 1, 1],
    }
    for name, each in CONVENTIONS.items():
        masks = conventions.evaluation_masks(each, renders, truth, extent)
        assert masks[0, 0].astype(int).tolist() == wanted[name], name
        assert masks is not truth.visible
    unseen = Truth(colours, ~visible)
    assert conventions.evaluation_masks(CONVENTIONS["bayes_rays_unmasked"], renders, unseen, extent).sum() == 1


def test_one_convention_or_none():
    assert conventions.one_convention("t", []) is None
    assert conventions.one_convention("t", [{"convention": "a"}, {"convention": "a"}]) == "a"
    with pytest.raises(ValueError, match=r"t: conventions do not mix: 'a' \(row '\?'\) and 'b' \(row 3\)"):
        conventions.one_convention("t", [{"convention": "a"}, {"convention": "b", "seed": 3}])
