import dataclasses
import logging

import numpy as np
import onnx
import pytest
import torch
from onnx import numpy_helper

from unghost.core.frames import unit_lattice
from unghost.data_recipes.pairs import sample_pair
from unghost.data_recipes.recipe import load_recipe
from unghost.denoisers import WEIGHTS, load_denoiser
from unghost.export.container import PRECISIONS, precision_of
from unghost.export.onnx.graph import OPERATORS
from unghost.export.onnx.parity import TOLERANCES, ParityInputs, verify
from unghost.export.onnx.quantization import (
    body_in,
    calibration_inputs,
    convert_onnx,
    export_precisions,
    half_precision_body,
    int8_body,
)
from unghost.export.runtime import OnnxDenoiser, read_manifest
from unghost.prior.checkpoint import load_model, save_model
from unghost.speed import sample_channels

INT8_OPERATORS = {"QuantizeLinear", "DequantizeLinear"}  # what int8 adds to graph.OPERATORS


@pytest.fixture(scope="module")
def shipped(tmp_path_factory):
    """The shipped model in every precision, calibrated on a recipe's cubes: not the same as what the tests ask."""
    folder, recipe = tmp_path_factory.mktemp("shipped"), load_recipe("procedural")
    cubes = np.stack([sample_pair(recipe, index, seed=5)[0] for index in range(32)])
    inputs = calibration_inputs(cubes[:, None], np.full(32, 0.1), default_timestep=900)
    return export_precisions(WEIGHTS / "default.safetensors", folder, calibration=inputs, source="procedural")


def shells(count, seed):
    """Soft spheres with blobs of fog beside them: what is stored, ``(N, 32, 32, 32)``, and the true surface."""
    lattice = unit_lattice()
    signed, surface = np.empty((count, 32, 32, 32), np.float32), np.empty((count, 32, 32, 32), bool)
    for index in range(count):
        rng = np.random.default_rng([seed, index])
        distance = np.abs(np.linalg.norm(lattice - rng.uniform(-0.2, 0.2, 3), axis=-1) - rng.uniform(0.2, 0.45))
        fog = np.linalg.norm(lattice - rng.uniform(-0.4, 0.4, 3), axis=-1) < 0.1
        surface[index] = distance < 0.03
        signed[index] = 2 * np.maximum(surface[index] * 0.9, 0.5 * fog) - 1
    return signed, surface


def iou(found, expected):
    both = (found & expected).reshape(len(found), -1).sum(1)
    return float((both / (found | expected).reshape(len(found), -1).sum(1)).mean())


@pytest.mark.slow
def test_files_say_what_they_are(shipped):
    assert [path.name for path in shipped.values()] == ["default.onnx", "default.fp16.onnx", "default.int8.onnx"]
    plain, half, small = (read_manifest(path) for path in shipped.values())
    assert "export" not in plain.training
    assert half.training["export"] == {"precision": "fp16", "fp32_sha256": plain.body_sha256}
    assert small.training["export"] == {
        "precision": "int8",
        "fp32_sha256": plain.body_sha256,
        "calibration": "procedural",
        "calibration_cubes": 32,
    }
    for manifest, precision in zip((plain, half, small), PRECISIONS):
        assert precision_of(manifest) == precision
        cleared = {key: value for key, value in manifest.training.items() if key != "export"}
        assert dataclasses.replace(manifest, training=cleared, body_bytes=0, body_sha256="") == dataclasses.replace(
            plain, body_bytes=0, body_sha256=""
        )


@pytest.mark.slow
def test_the_same_file_as_the_shipped_one_comes_of_the_shipped_checkpoint(shipped):
    precision = precision_of(read_manifest(WEIGHTS / "default.onnx"))
    assert shipped[precision].read_bytes() == (WEIGHTS / "default.onnx").read_bytes()


def test_smaller(shipped):
    sizes = {name: path.stat().st_size for name, path in shipped.items()}
    assert sizes["fp16"] < 0.52 * sizes["fp32"]
    assert sizes["int8"] < 0.36 * sizes["fp32"]


@pytest.mark.slow
@pytest.mark.parametrize("precision", PRECISIONS)
def test_within_the_stated_tolerance_of_torch(shipped, precision):
    report = verify(shipped[precision], WEIGHTS / "default.safetensors", cubes=48)
    assert report["precision"] == precision
    assert report["passed"], report
    if precision == "int8":  # a tolerance that holds every precision would say nothing
        assert report["mean_error"] > 2 * TOLERANCES["fp32"].flip_rate
        assert report["max_error"] > TOLERANCES["fp16"].max_error
    else:  # the shipped weights are of half precision already: storing them so loses nothing more
        assert report["max_error"] < TOLERANCES["fp32"].max_error


@pytest.mark.slow
def test_the_tolerance_of_half_precision_is_not_that_of_single(shipped, tmp_path):
    model = load_model(WEIGHTS / "default.safetensors")
    with torch.no_grad():
        for parameter in model.network.parameters():
            parameter.mul_(1.0003)  # between two half-precision numbers
    save_model(tmp_path / "full.safetensors", model.network, model.manifest)
    half = export_precisions(tmp_path / "full.safetensors", tmp_path, precisions=("fp16",))["fp16"]
    report = verify(half, tmp_path / "full.safetensors", cubes=24)
    assert report["passed"], report
    assert report["max_error"] > TOLERANCES["fp32"].max_error


@pytest.mark.slow
def test_int8_loses_no_more_than_half_a_percent_of_iou(shipped):
    signed, surface = shells(40, 2)
    scores = {}
    for name, path in shipped.items():
        x0_pred = OnnxDenoiser(path, threads=1)(signed[:, None], 900, 0.1)[:, 0]
        scores[name] = iou(x0_pred > 0, surface)
    assert scores["fp32"] > 0.8
    assert abs(scores["fp16"] - scores["fp32"]) < 5e-4
    assert scores["int8"] > scores["fp32"] - 0.005


@pytest.mark.parametrize("precision", PRECISIONS)
def test_only_operators_of_the_allow_list(shipped, precision):
    model = onnx.load(shipped[precision])
    onnx.checker.check_model(model, full_check=True)
    found = {node.op_type for node in model.graph.node}
    assert found <= OPERATORS | (INT8_OPERATORS if precision == "int8" else set())
    assert {item.domain for item in model.opset_import} <= {""}
    assert [item.key for item in model.metadata_props] == ["unghost_manifest"]
    types = [value.type.tensor_type.elem_type for value in (*model.graph.input, *model.graph.output)]
    assert types == [1, 7, 1, 1]  # float32, int64, float32, float32


def test_int8_covers_the_convolutions_but_the_last_and_spares_the_shortcut(shipped):
    model = onnx.load(shipped["int8"])
    arrays = {item.name: numpy_helper.to_array(item) for item in model.graph.initializer}
    made_by = {output: node for node in model.graph.node for output in node.output}
    convolutions = [node for node in model.graph.node if node.op_type == "Conv"]
    assert len(convolutions) == 10
    assert arrays[convolutions[-1].input[1]].dtype == np.float32
    for node in convolutions[:-1]:
        weight = made_by[node.input[1]]
        assert weight.op_type == "DequantizeLinear"
        stored, steps = arrays[weight.input[0]], arrays[weight.input[1]]
        assert stored.dtype == np.int8
        assert steps.shape == (len(stored),)  # per output channel
        assert np.abs(stored.astype(int)).max() <= 64  # seven bits: no saturation without VNNI
    tail = [node.op_type for node in model.graph.node][-14:]
    assert not set(tail) & INT8_OPERATORS
    assert tail[-3:] == ["Add", "Mul", "Tanh"]  # the shortcut, then the output


def test_half_weights_are_cast_back(shipped):
    plain, half = onnx.load(shipped["fp32"]), onnx.load(shipped["fp16"])
    weights = {item.name: numpy_helper.to_array(item) for item in plain.graph.initializer}
    stored = {item.name: numpy_helper.to_array(item) for item in half.graph.initializer}
    changed = [name for name in weights if f"{name}_half" in stored]
    assert changed
    for name in changed:
        np.testing.assert_array_equal(stored[f"{name}_half"], weights[name].astype(np.float16))
    assert all(np.array_equal(stored[name], weights[name]) for name in set(weights) - set(changed))


@pytest.mark.slow
def test_same_inputs_same_bytes_and_nothing_is_logged(exported, precisions, calibration, tmp_path, caplog):
    with caplog.at_level(logging.WARNING):
        for name in ("fp16", "int8"):
            again = tmp_path / f"{name}.onnx"
            written = convert_onnx(exported.onnx, again, precision=name, calibration=calibration, source="balls")
            assert written == read_manifest(precisions[name])
            assert again.read_bytes() == precisions[name].read_bytes()
    assert not caplog.records
    assert sorted(path.name for path in tmp_path.iterdir()) == ["fp16.onnx", "int8.onnx"]


def test_a_result_out_of_tolerance_is_not_written(exported, tmp_path):
    flat = calibration_inputs(np.full((2, 1, 32, 32, 32), -1.0), [0.1, 0.1], default_timestep=0)
    with pytest.raises(ValueError, match="int8 is too far from fp32"):
        convert_onnx(exported.onnx, tmp_path / "x.onnx", precision="int8", calibration=flat, verify_cubes=8)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_refusals(exported, precisions, calibration, tmp_path):
    for precision in ("fp16", "int8"):
        with pytest.raises(ValueError, match=f"is {precision} already, an fp32 file is needed"):
            convert_onnx(precisions[precision], tmp_path / "x.onnx", precision="fp16")
    with pytest.raises(ValueError, match="int8 needs calibration inputs"):
        convert_onnx(exported.onnx, tmp_path / "x.onnx", precision="int8")
    with pytest.raises(ValueError, match="int8 needs calibration inputs"):
        export_precisions(exported.checkpoint, tmp_path)
    with pytest.raises(ValueError, match="precisions must be among fp32, fp16, int8, got"):
        export_precisions(exported.checkpoint, tmp_path, precisions=("int4",), calibration=calibration)
    with pytest.raises(ValueError, match="precision must be one of fp32, fp16, int8, got 'bf16'"):
        body_in("bf16", b"", None)
    assert not list(tmp_path.iterdir())


def test_weights_beyond_float16_are_refused(exported):
    model = onnx.load(exported.onnx)
    large = next(item for item in model.graph.initializer if len(item.dims) == 4)
    large.CopyFrom(numpy_helper.from_array(numpy_helper.to_array(large) * 1e9, large.name))
    with pytest.raises(ValueError, match=rf"{large.name} holds .*, float16 ends at 65504"):
        half_precision_body(model.SerializeToString())


def test_int8_wants_convolutions_and_our_inputs(calibration):
    node = onnx.helper.make_node("Relu", ["a"], ["b"])
    values = [onnx.helper.make_tensor_value_info(name, 1, ["N", 1, 4, 4]) for name in "ab"]
    graph = onnx.helper.make_graph([node], "g", values[:1], values[1:])
    with pytest.raises(ValueError, match="no convolution to quantise"):
        int8_body(onnx.helper.make_model(graph).SerializeToString(), calibration)
    kernel = numpy_helper.from_array(np.ones((1, 1, 1, 1), np.float32), "k")
    pair = [onnx.helper.make_node("Conv", [x, "k"], [y], name=y) for x, y in (("a", "c"), ("c", "b"))]
    for nodes, message in ((pair[:1], "no convolution to quantise"), (pair, r"the model's inputs are \['a'\]")):
        values[1].name = nodes[-1].output[0]
        graph = onnx.helper.make_graph(nodes, "g", values[:1], values[1:], [kernel])
        with pytest.raises(ValueError, match=message):
            int8_body(onnx.helper.make_model(graph).SerializeToString(), calibration)


def test_calibration_inputs_are_checked_and_spread():
    cubes = sample_channels(6, 1)
    inputs = calibration_inputs(cubes, np.full(6, 0.1), default_timestep=700)
    assert inputs.timestep.tolist() == [0, 700, 400, 700, 799, 700]
    good = {"channels": cubes, "timestep": np.zeros(6, np.int64), "edge_fraction": np.full(6, 0.1, np.float32)}
    for name, value, message in (
        ("channels", cubes[:, 0], "channels must have shape"),
        ("channels", cubes[:0], "channels must have shape"),
        ("channels", cubes * 1.5, r"finite and in \[-1, 1\]"),
        ("channels", cubes * np.float32("nan"), r"finite and in \[-1, 1\]"),
        ("channels", cubes.astype(np.float64), "dtypes must be"),
        ("timestep", np.full(6, 1000), "timestep must lie in"),
        ("timestep", np.zeros(5, np.int64), "must have shape"),
        ("edge_fraction", np.zeros(6, np.float32), "edge_fraction must be finite and > 0"),
    ):
        with pytest.raises(ValueError, match=message):
            int8_body(b"", ParityInputs(**(good | {name: value})))


def test_every_precision_is_a_denoiser_that_can_be_loaded_by_path(shipped):
    reference = load_model(WEIGHTS / "default.safetensors").manifest
    for precision, path in shipped.items():
        denoiser = load_denoiser(path, threads=1)
        assert denoiser.precision == precision
        assert denoiser.manifest.removal_threshold == reference.removal_threshold
