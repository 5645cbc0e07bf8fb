import numpy as np
import pytest

from unghost import cli
from unghost.calibration import calibration_for
from unghost.core.channels import UNKNOWN, encode_view_count
from unghost.core.manifest import Manifest
from unghost.core.shards.packing import pack_labels
from unghost.core.shards.storage import write_shard
from unghost.prior.checkpoint import save_model
from unghost.prior.networks.restoration import NetworkConfig, RestorationNet


@pytest.fixture
def checkpoint(tmp_path):
    network = RestorationNet(NetworkConfig(widths=(8, 8, 8), condition_width=8))
    save_model(tmp_path / "small.safetensors", network, Manifest("small", default_timestep=700))
    return tmp_path / "small.safetensors"


def shard(folder, count, value):
    write_shard(
        folder,
        {
            "inputs": np.full((count, 32, 32, 32), value, dtype=np.uint8),
            "labels": pack_labels(np.zeros((count, 32, 32, 32), dtype=np.uint8)),
            "severity": np.zeros(count, dtype=np.float32),
            "edge_fraction": np.linspace(0.1, 0.2, count).astype(np.float32),
            "group": np.zeros(count, dtype=np.int32),
        },
        {},
    )


def test_shards_give_their_cubes_evenly(checkpoint, tmp_path):
    for name, count, value in (("a", 3, 0), ("b", 9, 255)):
        shard(tmp_path / "shards" / name, count, value)
    inputs = calibration_for(checkpoint, tmp_path / "shards", cubes=5, seed=0)
    assert inputs.channels.shape == (5, 1, 32, 32, 32)
    assert inputs.channels[:, 0, 0, 0, 0].tolist() == [-1, -1, -1, 1, 1]
    np.testing.assert_allclose(inputs.edge_fraction, [0.1, 0.15, 0.2, 0.1, 0.2])
    assert inputs.timestep.tolist() == [0, 700, 500, 700, 999]


def test_recipes_give_their_first_cubes(checkpoint):
    few, more = (calibration_for(checkpoint, "procedural", cubes=count, seed=3) for count in (2, 3))
    assert np.array_equal(few.channels, more.channels[:2])
    other = calibration_for(checkpoint, "procedural", cubes=2, seed=4)
    assert not np.array_equal(few.channels, other.channels)


def test_refusals(checkpoint, tmp_path):
    with pytest.raises(ValueError, match="cubes must be >= 1, got 0"):
        calibration_for(checkpoint, "procedural", cubes=0, seed=0)
    with pytest.raises(FileNotFoundError, match="absent is neither a file"):
        calibration_for(checkpoint, "absent", cubes=1, seed=0)


def test_further_channels_come_from_shards_and_are_unknown_in_recipes(tmp_path):
    names = ("signed_opacity", "view_count")
    network = RestorationNet(NetworkConfig(channels=names, widths=(8, 8, 8), condition_width=8))
    save_model(tmp_path / "two.safetensors", network, Manifest("two", channels=names))
    made = calibration_for(tmp_path / "two.safetensors", "procedural", cubes=1, seed=0)
    assert made.channels.shape == (1, 2, 32, 32, 32)
    assert (made.channels[:, 1] == UNKNOWN).all()
    arrays = {
        "inputs": np.zeros((3, 32, 32, 32), np.uint8),
        "labels": np.zeros((3, 8192), np.uint8),
        "severity": np.zeros(3, np.float32),
        "edge_fraction": np.full(3, 0.1, np.float32),
        "group": np.zeros(3, np.int32),
        "view_count": np.full((3, 32, 32, 32), 7, np.uint8),
    }
    write_shard(tmp_path / "shard", arrays, {})
    stored = calibration_for(tmp_path / "two.safetensors", tmp_path / "shard", cubes=2, seed=0)
    np.testing.assert_array_equal(
        stored.channels[:, 1], np.broadcast_to(encode_view_count(np.array(7)), (2, 32, 32, 32))
    )


@pytest.mark.slow
def test_the_three_verbs_take_every_precision(checkpoint, tmp_path, capsys):
    out = tmp_path / "out"
    words = ["export", str(checkpoint), "--precision", "fp32", "fp16", "int8", "--out", str(out)]
    assert cli.main([*words, "--calibration-cubes", "4"]) == 0
    assert sorted(path.name for path in out.iterdir()) == ["small.fp16.onnx", "small.int8.onnx", "small.onnx"]
    assert capsys.readouterr().out.count(" MB, ") == 3
    for precision, name in (("fp32", "small.onnx"), ("fp16", "small.fp16.onnx"), ("int8", "small.int8.onnx")):
        path = str(out / name)
        assert cli.main(["verify", "--onnx", path, "--checkpoint", str(checkpoint), "--cubes", "8"]) == 0
        assert capsys.readouterr().out.startswith(f"{precision}: max error ")
        assert cli.main(["bench", "--denoiser", path, "--batch", "1", "--seconds", "0.01", "--threads", "1"]) == 0
        assert f" cubes/s ({precision}, batch 1," in capsys.readouterr().out


@pytest.mark.slow
def test_an_fp32_file_gives_the_files_of_its_checkpoint(checkpoint, tmp_path):
    words = ["--precision", "fp32", "int8", "--calibration-cubes", "2", "--out"]
    assert cli.main(["export", str(checkpoint), *words, str(tmp_path / "a")]) == 0
    assert cli.main(["export", str(tmp_path / "a" / "small.onnx"), *words, str(tmp_path / "b")]) == 0
    for name in ("small.onnx", "small.int8.onnx"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    assert cli.main(["export", str(tmp_path / "a" / "small.int8.onnx"), *words, str(tmp_path / "c")]) == 2


def test_without_a_precision_out_is_one_file(checkpoint, tmp_path):
    assert cli.main(["export", str(checkpoint), "--out", str(tmp_path / "one.onnx")]) == 0
    assert (tmp_path / "one.onnx").is_file()
