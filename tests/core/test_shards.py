import hashlib
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from unghost.core.shards import (
    ARRAYS,
    dequantize_signed,
    pack_labels,
    quantize_signed,
    read_shard,
    unpack_labels,
    write_shard,
)

GOLDEN = {  # of the shard that `arrays` makes below; a change of these bytes is a change of the format
    "inputs": "2bd3ed2069e857c1432cdcf698c7ccc5e6c3f29e9f00e945283313d2349e04ee",
    "labels": "10ab8b581e864b697f597c0f4c05e1278888612bc5e6c3e1564f18222eb22bc3",
    "severity": "3623d9deebc035f4a8eb993baf814f2f4f33d8eadded45f519bf0a1d5da11a12",
    "edge_fraction": "3d9f06ab49bd336909d2bb0e3e129fe432276fcf7690abbcfef7c3387de76b56",
    "group": "28d4b63fdadd72ed19f8fad1638746569959d59ee50d3e10d67810fced9dc78f",
}


def arrays(count=2):
    voxels = np.arange(count * 32**3, dtype=np.uint64)
    return {
        "inputs": (voxels * 7 % 256).astype(np.uint8).reshape(count, 32, 32, 32),
        "labels": pack_labels((voxels % 3).astype(np.uint8).reshape(count, 32, 32, 32)),
        "severity": np.linspace(0, 1, count, dtype=np.float32),
        "edge_fraction": np.full(count, 0.25, dtype=np.float32),
        "group": np.arange(count, dtype=np.int32),
    }


@pytest.fixture
def shard(tmp_path):
    folder = tmp_path / "shard-00000"
    write_shard(folder, arrays(), {"recipe": "test", "seed": 3})
    return folder


def test_golden_bytes(shard):
    found = {name: hashlib.sha256((shard / f"{name}.npy").read_bytes()).hexdigest() for name in ARRAYS}
    assert found == GOLDEN
    assert sorted(path.name for path in shard.iterdir()) == sorted(
        [*(f"{name}.npy" for name in ARRAYS), "manifest.json"]
    )
    manifest = json.loads((shard / "manifest.json").read_text(encoding="utf-8"))
    assert manifest == {
        "format": "unghost-shard", "format_version": 1, "count": 2, "sha256": GOLDEN,
        "provenance": {"recipe": "test", "seed": 3},
    }  # fmt: skip


def test_round_trip_is_memory_mapped(shard):
    read = read_shard(shard, verify=True)
    assert len(read) == 2
    assert read.provenance == {"recipe": "test", "seed": 3}
    for name, array in arrays().items():
        np.testing.assert_array_equal(getattr(read, name), array)
    assert isinstance(read.inputs, np.memmap)


def test_labels_by_hand():
    labels = np.zeros((1, 32, 32, 32), dtype=np.uint8)
    labels[0, 0, 0, :4] = [1, 2, 0, 1]  # the first voxel in the lowest two bits: 1 + 2 * 4 + 0 * 16 + 1 * 64
    packed = pack_labels(labels)
    assert packed.shape == (1, 8192)
    assert packed[0, 0] == 73
    np.testing.assert_array_equal(unpack_labels(packed), labels)
    with pytest.raises(ValueError, match="labels must be 0, 1 or 2, got 4"):
        pack_labels(labels + 2)


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


def test_an_existing_folder_is_never_overwritten(shard):
    with pytest.raises(FileExistsError, match="exists already"):
        write_shard(shard, arrays(), {})


@pytest.mark.parametrize(("name", "wrong"), [("group", np.zeros(2)), ("labels", np.zeros((2, 5), np.uint8))])
def test_wrong_arrays_leave_nothing_behind(tmp_path, name, wrong):
    with pytest.raises(ValueError, match=f"write_shard: {name} must be"):
        write_shard(tmp_path / "s", arrays() | {name: wrong}, {})
    assert not list(tmp_path.iterdir())


def test_an_unfinished_shard_is_refused_and_can_be_written_again(tmp_path):
    half = tmp_path / "s.partial"
    half.mkdir()
    (half / "inputs.npy").write_bytes(b"rubbish")
    with pytest.raises(ValueError, match=r"has no manifest\.json: not a shard, or unfinished"):
        read_shard(half)
    write_shard(tmp_path / "s", arrays(), {})
    assert len(read_shard(tmp_path / "s", verify=True)) == 2
    assert not half.exists()


def test_truncated_arrays_are_refused(shard):
    path = shard / "inputs.npy"
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(ValueError, match=r"cannot read .*inputs\.npy"):
        read_shard(shard)


def test_missing_arrays_are_refused(shard):
    (shard / "group.npy").unlink()
    with pytest.raises(ValueError, match=r"cannot read .*group\.npy"):
        read_shard(shard)


def test_a_flipped_bit_is_found_by_verify(shard):
    path = shard / "labels.npy"
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)
    read_shard(shard)
    with pytest.raises(ValueError, match=r"labels\.npy does not match the hash"):
        read_shard(shard, verify=True)


def test_another_count_is_refused(shard):
    path = shard / "manifest.json"
    manifest = json.loads(path.read_text(encoding="utf-8"))
    path.write_text(json.dumps(manifest | {"count": 3}), encoding="utf-8")
    with pytest.raises(ValueError, match="the manifest says"):
        read_shard(shard)


@pytest.mark.parametrize("text", ["{", '{"format": "zip"}', '{"format": "unghost-shard", "format_version": 9}'])
def test_foreign_manifests_are_refused(shard, text):
    (shard / "manifest.json").write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match="read_shard: "):
        read_shard(shard)


def test_pickles_are_never_loaded(shard):
    np.save(shard / "group.npy", np.array([{"a": 1}, None], dtype=object), allow_pickle=True)
    with pytest.raises(ValueError, match=r"cannot read .*group\.npy"):
        read_shard(shard)
