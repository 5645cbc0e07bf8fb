import dataclasses

import pytest
import torch

from unghost.core.channels import CHANNEL_NAMES, UNKNOWN
from unghost.core.manifest import Manifest
from unghost.prior.checkpoint import save_model
from unghost.prior.networks.restoration import NetworkConfig, RestorationNet, space_to_depth, voxel_features
from unghost.prior.networks.rewire import can_rewire, rewire
from unghost.prior.training.run_state import Trainer

SMALL = NetworkConfig(widths=(8, 16, 8), condition_width=8)


def lively(config, seed):
    torch.manual_seed(seed)
    network = RestorationNet(config)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))
    return network.eval()


def ask(network, channels):
    times, edges = torch.tensor([100, 900]), torch.tensor([0.05, 0.2])
    with torch.no_grad():
        return network.logits(channels, times, edges)


@pytest.mark.parametrize(
    ("few", "many"),
    [
        (("signed_opacity",), CHANNEL_NAMES),
        (("signed_opacity", "view_count"), ("signed_opacity", "transmittance", "surroundings", "view_count")),
        (("signed_opacity", "surroundings"), CHANNEL_NAMES),
        (("signed_opacity",), ("signed_opacity", "transmittance")),
    ],
)
def test_an_extended_network_says_the_same_whatever_the_new_channels_hold(few, many):
    old = lively(dataclasses.replace(SMALL, channels=few), 0)
    new = lively(dataclasses.replace(SMALL, channels=many), 1)
    rewire(old, new)
    channels = torch.rand(2, len(many), 32, 32, 32) * 2 - 1
    known = channels[:, [many.index(name) for name in few]]
    torch.testing.assert_close(ask(new, channels), ask(old, known), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("few", [("signed_opacity",), ("signed_opacity", "transmittance")])
def test_a_network_with_fewer_channels_takes_the_others_for_unknown(few):
    old = lively(dataclasses.replace(SMALL, channels=("signed_opacity", "view_count", "transmittance")), 0)
    new = lively(dataclasses.replace(SMALL, channels=few), 1)
    rewire(old, new)
    channels = torch.rand(2, 3, 32, 32, 32) * 2 - 1
    channels[:, 1] = UNKNOWN
    if "transmittance" not in few:
        channels[:, 2] = UNKNOWN
    stems = []
    for network, known in ((old, channels), (new, channels[:, [0, 2][: len(few)]])):
        with torch.no_grad():
            stems.append(network.stem(space_to_depth(voxel_features(known)))[..., 1:-1, 1:-1, 1:-1])
    torch.testing.assert_close(stems[1], stems[0], rtol=1e-5, atol=1e-5)


def test_the_new_channels_are_learned_from_the_first_step():
    new = lively(dataclasses.replace(SMALL, channels=CHANNEL_NAMES), 1)
    rewire(lively(SMALL, 0), new)
    channels = torch.rand(2, len(CHANNEL_NAMES), 32, 32, 32) * 2 - 1
    new.logits(channels, torch.tensor([100, 900]), torch.tensor([0.05, 0.2])).square().mean().backward()
    assert new.stem.weight.grad[:, 8:].abs().max() > 0
    assert new.context.project.weight.grad.abs().max() > 0
    assert new.condition[0].weight.grad[:, 18:].abs().max() > 0


def test_other_networks_are_refused():
    wide = RestorationNet(NetworkConfig(widths=(16, 16, 8), condition_width=8))
    fewer = RestorationNet(SMALL)
    more = RestorationNet(dataclasses.replace(SMALL, channels=CHANNEL_NAMES))
    assert can_rewire(fewer, more)
    assert not can_rewire(more, fewer)
    for old, new in ((wide, more), (more, fewer)):
        with pytest.raises(ValueError, match="with other channels"):
            rewire(old, new)


def test_a_run_starts_from_a_model_of_one_channel(tiny_config, tmp_path):
    config = tiny_config
    torch.manual_seed(3)
    start = RestorationNet(config.network)
    save_model(tmp_path / "start.safetensors", start, Manifest("start", parameters=1))
    seeing = dataclasses.replace(config.network, channels=("signed_opacity", "transmittance"))
    trainer = Trainer(dataclasses.replace(config, network=seeing, init_from=str(tmp_path / "start.safetensors")))
    assert trainer.started_from["name"] == "start"
    assert trainer.started_from["channels"] == ["signed_opacity"]
    channels = torch.rand(2, 2, 32, 32, 32) * 2 - 1
    torch.testing.assert_close(
        ask(trainer.network.eval(), channels), ask(start.eval(), channels[:, :1]), rtol=1e-5, atol=1e-5
    )
