"""Scores that are probabilities."""

import numpy as np
import pytest
import torch

from benchmarks.release.calibration import bake, calibration_error, fit_platt, judged_voxels, kept_and_removed
from unghost.core.occupancy import opacity_from_signed
from unghost.core.shards.packing import dequantize_signed, unpack_labels
from unghost.core.shards.storage import read_shard
from unghost.prior.networks.restoration import NetworkConfig, RestorationNet


def test_platt_finds_the_truth_again():
    rng = np.random.default_rng(0)
    true = rng.normal(0, 2, 200_000)
    surface = rng.random(len(true)) < 1 / (1 + np.exp(-true))
    shown = (true - 0.7) / 0.4  # logits that are too sure, and shifted
    scale, shift = fit_platt(shown, surface)
    assert scale == pytest.approx(0.4, abs=0.01)
    assert shift == pytest.approx(0.7, abs=0.02)
    assert calibration_error(scale * shown + shift, surface) < 0.005 < 0.1 < calibration_error(shown, surface)
    for of_one_kind in (np.ones(5, bool), np.zeros(5, bool)):
        with pytest.raises(ValueError, match="voxels of both kinds"):
            fit_platt(np.arange(5.0), of_one_kind)


def test_calibration_error_by_hand():
    # ten voxels at .9, of which seven are surface; ten at .1, of which one is: (10 * .2 + 10 * 0) / 20
    logits = np.repeat(np.log([9.0, 1 / 9]), 10)
    surface = np.array([1] * 7 + [0] * 3 + [1] + [0] * 9, bool)
    assert calibration_error(logits, surface) == pytest.approx(0.1)


def test_baking_changes_the_logits_and_nothing_else():
    torch.manual_seed(0)
    network = RestorationNet(NetworkConfig(widths=(8, 16, 8))).eval()
    inputs = torch.rand(2, 1, 32, 32, 32) * 2 - 1, torch.tensor([900, 100]), torch.tensor([0.1, 0.4])
    with torch.no_grad():
        before = network.logits(*inputs)
        bake(network, 0.6, -1.3)
        torch.testing.assert_close(network.logits(*inputs), 0.6 * before - 1.3, atol=1e-4, rtol=1e-4)


def test_shares_by_hand():
    logits, surface = np.array([-2.0, 0.0, 2.0, -2.0, 2.0]), np.array([1, 1, 1, 0, 0], bool)
    assert kept_and_removed(logits, surface, -0.1) == pytest.approx((2 / 3, 1 / 2))


def test_only_opaque_voxels_that_count_are_judged(shard_paths):
    network = RestorationNet(NetworkConfig(widths=(8, 8, 8), channels=("signed_opacity", "support")))
    logits, surface = judged_voxels(network.eval(), [shard_paths["seen"]], timestep=900, cubes=100)
    shard = read_shard(shard_paths["seen"])
    labels = unpack_labels(shard.labels)
    counts = (opacity_from_signed(dequantize_signed(shard.inputs)) > 0.1) & (labels != 2)
    assert len(logits) == len(surface) == counts.sum()
    np.testing.assert_array_equal(surface, labels[counts] == 1)
