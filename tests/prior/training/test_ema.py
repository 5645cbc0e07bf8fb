import pytest
import torch

from unghost.prior.training.ema import ExponentialMovingAverage


def test_by_hand_and_live_weights_untouched():
    layer = torch.nn.Linear(1, 1, bias=False)
    with torch.no_grad():
        layer.weight.fill_(1.0)
    average = ExponentialMovingAverage(layer, decay=0.5)
    with torch.no_grad():
        layer.weight.fill_(3.0)
    average.update(layer)  # first decay is min(.5, 1/10): .1 * 1 + .9 * 3
    assert average.shadow["weight"].item() == pytest.approx(2.8)
    average.update(layer)  # second 2/11
    assert average.shadow["weight"].item() == pytest.approx(2 / 11 * 2.8 + 9 / 11 * 3)
    assert layer.weight.item() == 3.0


def test_zero_decay_follows():
    layer = torch.nn.Linear(2, 2)
    average = ExponentialMovingAverage(layer, decay=0.0)
    with torch.no_grad():
        layer.weight.add_(1.0)
    average.update(layer)
    assert torch.equal(average.shadow["weight"], layer.weight)


def test_load_continues():
    layer = torch.nn.Linear(2, 2)
    first, second = ExponentialMovingAverage(layer, decay=0.9), ExponentialMovingAverage(layer, decay=0.9)
    with torch.no_grad():
        layer.weight.add_(1.0)
    first.update(layer)
    second.load(first.shadow, updates=first.updates)
    for average in (first, second):
        average.update(layer)
    assert torch.equal(first.shadow["weight"], second.shadow["weight"])


@pytest.mark.parametrize("decay", [-0.1, 1.0])
def test_refuses(decay):
    with pytest.raises(ValueError, match="decay must lie in"):
        ExponentialMovingAverage(torch.nn.Linear(1, 1), decay=decay)
