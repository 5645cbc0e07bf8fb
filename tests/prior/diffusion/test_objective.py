import dataclasses
import json

import numpy as np
import pytest
import torch

from unghost.prior.checkpoint import load_model
from unghost.prior.diffusion.model import DiffusionNet
from unghost.prior.diffusion.objective import diffusion_losses, training_draws
from unghost.prior.networks.registry import build_network, network_for
from unghost.prior.networks.unet import UNetConfig
from unghost.prior.training.batches import Mixture
from unghost.prior.training.config import TrainConfig
from unghost.prior.training.loop import train
from unghost.prior.training.run_state import Trainer

TINY_UNET = UNetConfig(base_width=4, multipliers=(1, 1, 2), heads=2, groups=2)


def test_draws_depend_on_seed_and_sample_alone():
    times, draws = training_draws(np.array([5, 6, 7]), seed=1, device="cpu")
    assert times.dtype == torch.int64
    assert draws.shape == (3, 1, 32, 32, 32)
    alone = training_draws(np.array([6]), seed=1, device="cpu")
    assert times[1] == alone[0][0]
    assert torch.equal(draws[1], alone[1][0])
    assert not torch.equal(draws[1], training_draws(np.array([6]), seed=2, device="cpu")[1][0])
    assert training_draws(np.array([], np.int64), seed=1, device="cpu")[1].shape == (0, 1, 32, 32, 32)


def test_draws_are_uniform_times_and_standard_normals():
    times, draws = training_draws(np.arange(400), seed=0, device="cpu")
    assert times.min() < 20
    assert times.max() > 980
    assert abs(times.float().mean() - 499.5) < 5 * 288.7 / 20
    assert draws.mean().abs() < 5 / (400 * 32**3) ** 0.5
    assert draws.std().item() == pytest.approx(1.0, abs=1e-3)


def test_the_corrupted_input_plays_no_part(tiny_config, shard_paths):
    batch = Mixture([(shard_paths["a"], 1.0)], seed=0).batch(0, 3)
    other = dataclasses.replace(batch, channels=-batch.channels, timestep=batch.timestep * 0)
    config = dataclasses.replace(tiny_config, objective="epsilon")
    assert Trainer(config).learn(batch) == Trainer(config).learn(other)


def test_ignored_voxels_count_as_empty(tiny_config):
    torch.manual_seed(0)
    network = build_network(network_for("x0", tiny_config.network))
    labels = torch.randint(0, 3, (2, 32, 32, 32), generator=torch.Generator().manual_seed(0)).to(torch.uint8)
    edges = torch.tensor([0.1, 0.1])
    index = np.array([0, 1])
    found = diffusion_losses(network, labels, edges, index=index, seed=0)
    assert found.shape == (2,)
    as_free = diffusion_losses(network, torch.where(labels == 2, 0, labels), edges, index=index, seed=0)
    as_surface = diffusion_losses(network, torch.where(labels == 2, 1, labels), edges, index=index, seed=0)
    assert torch.equal(found, as_free)
    assert not torch.equal(found, as_surface)


def loss_of(trainer, batch):
    """The same draws whatever the step."""
    labels, edges = torch.from_numpy(batch.labels), torch.from_numpy(batch.edge_fraction)
    with torch.no_grad():
        losses = diffusion_losses(trainer.network, labels, edges, index=np.arange(len(labels)) + 10**6, seed=0)
    return losses.mean().item()


@pytest.mark.slow
@pytest.mark.parametrize("objective", ["epsilon", "x0", "bernoulli"])
def test_loss_falls(tiny_config, shard_paths, objective):
    batch = Mixture([(shard_paths["a"], 1.0)], seed=0).batch(0, 6)
    trainer = Trainer(dataclasses.replace(tiny_config, objective=objective, steps=100, learning_rate=4e-3))
    before = loss_of(trainer, batch)
    for _ in range(20):
        trainer.learn(batch)
    assert loss_of(trainer, batch) < 0.95 * before


def test_every_step_draws_anew(tiny_config, shard_paths):
    batch = Mixture([(shard_paths["a"], 1.0)], seed=0).batch(0, 3)
    trainer = Trainer(dataclasses.replace(tiny_config, objective="x0", learning_rate=1e-12))
    losses = [trainer.learn(batch)["loss"] for _ in range(2)]
    assert abs(losses[0] - losses[1]) > 1e-4


@pytest.mark.slow
def test_unet_trains(tiny_config, shard_paths):
    batch = Mixture([(shard_paths["a"], 1.0)], seed=0).batch(0, 2)
    config = dataclasses.replace(tiny_config, network=TINY_UNET, objective="epsilon", learning_rate=4e-3)
    trainer = Trainer(config)
    before = loss_of(trainer, batch)
    for _ in range(5):
        trainer.learn(batch)
    assert loss_of(trainer, batch) < 0.95 * before


@pytest.mark.slow
def test_unet_trains_as_a_restoration_network_too(tiny_config, shard_paths):
    batch = Mixture([(shard_paths["a"], 1.0)], seed=0).batch(0, 2)
    trainer = Trainer(dataclasses.replace(tiny_config, network=TINY_UNET, learning_rate=4e-3))
    losses = [trainer.learn(batch)["loss"] for _ in range(5)]
    assert losses[-1] < losses[0]


def test_train_writes_a_diffusion(tiny_config, shard_paths, tmp_path):
    config = dataclasses.replace(tiny_config, objective="bernoulli", steps=3)
    result = train(
        config,
        train_shards=[(shard_paths["a"], 1.0)],
        validation_shards={"held": shard_paths["held_out"]},
        out=tmp_path,
        progress=False,
    )
    denoiser = load_model(result.model)
    assert isinstance(denoiser.network, DiffusionNet)
    assert denoiser.manifest.family == "diffusion"
    assert denoiser.manifest.default_timestep == 50
    assert denoiser.manifest.training["objective"] == "bernoulli"
    assert result.validation["held"]["timestep"] == 50
    assert TrainConfig.from_dict(json.loads((tmp_path / "config.json").read_text())) == config


def test_a_resumed_diffusion_ends_with_the_same_bits(tiny_config, shard_paths, tmp_path):
    config = dataclasses.replace(tiny_config, objective="epsilon", steps=4)
    shards = [(shard_paths["a"], 1.0)]

    class Stop(Exception):
        pass

    def stop(step, values):
        if step == 2:
            raise Stop

    once = dataclasses.replace(config, checkpoint_steps=1)
    with pytest.raises(Stop):
        train(once, train_shards=shards, out=tmp_path / "cut", progress=False, on_step=stop)
    resumed = train(once, train_shards=shards, out=tmp_path / "cut", progress=False, resume=True)
    whole = train(config, train_shards=shards, out=tmp_path / "whole", progress=False)
    first, second = (load_model(run.model).network.state_dict() for run in (resumed, whole))
    assert all(torch.equal(first[name], second[name]) for name in first)


def test_init_from_wants_the_same_objective(tiny_config, shard_paths, tmp_path):
    config = dataclasses.replace(tiny_config, objective="epsilon", steps=1)
    model = train(config, train_shards=[(shard_paths["a"], 1.0)], out=tmp_path, progress=False).model
    start = dataclasses.replace(config, init_from=str(model))
    assert Trainer(start).started_from is not None
    with pytest.raises(ValueError, match="has another network"):
        Trainer(dataclasses.replace(start, objective="x0"))


def test_config_takes_the_unet_and_refuses_other_objectives():
    config = TrainConfig(network=TINY_UNET, objective="epsilon")
    assert TrainConfig.from_dict(json.loads(config.to_json())) == config
    assert TrainConfig.from_dict({"network": {"kind": "unet"}, "objective": "epsilon"}).network == UNetConfig()
    with pytest.raises(ValueError, match="objective must be one of"):
        TrainConfig(objective="score")
    with pytest.raises(ValueError, match="kind must name a backbone"):
        TrainConfig.from_dict({"network": {"kind": "diffusion", "objective": "x0", "network": {}}})
