import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from unghost.evaluation.metrics import ldr_flip as module
from unghost.evaluation.metrics.ldr_flip import flip, flip_map

PPD = module.PIXELS_PER_DEGREE


def _flat(colour, shape=(12, 16)):
    return np.broadcast_to(np.array(colour, dtype=float), (*shape, 3)).copy()


# mean and three pixels, as flip-evaluator 1.7, the authors' own implementation (in float32), gives them
@pytest.mark.parametrize(
    ("pixels_per_degree", "mean", "pixels"),
    [
        (67.0206432765823, 0.41959506, (0.72070414, 0.64112216, 0.41813669)),
        (20.0, 0.42933102, (0.69581896, 0.64949226, 0.49601585)),
    ],
)
def test_equals_the_authors_implementation(pattern, pixels_per_degree, mean, pixels):
    preds, target = pattern
    found = flip_map(preds, target, pixels_per_degree=pixels_per_degree)
    assert found.mean() == pytest.approx(mean, abs=5e-6)
    assert [found[0, 0], found[20, 33], found[47, 63]] == pytest.approx(pixels, abs=5e-5)


@pytest.mark.parametrize(
    ("first", "second", "value"),
    [
        ((0, 0, 0), (1, 1, 1), 0.967388),
        ((0, 1, 0), (0, 0, 1), 1.0),
        ((1, 0, 0), (0, 1, 0), 0.986665),
        ((0.5, 0.5, 0.5), (0.6, 0.6, 0.6), 0.285063),
        ((0.2, 0.4, 0.6), (0.25, 0.4, 0.6), 0.082894),
    ],
)
def test_flat_colours_equal_the_authors_implementation(first, second, value):
    # its features of a flat image are single-precision rounding, and the square root makes 1e-4 of 1e-8
    assert flip_map(_flat(first), _flat(second)) == pytest.approx(np.full((12, 16), value), abs=6e-5)


def test_black_against_white_by_hand():
    # no edges; black is L* = 0, white L* = 100, both without colour: the HyAB distance is 100, to the power .7.
    # Green (87.74, -86.18, 83.18) and blue (32.30, 79.20, -107.86), the colour axes times .01 L* (Hunt):
    # |87.74 - 32.30| + |(-75.61 - 25.58, 72.98 + 34.84)| = 55.44 + 147.87 = 203.31, to the power .7
    largest = 203.31**0.7
    wanted = 0.95 + (100**0.7 - 0.4 * largest) / (0.6 * largest) * 0.05
    assert largest == pytest.approx(module.LARGEST, rel=2e-4)
    assert flip_map(_flat((0, 0, 0)), _flat((1, 1, 1)))[5, 5] == pytest.approx(wanted, abs=1e-4)


def test_small_grey_steps_follow_the_first_line():
    # greys of L* 50 and 51 (linear light ((L + 16) / 116)^3): HyAB is 1, far below the knee: .95 / (.4 largest)
    linear = ((np.array([50.0, 51.0]) + 16) / 116) ** 3
    grey = 1.055 * linear ** (1 / 2.4) - 0.055
    found = flip_map(_flat([grey[0]] * 3), _flat([grey[1]] * 3))
    assert found == pytest.approx(np.full((12, 16), 0.95 / (0.4 * module.LARGEST)), rel=1e-6)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([8.0, 20.0, PPD]))
def test_identity_symmetry_and_range(seed, pixels_per_degree):
    rng = np.random.default_rng(seed)
    first, second = np.round(rng.random((2, 9, 11, 3)) ** rng.uniform(0.2, 3), 2)
    there = flip_map(first, second, pixels_per_degree=pixels_per_degree)
    assert (there == flip_map(second, first, pixels_per_degree=pixels_per_degree)).all()
    assert there.min() >= 0
    assert there.max() <= 1
    assert there.max() > 0
    assert (flip_map(first, first, pixels_per_degree=pixels_per_degree) == 0).all()


def test_a_larger_step_never_looks_smaller():
    steps = [
        flip_map(_flat((0.3, 0.3, 0.3)), _flat((0.3 + d, 0.3 + d, 0.3 + d)))[4, 4] for d in np.linspace(0, 0.7, 15)
    ]
    assert (np.diff(steps) > 0).all()


def test_more_noise_looks_worse(pattern):
    rng = np.random.default_rng(1)
    _, target = pattern
    noise = rng.uniform(-1, 1, target.shape)
    means = [flip_map(np.clip(target + d * noise, 0, 1), target).mean() for d in (0, 0.02, 0.1, 0.4)]
    assert (np.diff(means) > 0.01).all()


def test_a_new_edge_is_worse_than_the_same_colours_without_one():
    flat = _flat((0.4, 0.4, 0.4), (40, 40))
    edge = flat.copy()
    edge[:, 20:] += 0.15
    plain = flip_map(_flat((0.55, 0.55, 0.55), (40, 40)), flat)
    assert flip_map(edge, flat)[20, 21] > plain[20, 21] * 0.9  # less colour difference there, and yet
    assert flip_map(edge, flat)[20, 38] == pytest.approx(plain[20, 38], rel=0.02)
    assert (flip_map(edge, flat)[20, 20:24] > flip_map(edge, flat)[20, 38]).any()


def test_seen_from_afar_fine_detail_vanishes():
    row, column = np.mgrid[0:40, 0:40]
    fine = np.repeat(((row + column) % 2)[..., None] * 0.5 + 0.25, 3, axis=2).astype(float)
    other = 1.0 - fine  # the same checks, one pixel on
    near, far = (flip_map(fine, other, pixels_per_degree=ppd)[10:30, 10:30].mean() for ppd in (10.0, 120.0))
    assert near > 0.5
    assert far < 0.05


def test_the_masked_mean_sees_nothing_outside_the_mask(pattern):
    preds, target = pattern
    mask = np.zeros(preds.shape[:2], dtype=bool)
    mask[10:30, 5:40] = True
    wanted = flip(preds, target, mask)
    spoilt = np.where(mask[..., None], preds, np.nan)
    assert flip(spoilt, target, mask) == wanted
    assert flip(np.where(mask[..., None], target, 0.0), target, mask) == 0
    full = np.ones_like(mask)
    assert flip(preds, target, full) == pytest.approx(flip_map(preds, target).mean())
    assert np.isnan(flip(preds, target, ~full))


def test_errors_and_rounding():
    image = _flat((0.5, 0.5, 0.5))
    with pytest.raises(ValueError, match=r"preds must lie in \[0, 1\], 576 values do not"):
        flip_map(image * 255, image)
    spoilt = image.copy()
    spoilt[0, 0, 0] = np.nan
    with pytest.raises(ValueError, match=r"target must lie in \[0, 1\], 1 values do not"):
        flip_map(image, spoilt)
    with pytest.raises(ValueError, match="pixels_per_degree must be finite and > 0, got 0"):
        flip_map(image, image, pixels_per_degree=0)
    with pytest.raises(ValueError, match=r"\(H, W, 3\) with pixels, got \(12, 16, 2\)"):
        flip_map(image[..., :2], image[..., :2])
    assert (flip_map(np.full_like(image, 1 + 5e-5), np.ones_like(image)) == 0).all()
