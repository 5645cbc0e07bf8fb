"""benchmarks/release/train_diffusion.py with hardly anything to do."""

import json

import pytest
from unghost_tests.benches import parsed, refusal

from benchmarks.release import train_diffusion
from unghost.prior.checkpoint import load_model
from unghost.prior.networks.unet import UNetConfig
from unghost.prior.training.config import TrainConfig


@pytest.fixture
def bench(monkeypatch, tiny_config):
    module = train_diffusion
    runs = {
        name: TrainConfig(objective=run.objective, network=tiny_config.network) for name, run in module.RUNS.items()
    }
    monkeypatch.setattr(module, "PUBLISHED", dict(module.RUNS), raising=False)
    monkeypatch.setattr(module, "RUNS", runs)
    return module


def test_runs_follow_one_another_and_leave_models(bench, shard_paths, tmp_path, capsys):
    words = [str(shard_paths["a"]), "--out", str(tmp_path), "--steps", "2", "--batch-size", "2", "--precision", "fp32"]
    bench.main([*words, "--which", "compact-x0", "compact-bernoulli"])
    lines = [line for line in capsys.readouterr().out.splitlines() if "steps in" in line]
    assert [line.split(":")[0] for line in lines] == ["compact-x0", "compact-bernoulli"]
    for name in ("compact-x0", "compact-bernoulli"):
        denoiser = load_model(tmp_path / name / "model.safetensors")
        assert denoiser.manifest.family == "diffusion"
        assert denoiser.manifest.name == f"unghost-{name}"
        again = TrainConfig.from_dict(json.loads((tmp_path / name / "config.json").read_text()))
        assert again.objective == name.split("-")[1]


def test_compact_runs_differ_in_the_objective_alone(bench):
    compact = [run for name, run in bench.PUBLISHED.items() if name.startswith("compact")]
    assert {run.objective for run in compact} == {"epsilon", "x0", "bernoulli"}
    base = TrainConfig()
    for run in compact:
        assert TrainConfig.from_dict({**json.loads(run.to_json()), "objective": "restoration"}) == base
    assert bench.PUBLISHED["unet-epsilon"].network == UNetConfig()


def test_a_budget_is_needed(bench, shard_paths, tmp_path, capsys):
    with pytest.raises(SystemExit):
        bench.main([str(shard_paths["a"]), "--out", str(tmp_path)])
    assert "give --minutes or --steps" in capsys.readouterr().err


def test_short_and_what_is_missing(monkeypatch, capsys):
    short = parsed(train_diffusion, "--short")
    assert {name: getattr(short, name) for name in short.SHORT} == short.SHORT
    assert "needs SHARDS" in refusal(train_diffusion, monkeypatch, capsys)
