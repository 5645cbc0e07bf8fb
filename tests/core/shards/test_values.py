"""What the arrays of a shard may hold: labels, opacities, frames, sources."""

import hashlib
import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from unghost.core.frames import CubeFrame, random_rotations
from unghost.core.shards.packing import (
    dequantize_signed,
    pack_frame,
    pack_labels,
    quantize_signed,
    unpack_frame,
    unpack_labels,
)
from unghost.core.shards.storage import read_shard, stays_within, write_shard


def test_labels_by_hand():
    labels = np.zeros((1, 32, 32, 32), dtype=np.uint8)
    labels[0, 0, 0, :4] = [1, 2, 0, 1]  # the first voxel in the lowest two bits: 1 + 2 * 4 + 0 * 16 + 1 * 64
    packed = pack_labels(labels)
    assert packed.shape == (1, 8192)
    assert packed[0, 0] == 73
    np.testing.assert_array_equal(unpack_labels(packed), labels)


@pytest.mark.parametrize(
    ("labels", "rule"),
    [
        (np.full((1, 32, 32, 32), 3, np.uint8), "must be 0, 1 or 2, got 3 to 3"),
        (np.full((1, 2, 2, 2), -1), "must be 0, 1 or 2, got -1 to -1"),
        (np.zeros((32, 32, 32), np.uint8), r"must have shape \(N, R, R, R\) with an even R, got \(32, 32, 32\)"),
        (np.zeros((2, 3, 3, 3), np.uint8), r"must have shape .* with an even R, got \(2, 3, 3, 3\)"),
    ],
)
def test_labels_that_are_none_are_refused(labels, rule):
    with pytest.raises(ValueError, match=f"pack_labels: labels {rule}"):
        pack_labels(labels)


@pytest.mark.parametrize("shape", [(8192,), (1, 8191), (0, 4), (1, 2, 4096)])
def test_bytes_that_are_no_labels_are_refused(shape):
    with pytest.raises(ValueError, match=r"unpack_labels: packed must have shape \(N, 8192\), got"):
        unpack_labels(np.zeros(shape, dtype=np.uint8))


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_packing_is_inverse(seed):
    labels = np.random.default_rng(seed).integers(0, 3, size=(2, 32, 32, 32), dtype=np.uint8)
    np.testing.assert_array_equal(unpack_labels(pack_labels(labels)), labels)


def test_quantisation_is_exact_at_the_ends_and_idempotent():
    assert quantize_signed(np.array([-1.0, 1.0])).tolist() == [0, 255]
    assert dequantize_signed(np.array([0, 255], dtype=np.uint8)).tolist() == [-1.0, 1.0]
    every = np.arange(256, dtype=np.uint8)
    np.testing.assert_array_equal(quantize_signed(dequantize_signed(every)), every)
    values = np.linspace(-1, 1, 10_001)
    assert np.abs(dequantize_signed(quantize_signed(values)) - values).max() <= 1 / 255 + 1e-6


@pytest.mark.parametrize(
    ("name", "value", "rule"),
    [
        ("severity", -0.1, r"lie in \[0, 1\], got -0.1"),
        ("severity", 1.5, r"lie in \[0, 1\], got 1.5"),
        ("severity", np.nan, r"lie in \[0, 1\], got nan"),
        ("edge_fraction", 0.0, "be finite and > 0, got 0.0"),
        ("edge_fraction", np.nan, "be finite and > 0, got nan"),
        ("edge_fraction", np.inf, "be finite and > 0, got inf"),
        ("labels", 3 << 4, "be 0, 1 or 2, got 3"),
    ],
)
def test_values_out_of_range_are_neither_written_nor_verified(tmp_path, shard, name, value, rule, arrays):
    wrong = arrays()[name]
    wrong.reshape(-1)[1] = value
    with pytest.raises(ValueError, match=f"write_shard: {name} must {rule}"):
        write_shard(tmp_path / "s", arrays() | {name: wrong}, {})
    path = shard / f"{name}.npy"
    np.save(path, wrong)
    manifest = json.loads((shard / "manifest.json").read_text(encoding="utf-8"))
    manifest["sha256"][name] = hashlib.sha256(path.read_bytes()).hexdigest()
    (shard / "manifest.json").write_text(json.dumps(manifest), encoding="utf-8")
    with pytest.raises(ValueError, match=f"read_shard: .*{name} must {rule}"):
        read_shard(shard, verify=True)


def test_a_frame_by_hand(optional):
    numbers = optional()["frames"]
    assert numbers[0].tolist() == [0.5, -1, 2, 0.25, 0, -1, 0, 1, 0, 0, 0, 0, 1]
    assert np.isnan(numbers[1]).all()
    assert unpack_frame(numbers[1]) is None


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_frames_survive_exactly(seed):
    rng = np.random.default_rng(seed)
    frame = CubeFrame(rng.normal(size=3), float(rng.uniform(1e-6, 1e3)), random_rotations(rng, 1)[0])
    back = unpack_frame(pack_frame(frame))
    np.testing.assert_array_equal(back.center, frame.center)
    np.testing.assert_array_equal(back.rotation, frame.rotation)
    assert back.edge_length == frame.edge_length


@pytest.mark.parametrize(
    ("column", "value"), [(0, np.nan), (2, np.inf), (3, 0.0), (3, -1.0), (5, 0.5), (12, np.nan), (12, 2.0), (5, np.inf)]
)
def test_frames_that_are_none_are_refused(tmp_path, column, value, arrays, optional):
    wrong = optional()["frames"]
    wrong[0, column] = value
    with pytest.raises(ValueError, match="write_shard: each row of frames must be NaN throughout or"):
        write_shard(tmp_path / "s", arrays() | {"frames": wrong}, {})
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("provenance", "rule"),
    [
        ({}, "must hold sources"),
        ({"sources": {"path": "a"}}, "must hold sources"),
        ({"sources": ["a"]}, "must hold sources"),
        ({"sources": []}, r"source must lie in \[-1, 0\), got -1 to 0"),
        ({"sources": [{"path": "/etc/a.obj"}]}, "must be relative"),
        ({"sources": [{"path": "a/../../b.obj"}]}, "must be relative"),
        ({"sources": [{"path": "C:\\b.obj"}]}, "must be relative"),
    ],
)
def test_sources_that_are_none_are_refused(tmp_path, provenance, rule, arrays, optional):
    with pytest.raises(ValueError, match=rule):
        write_shard(tmp_path / "s", arrays() | {"source": optional()["source"]}, provenance)
    assert not list(tmp_path.iterdir())


def test_paths_by_hand():
    assert all(stays_within(path) for path in ("a.obj", "a/b c.obj", "..a/b", ""))
    assert not any(stays_within(path) for path in ("/a", "../a", "a/../b", "C:a", "a\\..\\b", "file:///a"))
