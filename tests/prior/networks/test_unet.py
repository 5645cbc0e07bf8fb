import dataclasses
import json

import pytest
import torch

from unghost.prior.networks.restoration import parameter_count
from unghost.prior.networks.unet import UNet, UNetConfig, edge_features, timestep_features, unet_gflop

TINY = UNetConfig(base_width=4, multipliers=(1, 1, 2), heads=2, groups=2)


@pytest.fixture
def network():
    torch.manual_seed(0)
    network = UNet(TINY)
    with torch.no_grad():
        for value in network.parameters():  # layers that start from zero would hide the others
            value.add_(0.1 * torch.randn_like(value))
    return network.eval()


def make_inputs(count=2, seed=0):
    generator = torch.Generator().manual_seed(seed)
    cubes = torch.randn(count, 1, 32, 32, 32, generator=generator)
    return cubes, torch.arange(count) * 300, torch.linspace(0.02, 0.2, count)


def test_the_papers_size():
    """7.2 M parameters, 28 MB; 41.2 GFLOP was measured for the published network."""
    with torch.device("meta"):
        count = parameter_count(UNet(UNetConfig()))
    assert count == 7_214_945
    assert abs(count / 7.2e6 - 1) < 0.01
    assert 28 <= count * 4 / 1e6 < 29
    assert unet_gflop(UNetConfig()) == pytest.approx(41.2, abs=0.1)


def test_parameters_of_one_level_by_hand():
    """One level of 2 channels: every layer written out."""
    config = UNetConfig(base_width=2, multipliers=(1,), heads=1, groups=1)
    norm, conv, time, attention = 4, 2 * 2 * 27 + 2, 8 * 2 + 2, 4 + (2 * 6 + 6) + (2 * 2 + 2)
    block = norm + conv + time + norm + conv
    wide = 8 + (4 * 2 * 27 + 2) + time + norm + conv + (4 * 2 + 2)  # 2 + 2 channels in, and a 1x1x1 past it
    embedders = (2 * 8 + 8 + 8 * 8 + 8) + (13 * 8 + 8 + 8 * 8 + 8)
    ends = (2 * 27 + 2) + norm + (2 * 27 + 1)
    expected = embedders + ends + (block + attention) + (2 * block + attention) + 2 * (wide + attention)
    with torch.device("meta"):
        assert parameter_count(UNet(config)) == expected


def test_work_of_a_convolution_is_counted_twice_a_multiply_add():
    """Doubling the blocks of the encoder adds, at 32^3, three convolutions of known cost, and so on down."""
    one, two = (unet_gflop(UNetConfig(base_width=8, multipliers=(1,), heads=1, groups=1, blocks=n)) for n in (1, 2))
    tokens = 32**3
    convs = (8 * 8 + 8 * 8 + 16 * 8 + 8 * 8) * 27 + 16 * 8  # a block, and a decoder block with its 1x1x1
    attention = 2 * (8 * 24 + 8 * 8 + 2 * tokens * 8)
    linear = 2 * 32 * 8
    assert two - one == pytest.approx(2e-9 * (tokens * (convs + attention) + linear), rel=1e-6)


def test_every_weight_moves_the_output(network):
    cubes, times, edges = make_inputs()
    network.raw(cubes, times, edges).square().mean().backward()
    still = [name for name, value in network.named_parameters() if value.grad is None or not value.grad.abs().max() > 0]
    assert still == []


def test_shapes_alone_and_in_a_batch(network):
    cubes, times, edges = make_inputs(3)
    with torch.no_grad():
        whole = network(cubes, times, edges)
        alone = network(cubes[1:2], times[1:2], edges[1:2])
        none = network(cubes[:0], times[:0], edges[:0])
    assert whole.shape == (3, 1, 32, 32, 32)
    assert whole.abs().max() <= 1
    assert torch.allclose(alone, whole[1:2], atol=1e-5)
    assert none.shape == (0, 1, 32, 32, 32)


def test_starts_from_zero_and_from_the_seed_alone():
    torch.manual_seed(5)
    first = UNet(TINY)
    torch.manual_seed(5)
    second = UNet(TINY)
    assert all(torch.equal(a, b) for a, b in zip(first.parameters(), second.parameters()))
    with torch.no_grad():
        assert (first.raw(*make_inputs(1)) == 0).all()


def test_conditions_change_the_output(network):
    cubes, times, edges = make_inputs(1)
    with torch.no_grad():
        base = network.raw(cubes, times, edges)
        later = network.raw(cubes, times + 500, edges)
        larger = network.raw(cubes, times, edges * 5)
    assert (base - later).abs().max() > 1e-3
    assert (base - larger).abs().max() > 1e-3


def test_edge_fractions_of_the_papers_range_are_told_apart():
    """Twenty sizes from 1 % to 20 %: every pair differs, neighbours too, and the slow wave orders them."""
    edges = torch.logspace(-2, -0.69897, 20)
    features = edge_features(edges)
    assert features.shape == (20, 13)
    distance = torch.cdist(features, features) + 10 * torch.eye(20)
    assert distance.min() > 0.5
    assert (features[:, 0].diff() > 0).all()
    assert features[-1, 0] - features[0, 0] > 1.0  # more than half of [-1, 1]
    assert len(features.unique(dim=0)) == 20


def test_edge_features_beyond_their_range_stay_finite():
    found = edge_features(torch.tensor([1e-30, 0.005, 1.0, 1e30]))
    assert torch.isfinite(found).all()
    assert torch.equal(found[0], found[1])
    assert torch.equal(found[2], found[3])
    assert found[[0, 2], 0].tolist() == [-1.0, 1.0]


def test_timestep_features_by_hand():
    found = timestep_features(torch.tensor([0, 3]), 4)  # rates 1 and 1 / 100
    assert found[0].tolist() == [1.0, 1.0, 0.0, 0.0]
    assert found[1].tolist() == pytest.approx([-0.98999, 0.99955, 0.14112, 0.0299955], abs=1e-5)


def test_config_round_trip_and_refusals():
    assert UNetConfig.from_dict(json.loads(json.dumps(TINY.to_dict()))) == TINY
    with pytest.raises(ValueError, match=r"unknown keys \['width'\]"):
        UNetConfig.from_dict({"width": 3})
    for wrong, message in (
        ({"groups": 3}, "multiple of groups = 3"),
        ({"heads": 3}, "heads must divide"),
        ({"blocks": 0}, "blocks must be >= 1"),
        ({"multipliers": ()}, "multipliers must be"),
        ({"kind": "net"}, "kind must be 'unet'"),
    ):
        with pytest.raises(ValueError, match=message):
            dataclasses.replace(UNetConfig(), **wrong)


def test_shapes_are_refused(network):
    cubes, times, edges = make_inputs()
    with pytest.raises(ValueError, match="UNet: channels must have shape"):
        network.raw(cubes[:, :, :16], times, edges)
    with pytest.raises(ValueError, match="UNet: edge_fraction must have shape"):
        network.raw(cubes, times, edges[:1])
