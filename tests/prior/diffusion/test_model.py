import dataclasses
import json
import math

import numpy as np
import pytest
import torch
from torch import nn

from unghost.core.manifest import Manifest
from unghost.core.schedule import alphas_cumprod, flip_probabilities
from unghost.prior.checkpoint import TorchDenoiser, load_model, save_model
from unghost.prior.diffusion.model import OBJECTIVES, DiffusionConfig, DiffusionNet
from unghost.prior.diffusion.noised import NoisedDenoiser
from unghost.prior.networks.registry import (
    backbone_from_dict,
    build_network,
    config_from_dict,
    family,
    network_for,
    network_gflop,
)
from unghost.prior.networks.restoration import NetworkConfig, RestorationNet
from unghost.prior.networks.unet import UNet, UNetConfig

TINY = NetworkConfig(widths=(8, 8, 8), condition_width=8)
TINY_UNET = UNetConfig(base_width=4, multipliers=(1, 1, 2), heads=2, groups=2)
EVERY = [DiffusionConfig(objective, network) for objective in OBJECTIVES for network in (TINY, TINY_UNET)]


def named(config):
    return f"{config.objective}-{type(config.network).__name__}"


def make_network(config, seed=0):
    torch.manual_seed(seed)
    network = DiffusionNet(config).eval()
    with torch.no_grad():
        for value in network.parameters():
            value.add_(0.05 * torch.randn_like(value))
    return network


def make_cubes(count=2, seed=0):
    return torch.randint(0, 2, (count, 1, 32, 32, 32), generator=torch.Generator().manual_seed(seed)) * 2.0 - 1.0


class Says(nn.Module):
    """A backbone that answers with a constant."""

    def __init__(self, answer):
        super().__init__()
        self.answer = answer

    def raw(self, channels, timestep, edge_fraction):
        return torch.full_like(channels, self.answer)


def saying(config, answer):
    network = DiffusionNet(config)
    network.backbone = Says(answer)
    return network


ASKED = (torch.tensor([50]), torch.tensor([0.1]))


def test_readouts_by_hand():
    """A backbone that always says 0.3, of a voxel that is 0.5 at t = 50."""
    xt = torch.full((1, 1, 32, 32, 32), 0.5)
    kept, flip = alphas_cumprod()[50], flip_probabilities()[50]
    expected = {
        ("epsilon", False): (0.5 - math.sqrt(1 - kept) * 0.3) / math.sqrt(kept),
        ("epsilon", True): math.sqrt(kept) * 0.5 - math.sqrt(1 - kept) * 0.3,
        ("x0", False): 0.3,
        ("bernoulli", False): math.tanh((0.3 + math.log((1 - flip) / flip) * 0.5) / 2),
    }
    for (objective, shortcut), value in expected.items():
        network = saying(DiffusionConfig(objective, TINY, shortcut=shortcut), 0.3)
        assert network(xt, *ASKED).flatten()[7].item() == pytest.approx(value, abs=1e-6)


def test_shortcut_is_the_same_x0_as_through_epsilon():
    network = saying(DiffusionConfig("epsilon", TINY), -0.7)
    xt = torch.full((1, 1, 32, 32, 32), 0.2)
    kept = alphas_cumprod()[50]
    epsilon = network.raw(xt, *ASKED).flatten()[0].item()
    assert epsilon == pytest.approx(math.sqrt(1 - kept) * 0.2 + math.sqrt(kept) * -0.7, abs=1e-6)
    through = (0.2 - math.sqrt(1 - kept) * epsilon) / math.sqrt(kept)
    assert network(xt, *ASKED).flatten()[0].item() == pytest.approx(through, abs=1e-6)


def test_losses_by_hand():
    x0, draws = torch.ones(1, 1, 32, 32, 32), torch.full((1, 1, 32, 32, 32), 0.5)
    found = {
        name: saying(DiffusionConfig(name, TINY, shortcut=False), 0.3).loss(x0, *ASKED, draws).item()
        for name in OBJECTIVES
    }
    flip = flip_probabilities()[50]
    assert found["epsilon"] == pytest.approx((0.3 - 0.5) ** 2, abs=1e-6)  # eq. 1
    assert found["x0"] == pytest.approx((0.3 - 1.0) ** 2, abs=1e-6)
    # a draw of 0.5 lies at 0.69 of the normal distribution, below 1 - f = 0.93: the bit stays
    assert found["bernoulli"] == pytest.approx(math.log1p(math.exp(-0.3 - math.log((1 - flip) / flip))), abs=1e-6)


def test_draws_flip_as_often_as_they_should():
    network = saying(DiffusionConfig("bernoulli", TINY), 0.0)
    draws = torch.randn(1, 1, 32, 32, 32, generator=torch.Generator().manual_seed(0))
    flipped = (network.noised(torch.ones_like(draws), torch.tensor([200]), draws) < 0).float().mean().item()
    assert flipped == pytest.approx(flip_probabilities()[200], abs=5 * 0.5 / 32**1.5)


@pytest.mark.slow
@pytest.mark.parametrize("config", EVERY, ids=named)
@pytest.mark.parametrize("value", [-1.0, 0.0, 1.0, None])
def test_single_step_is_finite_at_both_ends_of_time(config, value):
    network = make_network(config)
    cubes = make_cubes() if value is None else torch.full((2, 1, 32, 32, 32), value)
    with torch.no_grad():
        x0_pred = network(cubes, torch.tensor([0, 999]), torch.tensor([1e-6, 10.0]))
    assert x0_pred.shape == cubes.shape
    assert torch.isfinite(x0_pred).all()
    assert x0_pred.abs().max() <= 1


@pytest.mark.parametrize("objective", ["epsilon", "bernoulli"])
def test_at_the_first_timestep_a_bit_stays_what_it_is(objective):
    """So little noise that the best answer is the input, whatever the network thinks of it."""
    cubes = make_cubes()
    with torch.no_grad():
        x0_pred = make_network(DiffusionConfig(objective, TINY))(cubes, torch.tensor([0, 0]), torch.tensor([0.1, 0.1]))
    assert torch.equal(x0_pred > 0, cubes > 0)


@pytest.mark.slow
@pytest.mark.parametrize("config", EVERY, ids=named)
def test_checkpoint_round_trip(config, tmp_path):
    network = make_network(config)
    save_model(tmp_path / "m.safetensors", network, Manifest(name="d", family="diffusion", default_timestep=50))
    loaded = load_model(tmp_path / "m.safetensors")
    assert isinstance(loaded.network, DiffusionNet)
    assert loaded.network.config == config
    assert loaded.manifest.family == "diffusion"
    cubes = make_cubes(1)
    with torch.no_grad():
        expected = network(cubes, torch.tensor([50]), torch.tensor([0.1]))
    assert torch.equal(loaded(cubes, 50, 0.1), expected)
    assert loaded(cubes[:0], 50, 0.1).shape == (0, 1, 32, 32, 32)


def test_unet_as_a_restoration_network_round_trips(tmp_path):
    torch.manual_seed(0)
    save_model(tmp_path / "m.safetensors", UNet(TINY_UNET), Manifest(name="u"))
    assert isinstance(load_model(tmp_path / "m.safetensors").network, UNet)


def test_denoiser_adds_no_noise_unless_told():
    network = make_network(DiffusionConfig("epsilon", TINY))
    plain = TorchDenoiser(network, Manifest(name="d", family="diffusion"))
    cubes = make_cubes(3)
    assert torch.equal(plain(cubes, 200, 0.1), plain(cubes, 200, 0.1))
    noised = NoisedDenoiser(plain, torch.Generator().manual_seed(0))
    draws = torch.randn(cubes.shape, generator=torch.Generator().manual_seed(0))
    times = torch.tensor([200] * 3)
    assert torch.equal(noised(cubes, 200, 0.1), plain(network.noised(cubes, times, draws), 200, 0.1))
    assert not torch.equal(noised(cubes, 200, 0.1), noised(cubes, 200, 0.1))
    assert noised.manifest is plain.manifest
    assert noised(cubes[:0], times[:0], 0.1).shape == (0, 1, 32, 32, 32)
    with pytest.raises(ValueError, match="must be of family 'diffusion', got 'restoration'"):
        NoisedDenoiser(TorchDenoiser(RestorationNet(TINY), Manifest(name="r")), torch.Generator())


@pytest.mark.slow
def test_gradient_reaches_every_weight():
    for config in EVERY:
        network = make_network(config)
        network.loss(
            make_cubes(), torch.tensor([100, 700]), torch.tensor([0.05, 0.1]), torch.randn(2, 1, 32, 32, 32)
        ).mean().backward()
        still = [name for name, value in network.named_parameters() if value.grad is None or not value.grad.any()]
        assert still == [], named(config)


def test_configuration_chooses_and_refuses():
    assert DiffusionConfig("epsilon", TINY).shortcut is True
    assert DiffusionConfig("epsilon", TINY_UNET).shortcut is False  # as published
    assert DiffusionConfig("x0", TINY).shortcut is False
    for config in (*EVERY, TINY, TINY_UNET):
        assert config_from_dict(json.loads(json.dumps(config.to_dict()))) == config
        assert build_network(config).config == config
    with pytest.raises(ValueError, match="objective must be one of"):
        DiffusionConfig("v", TINY)
    with pytest.raises(ValueError, match="network must take signed opacity alone"):
        DiffusionConfig("x0", dataclasses.replace(TINY, channels=("signed_opacity", "view_count")))
    with pytest.raises(ValueError, match="shortcut is of objective 'epsilon'"):
        DiffusionConfig("x0", TINY, shortcut=True)
    with pytest.raises(ValueError, match=r"unknown keys \['loss'\]"):
        config_from_dict({**EVERY[0].to_dict(), "loss": 1})
    with pytest.raises(ValueError, match="kind must be one of"):
        config_from_dict({"kind": "transformer"})
    with pytest.raises(ValueError, match="network must be a table"):
        config_from_dict({"kind": "diffusion", "objective": "x0", "network": 3})
    with pytest.raises(ValueError, match="kind must name a backbone"):
        backbone_from_dict(EVERY[0].to_dict())


def test_families_and_work():
    assert family(network_for("restoration", TINY_UNET)) == "restoration"
    assert family(network_for("x0", TINY)) == "diffusion"
    assert network_gflop(network_for("x0", TINY)) == network_gflop(TINY)
    assert np.isclose(network_gflop(network_for("epsilon", UNetConfig())), 41.2, atol=0.1)
