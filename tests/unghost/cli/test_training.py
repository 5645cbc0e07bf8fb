import json

import numpy as np
import pytest

from unghost import cli
from unghost.core.channels import CHANNEL_NAMES
from unghost.core.shards.packing import pack_labels
from unghost.core.shards.storage import write_shard

torch = pytest.importorskip("torch")


@pytest.fixture
def shard(tmp_path):
    rng = np.random.default_rng(0)
    arrays = {
        "inputs": rng.integers(0, 256, (4, 32, 32, 32), dtype=np.uint8),
        "labels": pack_labels(rng.integers(0, 3, (4, 32, 32, 32), dtype=np.uint8)),
        "severity": np.full(4, 0.5, np.float32),
        "edge_fraction": np.full(4, 0.1, np.float32),
        "group": np.zeros(4, np.int32),
        "surroundings": rng.integers(0, 256, (4, 16, 16, 16), dtype=np.uint8),
        "view_count": rng.integers(0, 20, (4, 32, 32, 32), dtype=np.uint8),
    }
    write_shard(tmp_path / "shard", arrays, {}, kind="harvest")
    return str(tmp_path / "shard")


QUICK = ["--steps", "1", "--batch-size", "4", "--precision", "fp32", "--size", "xs"]


def test_channels_size_and_a_recipe_made_meanwhile(shard, tmp_path, capsys):
    out = tmp_path / "run"
    words = ["train", shard, "--out", str(out), *QUICK, "--channels", *CHANNEL_NAMES, "--online", "procedural=.5"]
    assert cli.main([*words, "--drop-channels", "0.25"]) == 0
    config = json.loads((out / "config.json").read_text())
    assert config["network"]["channels"] == list(CHANNEL_NAMES)
    assert config["network"]["widths"] == [16, 32, 48]
    assert config["drop_channels"] == 0.25
    from unghost.prior.checkpoint import load_model

    manifest = load_model(out / "model.safetensors").manifest
    assert manifest.channels == CHANNEL_NAMES
    assert manifest.training["online"] == [{"name": "procedural", "share": 0.5}]
    assert "1 steps" in capsys.readouterr().out


def test_a_configuration_file_keeps_its_channels(shard, tmp_path):
    first, second = tmp_path / "first", tmp_path / "second"
    names = CHANNEL_NAMES[::2]
    assert cli.main(["train", shard, "--out", str(first), *QUICK, "--channels", *names]) == 0
    assert cli.main(["train", shard, "--out", str(second), "--config", str(first / "config.json")]) == 0
    assert json.loads((second / "config.json").read_text())["network"]["channels"] == list(names)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--size", "xl"], "unghost train: --size must be one of xs, s, m, l, got 'xl'"),
        (["--channels", "view_count"], "NetworkConfig: channels must start with 'signed_opacity'"),
        (["--online", "procedural"], "--online must be RECIPE=SHARE, the share in (0, 1], got 'procedural'"),
        (["--online", "procedural=2"], "--online must be RECIPE=SHARE"),
        (["--online", "absent=.5"], "load_recipe: absent is neither a file nor a built-in recipe"),
        (["--online", "meshes=.5"], "--mesh-root"),
        (["--online", "procedural=1"], "Blend: shards, and 0 of"),
    ],
)
def test_refusals_are_one_line(words, message, shard, tmp_path, capsys):
    assert cli.main(["train", shard, "--out", str(tmp_path / "run"), *words]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not (tmp_path / "run").exists()
