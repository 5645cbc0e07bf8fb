"""Every objective on both backbones: the ONNX graph against torch."""

import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from unghost.core.manifest import Manifest
from unghost.export.onnx.diffusion_graph import denoiser_model
from unghost.export.onnx.graph import OPERATORS
from unghost.export.onnx.to_onnx import export_onnx
from unghost.export.onnx.unet_graph import UNET_OPERATORS
from unghost.export.runtime import OnnxDenoiser
from unghost.prior.checkpoint import load_model, save_model
from unghost.prior.diffusion.model import DiffusionConfig
from unghost.prior.networks.registry import build_network
from unghost.prior.networks.restoration import NetworkConfig
from unghost.prior.networks.unet import UNetConfig

COMPACT = NetworkConfig(widths=(8, 16, 24), condition_width=8)
UNET = UNetConfig(base_width=4, multipliers=(1, 1, 2), heads=2, groups=2)
CASES = {
    "compact epsilon": (DiffusionConfig("epsilon", COMPACT), OPERATORS),
    "compact x0": (DiffusionConfig("x0", COMPACT), OPERATORS),
    "compact bernoulli": (DiffusionConfig("bernoulli", COMPACT), OPERATORS),
    "U-Net epsilon": (DiffusionConfig("epsilon", UNET), UNET_OPERATORS),
    "U-Net x0": (DiffusionConfig("x0", UNET), UNET_OPERATORS),
    "U-Net restoration": (UNET, UNET_OPERATORS),
}


def lively(config, seed=0):
    """Random weights large enough that every part moves the output."""
    torch.manual_seed(seed)
    network = build_network(config).eval()
    with torch.no_grad():
        for name, value in network.named_parameters():
            value.add_((0.3 if name.endswith("bias") else 0.08) * torch.randn_like(value))
    return network


def make_inputs(count, last_step, seed=0):
    rng = np.random.default_rng(seed)
    cubes = rng.normal(size=(count, 1, 32, 32, 32)).astype(np.float32)  # beyond [-1, 1], as noisy cubes are
    steps = np.linspace(0, last_step, count).astype(np.int64)
    return cubes, steps, np.geomspace(1e-6, 10.0, count).astype(np.float32)


def run(model, inputs):
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    return session.run(["x0_pred"], dict(zip(("channels", "timestep", "edge_fraction"), inputs)))[0]


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_graph_equals_torch(name):
    config, operators = CASES[name]
    network = lively(config)
    model = denoiser_model(network)
    onnx.checker.check_model(model, full_check=True)
    assert {node.op_type for node in model.graph.node} <= operators
    # plain epsilon divides by sqrt(a): float32 itself is worth nothing at the last timesteps
    inputs = make_inputs(4, 300 if name == "U-Net epsilon" else 999)
    with torch.no_grad():
        expected = network(*(torch.from_numpy(value) for value in inputs)).numpy()
    assert expected.std() > 0.1  # the comparison sees something
    assert (np.abs(expected) < 0.999).mean() > 0.02  # not only what the clamp left
    np.testing.assert_allclose(run(model, inputs), expected, rtol=0, atol=3e-5)


def test_epsilon_at_the_end_of_time_is_finite():
    model = denoiser_model(lively(CASES["U-Net epsilon"][0]))
    cubes, steps, edges = make_inputs(1, 0)
    found = run(model, (cubes, steps + 999, edges))
    assert np.isfinite(found).all()
    assert np.abs(found).max() <= 1.0


def test_what_the_unet_adds_to_the_allow_list():
    assert {"MatMul", "ReduceMean", "Sigmoid", "Softmax"} == UNET_OPERATORS - OPERATORS
    used = {node.op_type for node in denoiser_model(lively(UNET)).graph.node}
    assert used >= UNET_OPERATORS - OPERATORS


@pytest.mark.slow
@pytest.mark.parametrize("name", ["compact bernoulli", "U-Net x0"])
def test_export_to_a_file_and_back(name, tmp_path):
    network = lively(CASES[name][0])
    manifest = Manifest(name="d", family="diffusion", default_timestep=50)
    save_model(tmp_path / "m.safetensors", network, manifest)
    written = export_onnx(tmp_path / "m.safetensors", tmp_path / "m.onnx", verify_cubes=4)
    assert written.family == "diffusion"
    assert written.default_timestep == 50
    cubes, steps, edges = make_inputs(2, 600)
    cubes = cubes.clip(-1, 1)
    expected = load_model(tmp_path / "m.safetensors")(*(torch.from_numpy(v) for v in (cubes, steps, edges))).numpy()
    found = OnnxDenoiser(tmp_path / "m.onnx")(cubes, steps, edges)
    np.testing.assert_allclose(found, expected, rtol=0, atol=3e-5)
