import numpy as np
import pytest

from unghost.evaluation.metrics.masks import MASK_KEYS, mask_scores, predicted_mask


def _mask(text):
    return np.array([[letter == "#" for letter in line] for line in text.split()])


def test_known_values():
    preds, target = _mask("##.. .... #..."), _mask("#... .... ..#.")
    # both 1, predicted 3, true 2, of 12 pixels 9 agree
    found = mask_scores(preds, target)
    assert tuple(found) == MASK_KEYS
    assert found["dice"] == pytest.approx(2 / 5)
    assert found["iou"] == pytest.approx(1 / 4)
    assert found["mask_precision"] == pytest.approx(1 / 3)
    assert found["mask_recall"] == pytest.approx(1 / 2)
    assert found["pixel_accuracy"] == pytest.approx(9 / 12)  # also what torchmetrics 1.2's Dice() says of these two


@pytest.mark.parametrize(
    ("preds", "target", "wanted"),
    [
        ("....", "....", (1, 1, None, None, 1)),
        ("....", "####", (0, 0, None, 0, 0)),
        ("####", "....", (0, 0, 0, None, 0)),
        ("####", "####", (1, 1, 1, 1, 1)),
        ("##..", "..##", (0, 0, 0, 0, 0)),
    ],
)
def test_the_corners(preds, target, wanted):
    found = mask_scores(_mask(preds), _mask(target))
    assert tuple(None if np.isnan(value) else value for value in found.values()) == wanted


def test_a_loop_agrees():
    rng = np.random.default_rng(0)
    preds, target = rng.random((2, 3, 9, 7)) < 0.4
    counts = {key: 0 for key in ((True, True), (True, False), (False, True), (False, False))}
    for p, t in zip(preds.ravel(), target.ravel()):
        counts[bool(p), bool(t)] += 1
    hit, false, missed, right = counts.values()
    found = mask_scores(preds, target)
    assert found["dice"] == pytest.approx(hit / (hit + (false + missed) / 2))
    assert found["iou"] == pytest.approx(hit / (hit + false + missed))
    assert found["pixel_accuracy"] == pytest.approx((hit + right) / preds.size)


def test_predicted_masks():
    accumulation = np.array([0.0, 0.979, 0.98, 1.0005])
    assert predicted_mask(accumulation, threshold=0.98).tolist() == [False, False, True, True]
    with pytest.raises(ValueError, match=r"threshold must lie in \(0, 1\], got 0"):
        predicted_mask(accumulation, threshold=0)
    with pytest.raises(ValueError, match=r"must lie in \[0, 1\], 2 values do not"):
        predicted_mask(np.array([0.5, np.nan, 1.2]), threshold=0.98)


def test_errors():
    with pytest.raises(ValueError, match="target must be bool, got float64"):
        mask_scores(np.ones(3, dtype=bool), np.ones(3))
    with pytest.raises(ValueError, match=r"one shape with pixels, got \(3,\) and \(4,\)"):
        mask_scores(np.ones(3, dtype=bool), np.ones(4, dtype=bool))
    with pytest.raises(ValueError, match="one shape with pixels"):
        mask_scores(np.ones(0, dtype=bool), np.ones(0, dtype=bool))
