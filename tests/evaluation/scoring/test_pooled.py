"""Scores in which every pixel counts alike."""

import numpy as np
import pytest

from unghost.evaluation.scoring.engine import SceneScores, score_scene
from unghost.evaluation.scoring.views import Renders, Truth


def test_pooled_scores_are_those_of_all_pixels_at_once():
    rng = np.random.default_rng(0)
    photos, renders = (rng.uniform(size=(3, 16, 20, 3)) for _ in range(2))
    within = rng.uniform(size=(3, 16, 20)) < np.array([0.9, 0.3, 0.0])[:, None, None]  # the last view is given up
    scores = score_scene(Renders(renders), Truth(photos), None, convention="whole_image", within=within, keys=("psnr",))
    found = scores.pooled(("psnr", "ssim"))
    error = ((renders - photos) ** 2)[within].mean()
    assert found["psnr"] == pytest.approx(-10 * np.log10(error))
    assert found["ssim"] is None  # was not asked for
    assert found["psnr"] != pytest.approx(scores.means()["psnr"], abs=1e-4)


def test_pooled_scores_by_hand():
    images = ({"pixels": 30, "psnr": 10.0, "ssim": 0.5}, {"pixels": 10, "psnr": 20.0, "ssim": None}, {"pixels": 0})
    found = SceneScores("proper", images, {}).pooled(("psnr", "ssim", "disparity_mae"))
    assert found == {
        "psnr": pytest.approx(-10 * np.log10((0.1 * 30 + 0.01 * 10) / 40)),
        "ssim": 0.5,
        "disparity_mae": None,
    }
    assert SceneScores("proper", ({"pixels": 3, "psnr": np.inf},), {}).pooled(("psnr",)) == {"psnr": np.inf}
