import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from unghost.core.channels import CHANNEL_NAMES, UNKNOWN
from unghost.core.manifest import Manifest
from unghost.core.shards.packing import dequantize_signed, pack_labels, quantize_signed
from unghost.core.shards.storage import read_shard, write_shard
from unghost.prior.training.batches import stored_channels
from unghost.prior.training.validation import KeepCurve, evaluate, masked_iou


class Rule:
    """A denoiser from a function of the channels."""

    kind = "numpy"

    def __init__(self, rule, timestep=500):
        self.rule, self.manifest, self.asked = rule, Manifest(name="rule", default_timestep=timestep), []

    def __call__(self, channels, timestep, edge_fraction):
        self.asked.append((len(channels), timestep))
        return self.rule(channels)


def test_masked_iou_table():
    empty, full = np.zeros((1, 2, 2, 2), bool), np.ones((1, 2, 2, 2), bool)
    half = empty.copy()
    half[0, 0] = True
    everywhere = full
    cases = [(empty, empty, 1.0), (empty, full, 0.0), (full, full, 1.0), (half, full, 0.5), (half, half, 1.0)]
    for preds, target, expected in cases:
        assert masked_iou(preds, target, everywhere)[0] == expected
    assert masked_iou(half, full, half)[0] == 1.0  # only what is valid counts
    assert masked_iou(full, empty, empty)[0] == 1.0  # nothing valid: both empty


def test_keep_curve_by_hand():
    curve = KeepCurve()
    score = np.array([-0.9, -0.5, 0.0, 0.5, 0.9, -0.7, -0.2, 0.6])
    true = np.array([1, 1, 1, 1, 1, 0, 0, 0], bool)
    curve.add(score, true, ~true)
    threshold = curve.threshold(0.8)  # one of five true voxels may go, -0.9; the next is -0.5
    assert -0.5 - 1 / 1024 <= threshold <= -0.5
    assert curve.kept(threshold) == 0.8
    assert curve.removed(threshold) == pytest.approx(1 / 3)  # -0.7
    assert curve.kept(curve.threshold(1.0)) == 1.0


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([0.98, 0.95, 0.9]))
def test_keep_curve_against_a_sweep(seed, kept):
    rng = np.random.default_rng(seed)
    true, ghost = rng.uniform(-1, 1, 300) ** 3, rng.uniform(-1, 1, 200)
    curve = KeepCurve()
    curve.add(np.concatenate([true, ghost]), np.arange(500) < 300, np.arange(500) >= 300)
    threshold = curve.threshold(kept)
    assert (true >= threshold).mean() >= kept
    assert (true >= threshold + 1 / 1024).mean() < kept or threshold == 1.0
    assert curve.removed(threshold) == pytest.approx((ghost < threshold).mean())
    assert curve.kept(threshold) == pytest.approx((true >= threshold).mean())


def test_extremes_are_counted():
    curve = KeepCurve()
    curve.add(np.array([-1.0, 1.0]), np.array([True, True]), np.array([False, False]))
    assert curve.true.sum() == 2
    assert np.isnan(curve.removed(0.0))


def test_the_identity_and_the_oracle(shard_paths):
    shard = read_shard(shard_paths["held_out"])
    same = evaluate(Rule(lambda c: np.where(c > -0.8, 1.0, -1.0).astype(np.float32)), shard)
    assert same["iou"] == pytest.approx(same["iou_before"])
    assert same["iou_clean"] == 1.0
    assert same["ghosts_removed_zero"] == 0.0
    assert same["surface_kept_zero"] == 1.0
    oracle = evaluate(Rule(lambda c: np.where(c > 0.5, 1.0, -1.0).astype(np.float32)), shard)
    assert oracle["iou"] == 1.0  # in these shards blobs have half the opacity
    assert oracle["ghosts_removed_98"] == 1.0
    assert oracle["iou_before"] < 1.0
    assert oracle["true_voxels"] > 0 < oracle["ghost_voxels"]


def test_raw_opacity_is_swept_beside(shard_paths):
    shard = read_shard(shard_paths["held_out"])
    row = evaluate(Rule(lambda c: c), shard)
    for kept in ("98", "95", "90"):
        assert row[f"ghosts_removed_{kept}"] == row[f"ghosts_removed_{kept}_opacity"]
    assert row["ghosts_removed_98"] == 1.0


def test_severity_rows_add_up(shard_paths):
    shard = read_shard(shard_paths["held_out"])
    row = evaluate(Rule(lambda c: c), shard)
    clean = int((shard.severity == 0).sum())
    assert sum(part["cubes"] for part in row["by_severity"]) + clean == row["cubes"] == 10
    total = sum(part["iou"] * part["cubes"] for part in row["by_severity"]) + clean * row["iou_clean"]
    assert total / 10 == pytest.approx(row["iou"])


def test_limit_timestep_and_batches(shard_paths):
    shard, rule = read_shard(shard_paths["held_out"]), Rule(lambda c: c, timestep=321)
    assert evaluate(rule, shard, limit=5, batch_size=2)["cubes"] == 5
    assert rule.asked == [(2, 321), (2, 321), (1, 321)]
    assert evaluate(rule, shard, timestep=7)["timestep"] == 7


def test_ignored_voxels_do_not_count(tmp_path):
    """Half of the cube is a ghost, and ignored: no ghost is left."""
    signed, labels = np.full((1, 32, 32, 32), -1.0), np.zeros((1, 32, 32, 32), np.uint8)
    signed[0, :16], labels[0, :16] = 1.0, 2
    signed[0, 20], labels[0, 20] = 1.0, 1
    arrays = {
        "inputs": quantize_signed(signed),
        "labels": pack_labels(labels),
        "severity": np.ones(1, np.float32),
        "edge_fraction": np.ones(1, np.float32),
        "group": np.zeros(1, np.int32),
    }
    write_shard(tmp_path / "shard", arrays, {})
    row = evaluate(Rule(lambda c: c), read_shard(tmp_path / "shard"))
    assert row["iou_before"] == row["iou"] == 1.0
    assert (row["true_voxels"], row["ghost_voxels"]) == (1024, 0)
    assert row["ghosts_removed_98"] is None
    assert row["iou_clean"] is None


def test_inputs_reach_the_denoiser_as_stored(shard_paths):
    shard, seen = read_shard(shard_paths["held_out"]), []
    evaluate(Rule(lambda c: seen.append(c.copy()) or c), shard)
    assert np.array_equal(np.concatenate(seen)[:, 0], dequantize_signed(np.asarray(shard.inputs)))


def test_a_denoiser_gets_the_channels_it_names(shard_paths):
    """A ghost is what no view sees: with the views known, the rule is followed; without, all is unseen."""
    shard, seen = read_shard(shard_paths["seen"]), []

    def rule(channels):
        seen.append(channels.copy())
        return np.where(channels[:, 1:2] > -0.4, channels[:, :1], -1.0).astype(np.float32)

    denoiser = Rule(rule)
    names = ("signed_opacity", "view_count", "surroundings")
    denoiser.manifest = Manifest(name="rule", channels=names)
    told, blind = evaluate(denoiser, shard), evaluate(denoiser, shard, without=CHANNEL_NAMES[1:])
    np.testing.assert_array_equal(seen[0], stored_channels(shard, np.arange(9), names))
    assert (seen[1][:, 1:] == UNKNOWN).all()
    assert blind["surface_kept_zero"] == 0.0 < told["surface_kept_zero"] < 1.0
    assert told["iou_before"] == blind["iou_before"]
