import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from unghost.core.channels import CHANNEL_NAMES, LEAST_KNOWN
from unghost.export.onnx.graph import OPERATORS, OPSET
from unghost.export.onnx.planar import planar_model
from unghost.prior.networks.restoration import SIZES, NetworkConfig

CONFIGS = {
    "tiny": NetworkConfig(widths=(8, 16, 24), condition_width=8),
    "no block at 4^3": NetworkConfig(widths=(8, 8, 16), blocks=(1, 0, 2), condition_width=8),
    "only 4^3": NetworkConfig(widths=(16, 8, 8), blocks=(0, 2, 0), condition_width=8),
    "all channels": NetworkConfig(channels=CHANNEL_NAMES, widths=(8, 16, 8), condition_width=8),
    "with views": NetworkConfig(channels=("signed_opacity", "view_count"), widths=(8, 8, 8), condition_width=8),
    "another order": NetworkConfig(
        channels=("signed_opacity", "view_count", "surroundings"), widths=(8, 8, 8), condition_width=8
    ),
    "default": SIZES["m"],
}


def run(model, *inputs):
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    return session.run(["x0_pred"], dict(zip(("channels", "timestep", "edge_fraction"), inputs)))[0]


def make_inputs(count, channels, seed=0):
    rng = np.random.default_rng(seed)
    cubes = rng.uniform(-1, 1, (count, channels, 32, 32, 32)).astype(np.float32)
    return cubes, rng.integers(0, 1000, count), rng.uniform(0.01, 1.0, count).astype(np.float32)


@pytest.mark.parametrize("name", CONFIGS)
def test_planar_twin_equals_the_3d_network(name, make_lively):
    network = make_lively(CONFIGS[name])
    inputs = make_inputs(3, len(network.config.channels))
    with torch.no_grad():
        expected = network(*(torch.from_numpy(value) for value in inputs)).numpy()
    found = run(planar_model(network), *inputs)
    assert expected.std() > 0.1  # the comparison sees something
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("corner", [(0, 0, 0), (31, 31, 31), (0, 31, 0), (1, 30, 16), (16, 15, 31)])
def test_borders_are_padded_alike(corner, make_lively):
    """One occupied voxel: what the shifts of slices do at the ends shows."""
    network = make_lively(CONFIGS["tiny"])
    cubes = np.full((1, 1, 32, 32, 32), -1.0, np.float32)
    cubes[(0, 0, *corner)] = 1.0
    inputs = (cubes, np.array([500]), np.array([0.1], np.float32))
    with torch.no_grad():
        expected = network(*(torch.from_numpy(value) for value in inputs)).numpy()
    np.testing.assert_allclose(run(planar_model(network), *inputs), expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("corner", [(0, 0, 0), (31, 31, 31), (0, 31, 0), (11, 13, 20), (10, 10, 21)])
def test_borders_of_the_surroundings_are_padded_alike(corner, make_lively):
    """One opaque voxel of the surroundings, at their border or at that of the part about the cube."""
    network = make_lively(CONFIGS["all channels"])
    with torch.no_grad():  # the far border matters through the summary alone
        network.context.down.weight.mul_(30.0)
        network.condition[0].weight[:, 18:].mul_(30.0)
    cubes = np.full((1, len(network.config.channels), 32, 32, 32), LEAST_KNOWN, np.float32)
    cubes[:, 0] = -1.0
    dark = (cubes.copy(), np.array([500]), np.array([0.1], np.float32))
    cubes[(0, 1, *(place // 2 * 2 for place in corner))] = 1.0
    inputs = (cubes, *dark[1:])
    with torch.no_grad():
        expected, without = (network(*(torch.from_numpy(value) for value in given)).numpy() for given in (inputs, dark))
    assert np.abs(expected - without).max() > 1e-4
    np.testing.assert_allclose(run(planar_model(network), *inputs), expected, rtol=0, atol=5e-6)


@pytest.mark.parametrize("name", ["default", "all channels"])
def test_graph_is_valid_plain_and_dynamic(name, make_lively):
    model = planar_model(make_lively(CONFIGS[name]))
    onnx.checker.check_model(model, full_check=True)
    assert {node.op_type for node in model.graph.node} <= OPERATORS
    assert [(item.domain, item.version) for item in model.opset_import] == [("", OPSET)]
    for value in (*model.graph.input, *model.graph.output):
        assert value.type.tensor_type.shape.dim[0].dim_param == "N"
    types = {value.name: value.type.tensor_type.elem_type for value in model.graph.input}
    assert types == {"channels": 1, "timestep": 7, "edge_fraction": 1}  # float32, int64, float32
    assert len(model.SerializeToString()) < 4_000_000


def test_a_sample_of_a_batch_equals_the_sample_alone(make_lively):
    model = planar_model(make_lively(CONFIGS["tiny"]))
    cubes, times, edges = make_inputs(5, 1)
    together = run(model, cubes, times, edges)
    for index in range(5):
        part = slice(index, index + 1)
        np.testing.assert_allclose(run(model, cubes[part], times[part], edges[part]), together[part], atol=1e-6)


@pytest.mark.parametrize("name", ["tiny", "all channels"])
def test_only_2d_convolutions(name, make_lively):
    model = planar_model(make_lively(CONFIGS[name]))
    shapes = {item.name: item.dims for item in model.graph.initializer}
    kernels = [len(shapes[node.input[1]]) for node in model.graph.node if node.op_type.startswith("Conv")]
    assert kernels
    assert set(kernels) == {4}
