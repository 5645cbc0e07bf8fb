import dataclasses
import json
import math
import os
import re
import signal
import subprocess
import sys
import textwrap

import pytest
import torch

from unghost.core import progress
from unghost.core.channels import CHANNEL_NAMES
from unghost.data_recipes.online import OnlinePairs
from unghost.data_recipes.recipe import load_recipe
from unghost.prior.checkpoint import load_model, read_tensors
from unghost.prior.training import loop as train_module
from unghost.prior.training.batches import Batch, Mixture
from unghost.prior.training.blend import Online
from unghost.prior.training.config import TrainConfig
from unghost.prior.training.loop import train
from unghost.prior.training.run_state import TrainingDiverged


class Killed(Exception):
    pass


def kill_after(step):
    def on_step(number, _values):
        if number == step:
            raise Killed

    return on_step


@pytest.fixture
def shards(shard_paths):
    return {
        "train_shards": [(shard_paths["a"], 2.0), (shard_paths["b"], 1.0)],
        "validation_shards": {"held": shard_paths["held_out"]},
        "progress": False,
    }


def test_a_whole_run(tiny_config, shards, tmp_path):
    seen = []
    config = dataclasses.replace(tiny_config, threshold_from="held", validate_seconds=1e-9)
    result = train(config, **shards, out=tmp_path / "run", on_step=lambda step, values: seen.append((step, values)))
    assert (result.steps, result.reason) == (6, "steps")
    assert [step for step, _ in seen] == [1, 2, 3, 4, 5, 6]
    assert all(math.isfinite(values["loss"]) for _, values in seen)
    names = {item.name for item in (tmp_path / "run").iterdir()}
    assert names == {
        "config.json",
        "log.jsonl",
        "model.safetensors",
        "state.safetensors",
        "tensorboard",
        "validation.json",
    }
    denoiser = load_model(result.model)
    row = result.validation["held"]
    assert row["cubes"] == 10
    assert denoiser.manifest.removal_threshold == row["threshold_98"]
    assert denoiser.manifest.parameters == sum(value.numel() for value in denoiser.network.parameters())
    training = denoiser.manifest.training
    assert (training["steps"], training["seed"], training["precision"]) == (6, 3, "fp32")
    (source,) = training["shards"]
    assert (source["first"], source["last"], source["shards"]) == ("a", "b", 2)
    averaged = {name: value for name, value in read_tensors(tmp_path / "run" / "state.safetensors")[0].items()}
    for name, value in denoiser.network.state_dict().items():
        assert torch.equal(value, averaged[f"average.{name}"])
    log = [json.loads(line) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    assert sum(line["kind"] == "validation" for line in log) == 7
    assert str(tmp_path) not in json.dumps(training)


def test_config_is_on_disk_before_the_first_step(tiny_config, shards, tmp_path):
    with pytest.raises(Killed):
        train(tiny_config, **shards, out=tmp_path / "run", on_step=kill_after(1))
    saved = json.loads((tmp_path / "run" / "config.json").read_text())
    assert TrainConfig.from_dict(saved) == tiny_config
    assert not (tmp_path / "run" / "model.safetensors").exists()


def test_resumed_run_has_the_bits_of_one_that_was_not_killed(tiny_config, shards, tmp_path):
    config = dataclasses.replace(tiny_config, checkpoint_steps=3)
    whole = train(config, **shards, out=tmp_path / "whole")
    with pytest.raises(Killed):
        train(config, **shards, out=tmp_path / "parts", on_step=kill_after(4))  # one step after the checkpoint
    resumed = train(config, **shards, out=tmp_path / "parts", resume=True)
    assert resumed.steps == 6
    assert whole.validation == resumed.validation
    first, second = (read_tensors(tmp_path / name / "state.safetensors")[0] for name in ("whole", "parts"))
    assert set(first) == set(second)
    assert all(torch.equal(first[name], second[name]) for name in first)
    assert any(name.startswith("optimizer.0.exp_avg") for name in first)


@pytest.mark.slow
def test_all_channels_and_an_online_recipe_resume_with_the_same_bits(tiny_config, shard_paths, tmp_path):
    network = dataclasses.replace(tiny_config.network, channels=CHANNEL_NAMES)
    config = dataclasses.replace(tiny_config, network=network, steps=4, checkpoint_steps=2, drop_channels=0.3)

    def run(out, **more):
        online = [Online("procedural", 0.3, OnlinePairs(load_recipe("procedural"), seed=11))]
        shards = [(shard_paths["seen"], 1.0)]
        return train(
            config,
            train_shards=shards,
            validation_shards={"seen": shard_paths["seen"]},
            online=online,
            out=tmp_path / out,
            progress=False,
            **more,
        )

    whole = run("whole")
    with pytest.raises(Killed):
        run("parts", on_step=kill_after(3))
    resumed = run("parts", resume=True)
    first, second = (read_tensors(tmp_path / name / "state.safetensors")[0] for name in ("whole", "parts"))
    assert all(torch.equal(first[name], second[name]) for name in first)
    assert whole.validation == resumed.validation
    manifest = load_model(resumed.model).manifest
    assert manifest.channels == CHANNEL_NAMES
    assert manifest.training["online"] == [{"name": "procedural", "share": 0.3}]
    assert manifest.training["drop_channels"] == 0.3
    plain = train(config, train_shards=[(shard_paths["seen"], 1.0)], out=tmp_path / "plain", progress=False)
    others = load_model(plain.model).network.state_dict()
    assert not all(
        torch.equal(value, others[name]) for name, value in load_model(whole.model).network.state_dict().items()
    )


def test_other_seed_gives_other_bits(tiny_config, shards, tmp_path):
    states = []
    for seed in (0, 1):
        config = dataclasses.replace(tiny_config, steps=1, seed=seed)
        train(config, **shards, out=tmp_path / str(seed))
        states.append(read_tensors(tmp_path / str(seed) / "state.safetensors")[0]["live.stem.weight"])
    assert not torch.equal(*states)


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs SIGKILL")
def test_a_killed_process_leaves_a_state_to_go_on_from(tiny_config, shards, tmp_path):
    """SIGKILL right after a step, checkpoints at every step: whatever is on disk is whole."""
    code = textwrap.dedent(
        f"""
        import json, os, signal
        from unghost.prior.training.config import TrainConfig
        from unghost.prior.training.loop import train
        def on_step(step, values):
            if step == 2:
                os.kill(os.getpid(), signal.SIGKILL)
        train(TrainConfig.from_dict(json.loads({tiny_config.to_json()!r}) | {{"checkpoint_steps": 1}}),
              train_shards=[({str(shards["train_shards"][0][0])!r}, 1.0)], out={str(tmp_path / "run")!r},
              progress=False, on_step=on_step)
        """
    )
    done = subprocess.run([sys.executable, "-c", code], env=os.environ | {"OMP_NUM_THREADS": "1"}, check=False)
    assert done.returncode == -signal.SIGKILL
    tensors, metadata = read_tensors(tmp_path / "run" / "state.safetensors")
    assert metadata["step"] == "2"
    config = dataclasses.replace(tiny_config, steps=3)
    result = train(config, train_shards=shards["train_shards"][:1], out=tmp_path / "run", resume=True, progress=False)
    assert result.steps == 3
    assert tensors


def test_tensorboard_gets_the_numbers_of_the_log(tiny_config, shards, tmp_path):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    train(dataclasses.replace(tiny_config, steps=20), **shards, out=tmp_path / "run")
    board = EventAccumulator(str(tmp_path / "run" / "tensorboard"))
    board.Reload()
    log = [json.loads(line) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    for key in ("loss", "gradient_norm", "learning_rate"):
        found = [(event.step, event.value) for event in board.Scalars(f"train/{key}")]
        expected = [(line["step"], line[key]) for line in log if line["kind"] == "train"]
        assert [step for step, _ in found] == [1, 20]
        assert found == [(step, pytest.approx(value, rel=1e-6)) for step, value in expected]
    assert [event.step for event in board.Scalars("held/iou")] == [20]


def test_divergence_keeps_the_last_good_checkpoint(tiny_config, shards, tmp_path, monkeypatch):
    honest = Mixture.batch

    def poisoned(self, step, batch_size) -> Batch:
        batch = honest(self, step, batch_size)
        return dataclasses.replace(batch, channels=batch.channels * math.nan) if step == 4 else batch

    monkeypatch.setattr(Mixture, "batch", poisoned)
    config = dataclasses.replace(tiny_config, checkpoint_steps=2)
    with pytest.raises(TrainingDiverged, match="step 4: loss nan"):
        train(config, **shards, out=tmp_path / "run")
    tensors, metadata = read_tensors(tmp_path / "run" / "state.safetensors")
    assert metadata["step"] == "4"
    assert all(bool(torch.isfinite(value).all()) for value in tensors.values())
    assert not (tmp_path / "run" / "model.safetensors").exists()


@pytest.mark.slow
def test_time_budget_ends_a_run_with_a_decayed_rate(tiny_config, shards, tmp_path):
    rates = []
    config = dataclasses.replace(tiny_config, steps=100_000, max_seconds=0.5, learning_rate=1e-3)
    result = train(config, **shards, out=tmp_path / "run", on_step=lambda _, v: rates.append(v["learning_rate"]))
    assert result.reason == "max_seconds"
    assert 1 < result.steps < 100_000
    assert result.seconds >= 0.5
    assert rates[-1] < 0.6 * max(rates)


def test_a_folder_that_holds_a_run_is_refused(tiny_config, shards, tmp_path):
    config = dataclasses.replace(tiny_config, steps=1)
    train(config, **shards, out=tmp_path / "run")
    with pytest.raises(FileExistsError, match="holds a run already"):
        train(config, **shards, out=tmp_path / "run")


def test_unknown_threshold_shard_and_unreadable_shards(tiny_config, shards, tmp_path):
    config = dataclasses.replace(tiny_config, threshold_from="harvest")
    with pytest.raises(ValueError, match="threshold_from 'harvest' is not among \\['held'\\]"):
        train(config, **shards, out=tmp_path / "run")
    with pytest.raises(ValueError, match="not a shard"):
        train(tiny_config, train_shards=[(tmp_path / "absent", 1.0)], out=tmp_path / "run", progress=False)
    assert not (tmp_path / "run").exists()


def test_works_without_tensorboard_and_shows_a_bar(tiny_config, shards, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    monkeypatch.setattr(progress, "SECONDS_BETWEEN_LINES", 0.0)  # the work is quick
    config = dataclasses.replace(tiny_config, steps=2)
    result = train(config, **(shards | {"progress": True}), out=tmp_path / "run")
    assert result.steps == 2
    assert not (tmp_path / "run" / "tensorboard").exists()
    shown = capsys.readouterr()
    assert re.search(r"\| \d\d:\d\d < (\d\d:\d\d|\?), step 2, loss [\d.]+, \d+ cubes/s", shown.err)  # elapsed < left
    assert shown.out == ""
    assert train_module.MODEL_FILE in {item.name for item in (tmp_path / "run").iterdir()}
