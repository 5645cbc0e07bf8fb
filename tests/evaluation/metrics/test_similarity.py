import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage.metrics import structural_similarity

from unghost.evaluation.metrics.similarity import SSIM_CONVENTIONS, ssim

ROWS, COLUMNS = np.mgrid[0:48, 0:64]
DISC = (ROWS - 20) ** 2 + (COLUMNS - 30) ** 2 < 17**2
OFFSETS = np.arange(-5, 6)
WINDOW = np.exp(-0.5 * (OFFSETS[:, None] ** 2 + OFFSETS[None] ** 2) / 1.5**2)


def _noise(seed, shape=(14, 17, 2)):
    rng = np.random.default_rng(seed)
    target = rng.random(shape)
    return np.clip(target + rng.normal(scale=0.2, size=shape), 0, 1), target, rng.random(shape[:2]) < 0.6


def _at(x, y, weights):
    """SSIM of two windows, one channel, from the definition."""
    weights = weights / weights.sum()
    mean_x, mean_y = (weights * x).sum(), (weights * y).sum()
    var_x, var_y = (weights * (x - mean_x) ** 2).sum(), (weights * (y - mean_y) ** 2).sum()
    both = (weights * (x - mean_x) * (y - mean_y)).sum()
    return (2 * mean_x * mean_y + 1e-4) * (2 * both + 9e-4) / ((mean_x**2 + mean_y**2 + 1e-4) * (var_x + var_y + 9e-4))


def _oracle(preds, target, mask, convention):
    """Every pixel's window by itself, by loops."""
    if convention != "inside_mask":
        preds, target = preds * mask[..., None], target * mask[..., None]
    height, width, channels = preds.shape
    scores = []
    for row in range(height):
        for column in range(width):
            rows, columns = row + OFFSETS, column + OFFSETS
            inside = ((rows >= 0) & (rows < height))[:, None] & ((columns >= 0) & (columns < width))[None]
            if convention == "premasked_whole_windows":
                if not inside.all():
                    continue
                weights = WINDOW
            elif not mask[row, column]:
                continue
            elif convention == "inside_mask":
                weights = WINDOW * inside * mask[np.clip(rows, 0, height - 1)][:, np.clip(columns, 0, width - 1)]
            else:  # reflected without repeating the edge pixel
                weights = WINDOW
                rows, columns = (
                    (length - 1) - np.abs((length - 1) - np.abs(where))
                    for where, length in ((rows, height), (columns, width))
                )
            rows, columns = np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)
            at = np.ix_(rows, columns)
            scores.append(np.mean([_at(preds[..., c][at], target[..., c][at], weights) for c in range(channels)]))
    return np.mean(scores)


@pytest.mark.parametrize("convention", ["inside_mask", "premasked_over_mask", "premasked_whole_windows"])
def test_equals_a_loop_over_windows(convention):
    preds, target, mask = _noise(3)
    found = ssim(preds, target, mask, data_range=1.0, convention=convention)
    assert found == pytest.approx(_oracle(preds, target, mask, convention), abs=1e-10)


def test_the_published_codes_map_is_torchmetrics(pattern):
    # torchmetrics 1.9, structural_similarity_index_measure(..., return_full_image=True) of the blanked images,
    # averaged over the mask
    preds, target, mask = (*pattern, DISC)
    found = ssim(preds, target, mask, data_range=1.0, convention="premasked_over_mask")
    assert found == pytest.approx(0.9086088130906628, abs=1e-12)


def test_whole_windows_are_scikit_images(pattern):
    preds, target, mask = (*pattern, DISC)
    oracle = structural_similarity(
        preds * mask[..., None],
        target * mask[..., None],
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        channel_axis=-1,
    )
    found = ssim(preds, target, mask, data_range=1.0, convention="premasked_whole_windows")
    assert found == pytest.approx(oracle, abs=1e-12)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10**6), st.integers(0, 10), st.integers(1, 14), st.integers(0, 10), st.integers(1, 17))
def test_inside_the_mask_a_rectangle_equals_the_crop(seed, top, bottom, left, right):
    preds, target, _ = _noise(seed)
    crop = np.s_[top : max(bottom, top + 1), left : max(right, left + 1)]
    mask = np.zeros(preds.shape[:2], dtype=bool)
    mask[crop] = True
    cut = ssim(preds[crop], target[crop], mask[crop], data_range=1.0, convention="inside_mask")
    assert ssim(preds, target, mask, data_range=1.0, convention="inside_mask") == pytest.approx(cut, abs=1e-9)


def test_all_but_map_mean_ignore_what_is_masked_out(pattern):
    preds, target, mask = (*pattern, DISC)
    for convention in SSIM_CONVENTIONS:
        wanted = ssim(preds, target, mask, data_range=1.0, convention=convention)
        spoilt = np.where(mask[..., None], preds, np.nan)
        if convention == "map_mean":
            with pytest.raises(ValueError, match="values of preds are NaN or infinite"):
                ssim(spoilt, target, mask, data_range=1.0, convention=convention)
        else:
            assert ssim(spoilt, target, mask, data_range=1.0, convention=convention) == wanted
        with pytest.raises(ValueError, match="are NaN or infinite"):
            ssim(np.full_like(preds, np.nan), target, mask, data_range=1.0, convention=convention)


def test_no_two_conventions_agree_under_a_mask_and_inner_windows_agree_without(pattern):
    preds, target, mask = (*pattern, DISC)
    found = [ssim(preds, target, mask, data_range=1.0, convention=name) for name in SSIM_CONVENTIONS]
    assert len(found) == len({round(value, 4) for value in found}) == 5
    full = np.ones_like(mask)
    found = [ssim(preds, target, full, data_range=1.0, convention=name) for name in SSIM_CONVENTIONS]
    assert np.ptp(found) < 0.02  # only the image's own border tells them apart
    assert found[0] == found[1]


@pytest.mark.parametrize("convention", SSIM_CONVENTIONS)
def test_identity_and_the_empty_mask(pattern, convention):
    preds, target, mask = (*pattern, DISC)
    assert ssim(target, target, mask, data_range=1.0, convention=convention) == pytest.approx(1)
    assert np.isnan(ssim(preds, target, np.zeros_like(mask), data_range=1.0, convention=convention))


def test_blanking_rewards_a_smaller_mask():
    preds, target, _ = _noise(5, (40, 40, 3))
    wide, narrow = np.ones((40, 40), dtype=bool), np.zeros((40, 40), dtype=bool)
    narrow[:, :10] = True
    blanked = [ssim(preds, target, m, data_range=1.0, convention="premasked_whole_windows") for m in (wide, narrow)]
    proper = [ssim(preds, target, m, data_range=1.0, convention="inside_mask") for m in (wide, narrow)]
    assert blanked[1] > blanked[0] + 0.1
    assert abs(proper[1] - proper[0]) < 0.05


def test_an_image_too_small_for_its_window_is_refused():
    image, mask = np.zeros((8, 12, 3)), np.ones((8, 12), dtype=bool)
    with pytest.raises(ValueError, match="at least 11 pixels wide and high here, got 8 x 12"):
        ssim(image, image, mask, data_range=1.0, convention="premasked_whole_windows")
    with pytest.raises(ValueError, match="at least 6 pixels"):
        ssim(image[:5], image[:5], mask[:5], data_range=1.0, convention="premasked_over_mask")
    assert ssim(image[:1], image[:1], mask[:1], data_range=1.0, convention="inside_mask") == 1
