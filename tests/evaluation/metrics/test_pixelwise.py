import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from unghost.core.cameras import Cameras
from unghost.evaluation.metrics import pixelwise as metrics

FULL = np.ones((24, 30), dtype=bool)


def _pair(seed=0, shape=(24, 30, 3)):
    rng = np.random.default_rng(seed)
    target = rng.random(shape)
    return np.clip(target + rng.normal(scale=0.1, size=shape), 0, 1), target


def _camera(width=30, height=24, pose=None):
    pose = np.eye(4)[None] if pose is None else pose
    return Cameras.create(pose, np.array([25.0, 25.0, width / 2, height / 2]), width, height)


def test_psnr_known_value():
    # an error of .1 everywhere: MSE .01, 10 log10(1 / .01) = 20 dB; 10 log10(4 / .01) = 26.0206 dB
    target = np.full((4, 5, 3), 0.5)
    mask = np.ones((4, 5), dtype=bool)
    assert metrics.psnr(target + 0.1, target, mask, data_range=1.0) == pytest.approx(20)
    assert metrics.psnr(target + 0.1, target, mask, data_range=2.0) == pytest.approx(26.0206, abs=1e-4)
    assert metrics.psnr(target, target, mask, data_range=1.0) == float("inf")


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6), st.integers(0, 20), st.integers(1, 23), st.integers(0, 20), st.integers(1, 29))
def test_masked_metrics_equal_those_of_the_cropped_region(seed, top, bottom, left, right):
    top, bottom = min(top, bottom), max(top, bottom) + 1
    left, right = min(left, right), max(left, right) + 1
    preds, target = _pair(seed)
    mask = np.zeros((24, 30), dtype=bool)
    mask[top:bottom, left:right] = True
    crop = np.s_[top:bottom, left:right]
    whole = mask[crop]
    assert metrics.psnr(preds, target, mask, data_range=1.0) == pytest.approx(
        metrics.psnr(preds[crop], target[crop], whole, data_range=1.0)
    )
    first, second = preds[..., 0] + 1, target[..., 0] + 1
    for metric in (metrics.depth_mse, metrics.disparity_mae):
        assert metric(first, second, mask) == pytest.approx(metric(first[crop], second[crop], whole))


def test_what_is_masked_out_is_never_looked_at():
    preds, target = _pair()
    mask = FULL.copy()
    mask[3, 4] = False
    wanted = metrics.psnr(preds, target, mask, data_range=1.0)
    spoilt = preds.copy()
    spoilt[3, 4] = np.nan
    assert metrics.psnr(spoilt, target, mask, data_range=1.0) == wanted
    depth = preds[..., 0] + 1
    wanted = metrics.depth_mse(depth, target[..., 0] + 1, mask)
    depth[3, 4] = np.inf
    assert metrics.depth_mse(depth, target[..., 0] + 1, mask) == wanted
    with pytest.raises(ValueError, match="3 unmasked values are NaN"):
        metrics.psnr(spoilt, target, FULL, data_range=1.0)


@pytest.mark.parametrize("data_range", [1.0, 255.0])
def test_ssim_map_is_scikit_images(data_range):
    preds, target = (image * data_range for image in _pair())
    _, oracle = structural_similarity(
        preds,
        target,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=data_range,
        channel_axis=-1,
        full=True,
    )
    np.testing.assert_allclose(metrics.ssim_map(preds, target, data_range=data_range), oracle.mean(axis=-1), atol=1e-10)
    assert metrics.ssim(preds, target, FULL, data_range=data_range) == pytest.approx(oracle.mean())


def test_ssim_of_a_crop_is_the_masked_one_where_no_window_leaves_the_crop():
    preds, target = _pair()
    whole = metrics.ssim_map(preds, target, data_range=1.0)
    crop = metrics.ssim_map(preds[2:22, 3:27], target[2:22, 3:27], data_range=1.0)
    np.testing.assert_allclose(crop[5:-5, 5:-5], whole[7:17, 8:22], atol=1e-12)
    mask = np.zeros_like(FULL)
    mask[7:17, 8:22] = True
    assert metrics.ssim(preds, target, mask, data_range=1.0) == pytest.approx(crop[5:-5, 5:-5].mean())


def test_ssim_conventions_differ_as_documented():
    preds, target = _pair()
    mask = np.zeros_like(FULL)
    mask[:, :6] = True
    fair = metrics.ssim(preds, target, mask, data_range=1.0)
    leaky = metrics.ssim(preds, target, mask, data_range=1.0, convention="premasked")
    assert leaky > fair + 0.03  # holes agree perfectly
    assert metrics.ssim(preds, target, FULL, data_range=1.0, convention="premasked") == pytest.approx(
        metrics.ssim(preds, target, FULL, data_range=1.0)
    )
    # behind the mask, map_mean sees its neighbours' pixels and premasked does not
    other = preds.copy()
    other[:, 15:] = 0.3
    assert metrics.ssim(other, target, mask, data_range=1.0) == pytest.approx(fair)  # 9 columns away: out of reach
    other[:, 6:] = 0.3
    assert metrics.ssim(other, target, mask, data_range=1.0) != pytest.approx(fair)
    assert metrics.ssim(other, target, mask, data_range=1.0, convention="premasked") == pytest.approx(leaky)


def test_an_empty_mask_gives_nan_everywhere():
    preds, target = _pair()
    empty = np.zeros_like(FULL)
    values = [
        metrics.psnr(preds, target, empty, data_range=1.0),
        metrics.ssim(preds, target, empty, data_range=1.0),
        metrics.ssim(preds, target, empty, data_range=1.0, convention="premasked"),
        metrics.depth_mse(preds[..., 0], target[..., 0], empty),
        metrics.disparity_mae(preds[..., 0], target[..., 0], empty),
        *metrics.normal_errors(preds, target, empty).values(),
    ]
    assert len(values) == 8
    assert np.isnan(values).all()


def test_coverage():
    assert metrics.coverage(np.array([[True, False], [False, False]])) == 0.25
    assert np.isnan(metrics.coverage(np.zeros((0, 2), dtype=bool)))
    with pytest.raises(ValueError, match="must be bool"):
        metrics.coverage(np.ones((2, 2)))


def test_errors_name_function_argument_and_rule():
    preds, target = _pair()
    with pytest.raises(ValueError, match=r"psnr: preds must have shape \(H, W, C\), got \(24, 30\)"):
        metrics.psnr(preds[..., 0], target[..., 0], FULL, data_range=1.0)
    with pytest.raises(ValueError, match="psnr: target must have the shape of preds"):
        metrics.psnr(preds, target[..., :1], FULL, data_range=1.0)
    with pytest.raises(ValueError, match="ssim: mask must be bool of shape"):
        metrics.ssim(preds, target, FULL.astype(float), data_range=1.0)
    with pytest.raises(ValueError, match="data_range must be finite and > 0, got 0"):
        metrics.psnr(preds, target, FULL, data_range=0)
    with pytest.raises(
        ValueError, match=r"convention must be one of map_mean, premasked, premasked_over_mask, .* got 'best'"
    ):
        metrics.ssim(preds, target, FULL, data_range=1.0, convention="best")
    with pytest.raises(ValueError, match=r"backproject: depth must have shape \(24, 30\)"):
        metrics.backproject(np.ones((30, 24)), _camera(), 0)


def test_inputs_are_left_alone():
    preds, target = _pair()
    copies = preds.copy(), target.copy()
    metrics.psnr(preds, target, FULL, data_range=1.0)
    metrics.ssim(preds, target, FULL, data_range=1.0, convention="premasked")
    metrics.normals_from_depth(preds[..., 0], _camera(), 0)
    np.testing.assert_array_equal(preds, copies[0])
    np.testing.assert_array_equal(target, copies[1])


def test_psnr_conventions_by_hand():
    # errors .1, .2, .4 in the three channels of half the pixels: MSE .01, .04, .16 are 20, 13.979 and 7.959 dB, their
    # mean 13.979 dB; pooled MSE .07 is 11.549 dB; over all pixels .035 is 14.559 dB, 3.0103 dB = 10 log10(2) above
    target = np.zeros((4, 6, 3))
    preds = target + np.array([0.1, 0.2, 0.4])
    mask = np.zeros((4, 6), dtype=bool)
    mask[:, :3] = True
    found = {
        name: metrics.psnr(preds, target, mask, data_range=1.0, convention=name) for name in metrics.PSNR_CONVENTIONS
    }
    assert found == {
        "pooled": pytest.approx(11.5490, abs=1e-4),
        "per_channel": pytest.approx(13.9794, abs=1e-4),
        "all_pixels": pytest.approx(11.5490 + 10 * np.log10(2), abs=1e-4),
    }
    with pytest.raises(ValueError, match="convention must be one of pooled, per_channel, all_pixels, got 'masked'"):
        metrics.psnr(preds, target, mask, data_range=1.0, convention="masked")


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6), st.floats(0.05, 0.95))
def test_psnr_conventions_stand_in_their_order(seed, share):
    preds, target = _pair(seed)
    mask = np.random.default_rng(seed).random(FULL.shape) < share
    mask[0, 0] = True
    pooled, per_channel, all_pixels = (
        metrics.psnr(preds, target, mask, data_range=1.0, convention=name) for name in metrics.PSNR_CONVENTIONS
    )
    assert per_channel >= pooled - 1e-12
    assert all_pixels == pytest.approx(pooled + 10 * np.log10(1 / mask.mean()))


def test_psnr_is_scikit_images():
    preds, target = _pair()
    mask = np.random.default_rng(2).random(FULL.shape) < 0.5
    oracle = peak_signal_noise_ratio(target[mask], preds[mask], data_range=1.0)
    assert metrics.psnr(preds, target, mask, data_range=1.0) == pytest.approx(oracle, abs=1e-12)


def test_one_equal_channel_makes_the_channels_mean_infinite():
    target = np.zeros((3, 3, 3))
    mask = np.ones((3, 3), dtype=bool)
    assert metrics.psnr(
        target + np.array([0, 0.1, 0.1]), target, mask, data_range=1.0, convention="per_channel"
    ) == float("inf")
