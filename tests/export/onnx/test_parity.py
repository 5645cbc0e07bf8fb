import dataclasses

import numpy as np
import pytest

from unghost.core.channels import CHANNEL_NAMES, LEAST_KNOWN, UNKNOWN, coarse_channel, full_channel
from unghost.core.manifest import Manifest
from unghost.export.onnx.parity import compare, parity_inputs, verify
from unghost.export.onnx.to_onnx import export_onnx
from unghost.export.runtime import OnnxDenoiser
from unghost.prior.checkpoint import load_model, save_model
from unghost.prior.networks.restoration import NetworkConfig
from unghost.speed import measure_speed


def test_inputs_cover_the_extremes():
    inputs = parity_inputs(96, 0)
    flat = inputs.channels.reshape(96, -1)
    assert (flat == -1).all(axis=1).any()
    assert (flat == 1).all(axis=1).any()
    assert {0, 999} <= set(inputs.timestep.tolist())
    assert inputs.edge_fraction.min() <= 1e-6
    assert inputs.edge_fraction.max() >= 10
    assert (np.abs(flat) <= 1).all()


def test_input_i_depends_on_seed_and_i_alone():
    few, many = parity_inputs(5, 7), parity_inputs(9, 7)
    for name in ("channels", "timestep", "edge_fraction"):
        assert np.array_equal(getattr(few, name), getattr(many, name)[:5])


def test_inputs_of_more_channels():
    """The first is what it is alone; the others hold values of theirs, or are unknown throughout."""
    one, names = parity_inputs(32, 7), ("signed_opacity", "view_count", "surroundings")
    inputs = parity_inputs(32, 7, channels=names)
    assert np.array_equal(inputs.channels[:, :1], one.channels)
    assert np.array_equal(inputs.edge_fraction, one.edge_fraction)
    for channel in (1, 2):
        unknown = (inputs.channels[:, channel] == UNKNOWN).all(axis=(1, 2, 3))
        assert unknown.sum() == 8
        assert inputs.channels[~unknown, channel].min() >= LEAST_KNOWN
        assert inputs.channels[~unknown, channel].max() > 0.8
    about = inputs.channels[:, 2]
    assert np.array_equal(full_channel(coarse_channel(about)), about)


@pytest.mark.slow
def test_a_model_of_all_channels_passes_and_is_timed(make_lively, tmp_path):
    network = make_lively(NetworkConfig(channels=CHANNEL_NAMES, widths=(8, 16, 8), condition_width=8))
    save_model(tmp_path / "all.safetensors", network, Manifest(name="all", channels=CHANNEL_NAMES))
    manifest = export_onnx(tmp_path / "all.safetensors", tmp_path / "all.onnx")
    assert manifest.channels == CHANNEL_NAMES
    report = verify(tmp_path / "all.onnx", tmp_path / "all.safetensors", cubes=32)
    assert report["passed"], report
    speed = measure_speed(OnnxDenoiser(tmp_path / "all.onnx", threads=1), batch=2, seconds=1e-3)
    assert speed["cubes_per_second"] > 0


@pytest.mark.slow
def test_default_architecture_passes(exported):
    report = verify(exported.onnx, exported.checkpoint, cubes=96)
    assert report["cubes"] == 96
    assert report["max_error"] < 1e-4
    assert report["flip_rate"] <= 1e-5
    assert report["passed"]


def test_another_network_fails(exported, make_lively, tmp_path):
    save_model(tmp_path / "other.safetensors", make_lively(NetworkConfig(), 1), Manifest(name="other"))
    report = verify(exported.onnx, tmp_path / "other.safetensors", cubes=8)
    assert report["max_error"] > 1e-2
    assert report["flips"] > 0
    assert not report["passed"]


def test_counts_by_hand(exported):
    """An offset of 0.5 on one voxel of every cube that flips it."""
    reference = load_model(exported.checkpoint)
    inputs = parity_inputs(4, 0)

    class Shifted(OnnxDenoiser):
        def __call__(self, *asked):
            found = super().__call__(*asked)
            place = (slice(None), 0, 3, 4, 5)
            found[place] = np.where(found[place] < 0, found[place] + 1.5, found[place] - 1.5)
            return found

    report = compare(Shifted(exported.onnx), reference, inputs)
    assert report["max_error"] == pytest.approx(1.5, abs=1e-5)
    assert report["mean_error"] == pytest.approx(1.5 / 32**3, rel=1e-2)
    assert report["flips"] == 4
    assert report["flip_rate"] == 4 / (4 * 32**3)
    assert not report["passed"]


def test_nan_never_passes(exported):
    reference, inputs = load_model(exported.checkpoint), parity_inputs(2, 0)

    class Broken(OnnxDenoiser):
        def __call__(self, *asked):
            return super().__call__(*asked) * np.nan

    assert not compare(Broken(exported.onnx), reference, inputs)["passed"]


def test_errors(exported, make_lively, tmp_path):
    with pytest.raises(ValueError, match="cubes must be >= 1"):
        parity_inputs(0, 0)
    manifest = dataclasses.replace(exported.manifest, channels=("signed_opacity", "surroundings"))
    network = make_lively(NetworkConfig(channels=manifest.channels, widths=(8, 8, 8)))
    save_model(tmp_path / "two.safetensors", network, manifest)
    with pytest.raises(ValueError, match="surroundings"):
        verify(exported.onnx, tmp_path / "two.safetensors", cubes=1)
