import sys

import onnx
import pytest
from onnx import numpy_helper

from unghost.core.manifest import METADATA_KEY, Manifest
from unghost.export.onnx import parity, planar
from unghost.export.onnx.to_onnx import export_onnx
from unghost.export.runtime import read_manifest


def test_manifest_is_carried_over_and_completed(exported):
    assert exported.manifest == read_manifest(exported.onnx)
    assert exported.manifest.name == "random"
    assert exported.manifest.default_timestep == 640
    assert exported.manifest.removal_threshold == -0.25
    assert 0 < exported.manifest.body_bytes < exported.onnx.stat().st_size
    assert len(exported.manifest.body_sha256) == 64


def test_file_is_a_valid_onnx_model_under_four_megabytes(exported):
    model = onnx.load(exported.onnx)
    onnx.checker.check_model(model, full_check=True)
    assert [item.key for item in model.metadata_props] == [METADATA_KEY]
    assert Manifest.from_json(model.metadata_props[0].value, origin="x") == exported.manifest
    assert exported.onnx.stat().st_size < 4_000_000


def test_same_checkpoint_same_bytes(exported, tmp_path):
    export_onnx(exported.checkpoint, tmp_path / "again.onnx", verify_cubes=0)
    assert (tmp_path / "again.onnx").read_bytes() == exported.onnx.read_bytes()


def test_a_bad_checkpoint_leaves_no_file(exported, tmp_path):
    (tmp_path / "half.safetensors").write_bytes(exported.checkpoint.read_bytes()[:5000])
    with pytest.raises(ValueError, match=r"half\.safetensors is truncated"):
        export_onnx(tmp_path / "half.safetensors", tmp_path / "model.onnx")
    assert not (tmp_path / "model.onnx").exists()


def test_an_export_that_differs_from_torch_is_not_written(exported, tmp_path, monkeypatch):
    honest = planar.planar_model

    def wrong(network):
        model = honest(network)
        for item in model.graph.initializer:
            if len(item.dims) == 4:
                item.CopyFrom(numpy_helper.from_array(numpy_helper.to_array(item) * 1.01, item.name))
        return model

    monkeypatch.setattr(planar, "planar_model", wrong)
    with pytest.raises(ValueError, match="ONNX and torch differ by"):
        export_onnx(exported.checkpoint, tmp_path / "model.onnx", verify_cubes=4)
    assert not list(tmp_path.iterdir())


def test_a_missing_extra_is_named(exported, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(ImportError, match=r"pip install unghost\[export\]"):
        export_onnx(exported.checkpoint, tmp_path / "model.onnx")
    assert parity.ERROR_TOLERANCE == 1e-4
