import numpy as np
import pytest

from unghost.evaluation.metrics import perceptual
from unghost.evaluation.metrics.perceptual import Lpips, LpipsUnavailable, load_lpips, lpips

# A distance that can be worked out by hand in the place of a trained network: squared difference, mean of channels.
SQUARES = Lpips("squares", lambda first, second: ((first - second) ** 2).mean(axis=-1))


def _scene():
    target = np.full((4, 6, 3), 0.5)
    preds = target + 0.1
    mask = np.zeros((4, 6), dtype=bool)
    mask[:, :2] = True
    preds[:, 2:] = 0.9
    return preds, target, mask


def test_the_conventions_by_hand():
    # .01 in a third of the pixels; outside the mask all three see equal images
    preds, target, mask = _scene()
    assert lpips(preds, target, mask, SQUARES) == pytest.approx(0.01)
    assert lpips(preds, target, mask, SQUARES, convention="premasked_over_mask") == pytest.approx(0.01)
    assert lpips(preds, target, mask, SQUARES, convention="premasked") == pytest.approx(0.01 / 3)


def test_what_the_network_gets_to_see():
    preds, target, mask = _scene()
    seen = []

    def spy(first, second):
        seen.append((first, second))
        return np.zeros(first.shape[:2])

    for convention in perceptual.LPIPS_CONVENTIONS:
        lpips(np.where(mask[..., None], preds, np.nan), target, mask, Lpips("spy", spy), convention=convention)
    outside = [(first[~mask], second[~mask]) for first, second in seen]
    assert (outside[0][0] == 0.5).all()
    assert (outside[0][1] == 0.5).all()
    assert all((first == 0).all() and (second == 0).all() for first, second in outside[1:])
    assert all(np.array_equal(first[mask], preds[mask]) for first, _ in seen)


def test_an_empty_mask_and_errors():
    preds, target, mask = _scene()
    assert np.isnan(lpips(preds, target, np.zeros_like(mask), SQUARES))
    with pytest.raises(ValueError, match="convention must be one of filled, premasked_over_mask, premasked, got 'vgg'"):
        lpips(preds, target, mask, SQUARES, convention="vgg")
    with pytest.raises(ValueError, match=r"distance_map must give shape \(4, 6\), got \(\)"):
        lpips(preds, target, mask, Lpips("bad", lambda first, second: np.mean(first)))
    with pytest.raises(ValueError, match="backbone must be one of alex, vgg, squeeze, got 'resnet'"):
        load_lpips("resnet")


def test_a_missing_package_is_named(monkeypatch):
    found = perceptual.importlib.util.find_spec
    monkeypatch.setattr(perceptual.importlib.util, "find_spec", lambda name: None if name == "lpips" else found(name))
    with pytest.raises(LpipsUnavailable, match=r"LPIPS \(vgg\) needs .*missing: .*lpips.*other metrics do not"):
        load_lpips("vgg")


def test_weights_are_never_fetched_unasked(monkeypatch, tmp_path):
    torch = pytest.importorskip("torch")
    monkeypatch.setattr(perceptual.importlib.util, "find_spec", lambda name: object())
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    with pytest.raises(LpipsUnavailable, match=r"alexnet-owt-7be5be79.pth .*allow_download=True"):
        load_lpips("alex")
    assert not list(tmp_path.iterdir())
