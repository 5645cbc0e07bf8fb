import dataclasses
import hashlib
import math

import numpy as np
import pytest
import torch

from unghost.core.channels import CHANNEL_NAMES
from unghost.core.manifest import Manifest
from unghost.prior.checkpoint import save_model
from unghost.prior.networks.restoration import NetworkConfig, RestorationNet
from unghost.prior.training.batches import Batch, Mixture
from unghost.prior.training.run_state import Trainer, TrainingDiverged, use_bf16


@pytest.fixture
def batch(shard_paths) -> Batch:
    return Mixture([(shard_paths["a"], 1.0)], seed=0).batch(0, 4)


def test_initial_weights_depend_on_the_seed_alone(tiny_config):
    torch.manual_seed(1)
    first = Trainer(tiny_config).network.state_dict()
    torch.manual_seed(2)
    before = torch.get_rng_state()
    second = Trainer(tiny_config).network.state_dict()
    assert torch.equal(torch.get_rng_state(), before)
    assert all(torch.equal(first[name], second[name]) for name in first)
    third = Trainer(dataclasses.replace(tiny_config, seed=4)).network.state_dict()
    assert not torch.equal(first["stem.weight"], third["stem.weight"])


def test_loss_falls_on_one_batch(tiny_config, batch):
    trainer = Trainer(dataclasses.replace(tiny_config, steps=40))
    losses = [trainer.learn(batch)["loss"] for _ in range(30)]
    assert losses[-1] < 0.7 * losses[0]


def test_gradient_clip_bounds_the_step(tiny_config, batch):
    trainer = Trainer(dataclasses.replace(tiny_config, gradient_clip=1e-3))
    trainer.learn(batch)
    norm = torch.stack([value.grad.norm() for value in trainer.network.parameters()]).norm()
    assert norm <= 1e-3 * (1 + 1e-4)


def test_averages_never_touch_live_weights(tiny_config, batch):
    with_average, without = (Trainer(dataclasses.replace(tiny_config, ema_decay=d)) for d in (0.9, 0.0))
    for trainer in (with_average, without):
        for _ in range(3):
            trainer.learn(batch)
        trainer.averaged_network()
    live, other = with_average.network.state_dict(), without.network.state_dict()
    assert all(torch.equal(live[name], other[name]) for name in live)
    averaged = with_average.averaged_network().state_dict()
    assert not torch.equal(averaged["stem.weight"], live["stem.weight"])


def test_a_loss_that_is_not_finite_stops_before_the_weights_change(tiny_config, batch):
    trainer = Trainer(tiny_config)
    trainer.learn(batch)
    before = {name: value.clone() for name, value in trainer.network.state_dict().items()}
    poisoned = dataclasses.replace(batch, channels=np.full_like(batch.channels, math.inf))
    with pytest.raises(TrainingDiverged, match="step 1: loss"):
        trainer.learn(poisoned)
    assert all(torch.equal(value, before[name]) for name, value in trainer.network.state_dict().items())
    assert trainer.step == 1


def test_progress_is_the_larger_of_steps_and_time(tiny_config):
    trainer = Trainer(dataclasses.replace(tiny_config, max_seconds=10.0))
    trainer.step, trainer.elapsed = 3, 2.0
    assert trainer.progress == 0.5
    trainer.elapsed = 8.0
    assert trainer.progress == 0.8
    trainer.elapsed = 20.0
    assert trainer.progress == 1.0


def test_decay_spares_biases_and_gain(tiny_config):
    decayed, spared = Trainer(tiny_config).optimizer.param_groups
    assert all(value.ndim > 1 for value in decayed["params"])
    assert all(value.ndim <= 1 for value in spared["params"])
    assert decayed["weight_decay"] > 0 == spared["weight_decay"]


def test_warm_start(tiny_config, tmp_path):
    torch.manual_seed(9)
    network = RestorationNet(tiny_config.network)
    path = tmp_path / "start.safetensors"
    save_model(path, network, Manifest(name="start", training={"steps": 7, "validation": {}}))
    config = dataclasses.replace(tiny_config, init_from=str(tmp_path / "start.safetensors"))
    trainer = Trainer(config)
    assert torch.equal(trainer.network.stem.weight, network.stem.weight)
    assert torch.equal(trainer.average.shadow["stem.weight"], network.stem.weight)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    seen = ["signed_opacity"]
    assert trainer.started_from == {"name": "start", "sha256": digest, "channels": seen, "steps": 7}
    assert Trainer(tiny_config).started_from is None
    with pytest.raises(ValueError, match="has another network"):
        Trainer(dataclasses.replace(config, network=NetworkConfig(widths=(16, 8, 8))))


def test_restore_refuses_models_and_other_networks(tiny_config, tmp_path):
    save_model(tmp_path / "model.safetensors", RestorationNet(tiny_config.network), Manifest(name="m"))
    with pytest.raises(ValueError, match="is not a training state"):
        Trainer(tiny_config).restore(tmp_path / "model.safetensors")
    Trainer(tiny_config).save(tmp_path / "state.safetensors")
    other = Trainer(dataclasses.replace(tiny_config, network=NetworkConfig(widths=(16, 8, 8))))
    with pytest.raises(ValueError, match="holds another network"):
        other.restore(tmp_path / "state.safetensors")


def test_precision_table():
    cpu = torch.device("cpu")
    assert use_bf16("bf16", cpu)
    assert not use_bf16("fp32", cpu)
    assert isinstance(use_bf16("auto", cpu), bool)


def test_bf16_training_runs_and_keeps_fp32_weights(tiny_config, batch):
    trainer = Trainer(dataclasses.replace(tiny_config, precision="bf16", steps=40))
    losses = [trainer.learn(batch)["loss"] for _ in range(20)]
    assert losses[-1] < 0.8 * losses[0]
    assert trainer.network.stem.weight.dtype == torch.float32


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["fp32", "bf16"])
def test_all_channels_train_in_both_precisions(tiny_config, shard_paths, precision):
    network = dataclasses.replace(tiny_config.network, channels=CHANNEL_NAMES)
    trainer = Trainer(dataclasses.replace(tiny_config, network=network, precision=precision, steps=40))
    batch = Mixture([(shard_paths["seen"], 1.0)], seed=0, channels=CHANNEL_NAMES).batch(0, 4)
    losses = [trainer.learn(batch)["loss"] for _ in range(20)]
    assert losses[-1] < 0.8 * losses[0]
    assert any(name.startswith("context.") for name in trainer.average.shadow)
