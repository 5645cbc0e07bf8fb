import dataclasses
import math

import pytest
import torch
from torch import nn

from unghost.core.channels import CHANNEL_NAMES
from unghost.denoisers import WEIGHTS
from unghost.prior.checkpoint import load_model, read_tensors
from unghost.prior.networks.restoration import NetworkConfig, RestorationNet
from unghost.prior.training.loop import train
from unghost.prior.training.run_state import Trainer, TrainingDiverged
from unghost.prior.training.watch import DEAD, EXPLODED, SETTLED_STEPS, LossWatch, complaint, input_dependence

TINY = NetworkConfig(widths=(8, 8, 8), condition_width=8)


def fresh(config=TINY):
    torch.manual_seed(0)
    return RestorationNet(config)


def test_living_networks_depend_on_their_input():
    assert input_dependence(fresh()) > 1e-2
    assert input_dependence(fresh(NetworkConfig(channels=CHANNEL_NAMES, widths=(8, 8, 8)))) > 1e-2
    assert input_dependence(load_model(WEIGHTS / "default.safetensors").network) > 0.1


@pytest.mark.parametrize("where", ["stem", "head"])
def test_dead_networks_do_not(where):
    """The shortcut still passes the input on, so that neither output nor loss would tell."""
    network = fresh()
    with torch.no_grad():
        getattr(network, where).weight.zero_()
    assert input_dependence(network) <= DEAD
    cubes = torch.rand(2, 1, 32, 32, 32)
    assert network(cubes, torch.tensor([5, 5]), torch.tensor([0.1, 0.1])).std() > 0.1


def test_a_look_leaves_no_trace():
    network = fresh().train()
    before = {name: value.clone() for name, value in network.state_dict().items()}
    input_dependence(network)
    assert network.training
    assert all(value.grad is None for value in network.parameters())
    assert all(torch.equal(value, before[name]) for name, value in network.state_dict().items())
    assert not any(module._forward_hooks for module in network.modules())


def test_in_bfloat16_training_the_look_is_in_float32():
    network = fresh()
    expected = input_dependence(network)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert input_dependence(network) == expected


def test_a_network_without_convolutions_is_refused():
    class Plain(nn.Module):
        config = TINY

        def __init__(self):
            super().__init__()
            self.gain = nn.Parameter(torch.ones(()))

        def forward(self, channels, _timestep, _edge_fraction):
            return channels * self.gain

    with pytest.raises(ValueError, match="Plain has no 3D convolution"):
        input_dependence(Plain())


def test_running_loss_by_hand():
    watch = LossWatch()
    watch.add(1.0)
    assert watch.running == 1.0
    watch.add(2.0)
    assert watch.running == pytest.approx(0.98 + 0.04)
    assert watch.lowest == math.inf
    assert not watch.exploded


def test_a_loss_that_leaves_its_lowest_far_behind():
    watch = LossWatch()
    for _ in range(SETTLED_STEPS):
        watch.add(0.1)
    assert watch.lowest == pytest.approx(0.1)
    for _ in range(5):  # a bad batch or two are no reason
        watch.add(1.0)
    assert not watch.exploded
    while not watch.exploded:
        watch.add(5.0)
    assert watch.running > EXPLODED * watch.lowest
    assert complaint(fresh(), watch) == f"the running loss is {watch.running:.4g}, its lowest was 0.1"
    assert complaint(fresh(), LossWatch()) is None


def test_high_losses_at_the_start_are_none():
    watch = LossWatch()
    for step in range(SETTLED_STEPS * 4):
        watch.add(100.0 * 0.9**step)
        assert not watch.exploded


def test_a_run_whose_network_dies_stops_and_keeps_the_checkpoint_before(
    tiny_config, shard_paths, tmp_path, monkeypatch
):
    honest = Trainer.learn

    def deadly(self, batch):
        values = honest(self, batch)
        if self.step == 3:
            with torch.no_grad():
                self.network.stem.weight.zero_()
                self.network.stem.bias.fill_(-1.0)
        if self.step > 3:
            self.network.stem.weight.data.zero_()  # as it would be if no gradient reached it
        return values

    monkeypatch.setattr(Trainer, "learn", deadly)
    config = dataclasses.replace(tiny_config, checkpoint_steps=2)
    with pytest.raises(TrainingDiverged, match="train: step 4: the network is dead: its output does not depend"):
        train(config, train_shards=[(shard_paths["a"], 1.0)], out=tmp_path / "run", progress=False)
    tensors, metadata = read_tensors(tmp_path / "run" / "state.safetensors")
    assert metadata["step"] == "2"
    assert tensors["live.stem.weight"].abs().max() > 0
    assert not (tmp_path / "run" / "model.safetensors").exists()
