"""Which threshold a shipped model gets, and that its files hold it."""

import json
import sys

import numpy as np
import pytest
import torch

pytest.importorskip("tyro")

from unghost_tests.benches import check_short, refusal

from benchmarks.release import ship
from unghost import load_denoiser
from unghost.core.manifest import Manifest
from unghost.prior.checkpoint import save_model
from unghost.prior.networks.restoration import NetworkConfig, RestorationNet, parameter_count


@pytest.fixture
def options(tmp_path):
    torch.manual_seed(0)
    network = RestorationNet(NetworkConfig(widths=(8, 8, 8)))
    save_model(tmp_path / "model.safetensors", network, Manifest("m", parameters=parameter_count(network)))
    return ship.Options(tmp_path / "model.safetensors", "mine", out=tmp_path, weights=tmp_path / "weights")


def kept_until(threshold):
    """``row_of`` of a model that keeps enough up to some threshold."""

    def row_of(denoiser, candidate, rooms):
        kept = 0.99 if candidate <= threshold + 1e-9 else 0.9
        return {"method": "clean", "threshold": candidate, "surface_kept": kept}

    return row_of


def test_the_largest_threshold_that_keeps_enough(options, monkeypatch):
    monkeypatch.setattr(ship, "row_of", kept_until(0.2))
    chosen, rows = ship.choose(None, options)
    assert chosen == 0.2
    assert rows[-1]["threshold"] == 0.3  # and no further
    monkeypatch.setattr(ship, "row_of", kept_until(-2.0))
    with pytest.raises(SystemExit, match="nothing is written"):
        ship.choose(None, options)


@pytest.mark.slow
@pytest.mark.parametrize("half", [False, True])
def test_the_files_hold_the_threshold_and_agree(options, half, monkeypatch, tmp_path):
    monkeypatch.setattr(ship, "row_of", kept_until(0.1))
    options.weights.mkdir()
    words = [str(options.checkpoint), "mine", "--out", str(tmp_path), "--weights", str(options.weights)]
    monkeypatch.setattr(sys, "argv", ["ship.py", *words, *(["--half"] if half else [])])
    ship.main()
    onnx, torch_model = (load_denoiser(options.weights / f"mine.{end}") for end in ("onnx", "safetensors"))
    assert onnx.manifest.removal_threshold == torch_model.manifest.removal_threshold == 0.1
    assert onnx.precision == ("fp16" if half else "fp32")
    cubes = np.random.default_rng(0).uniform(-1, 1, (2, 1, 32, 32, 32)).astype(np.float32)
    difference = np.abs(onnx(cubes, 900, 0.1) - torch_model(torch.from_numpy(cubes), 900, 0.1).numpy()).max()
    assert difference < 1e-5  # the very same weights, halved or not
    rows = json.loads((tmp_path / "threshold_mine.json").read_text(encoding="utf-8"))["rows"]
    assert [row["threshold"] for row in rows if row["chosen"]] == [0.1]


def test_short_ships_nothing_and_what_is_missing(monkeypatch, capsys, tmp_path):
    check_short(ship, name="xs")
    assert ship.Options(short=True).shortened().weights != ship.WEIGHTS
    assert "needs CHECKPOINT" in refusal(ship, monkeypatch, capsys)
    assert "needs NAME" in refusal(ship, monkeypatch, capsys, tmp_path)
