import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn import functional

from unghost.core.channels import CHANNEL_NAMES
from unghost.prior.network import (
    SIZES,
    NetworkConfig,
    RestorationNet,
    Upsample,
    condition_features,
    depth_to_space,
    gflop,
    parameter_count,
    space_to_depth,
    voxel_features,
)

TINY = NetworkConfig(widths=(8, 16, 8), condition_width=8)


def make_network(config: NetworkConfig = TINY, seed: int = 0) -> RestorationNet:
    torch.manual_seed(seed)
    return RestorationNet(config).eval()


def make_inputs(count: int = 2, channels: int = 1, seed: int = 0):
    generator = torch.Generator().manual_seed(seed)
    cubes = torch.rand(count, channels, 32, 32, 32, generator=generator) * 2 - 1
    return cubes, torch.arange(count) * 400, torch.linspace(0.05, 0.5, count)


def test_space_to_depth_by_hand_and_back():
    grid = torch.arange(64.0).reshape(1, 1, 4, 4, 4)
    parts = space_to_depth(grid)
    assert parts.shape == (1, 8, 2, 2, 2)
    # channel 5 is dz 1, dy 0, dx 1; voxel (1, 0, 1) of the coarse grid is fine voxel (3, 0, 3)
    assert parts[0, 5, 1, 0, 1] == grid[0, 0, 3, 0, 3]
    assert torch.equal(depth_to_space(parts), grid)


def test_upsample_is_a_transposed_convolution():
    torch.manual_seed(0)
    layer = Upsample(5, 3)
    with torch.no_grad():
        layer.bias.normal_()
    grid = torch.randn(2, 5, 4, 4, 4)
    kernel = layer.mix.weight.reshape(2, 2, 2, 3, 5).permute(4, 3, 0, 1, 2)
    expected = functional.conv_transpose3d(grid, kernel, layer.bias, stride=2)
    torch.testing.assert_close(layer(grid), expected, rtol=1e-5, atol=1e-5)


def test_voxel_features_by_hand():
    channels = torch.tensor([-1.0, -0.5, 1.0, -1.1]).reshape(1, 1, 4, 1, 1)
    # opacities 0, .25, 1 and -.05, which counts as 0: 2 sqrt(o) - 1
    assert voxel_features(channels).flatten().tolist() == pytest.approx([-1.0, 0.0, 1.0, -1.0])
    two = torch.cat([channels, channels], dim=1)
    assert torch.equal(voxel_features(two)[:, 1:], channels)


def test_output_shape_range_and_relation_to_logits():
    network, inputs = make_network(), make_inputs(3)
    with torch.no_grad():
        x0_pred, logits = network(*inputs), network.logits(*inputs)
    assert x0_pred.shape == (3, 1, 32, 32, 32)
    assert x0_pred.abs().max() <= 1
    torch.testing.assert_close(x0_pred, 2 * torch.sigmoid(logits) - 1, rtol=1e-5, atol=1e-6)


def test_sample_of_a_batch_equals_the_sample_alone():
    network, (cubes, times, edges) = make_network(), make_inputs(3)
    with torch.no_grad():
        together = network(cubes, times, edges)
        alone = network(cubes[1:2], times[1:2], edges[1:2])
    torch.testing.assert_close(together[1:2], alone, rtol=1e-5, atol=1e-6)


def test_batch_of_zero():
    with torch.no_grad():
        assert make_network()(*make_inputs(0)).shape == (0, 1, 32, 32, 32)


@pytest.mark.parametrize("which", ["timestep", "edge_fraction"])
def test_output_varies_with_the_conditioning(which):
    network, (cubes, times, edges) = make_network(), make_inputs(1)
    other = (cubes, times + 300, edges) if which == "timestep" else (cubes, times, edges * 3)
    with torch.no_grad():
        difference = (network(cubes, times, edges) - network(*other)).abs().max()
    assert difference > 1e-5


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 999), st.floats(1e-38, 1e30))
def test_condition_features_are_finite_and_bounded(timestep, edge):
    features = condition_features(torch.tensor([timestep]), torch.tensor([edge], dtype=torch.float32))
    assert features.shape == (1, 18)
    assert features.abs().max() <= 1.0 + 1e-6


def test_condition_features_tell_neighbouring_conditions_apart():
    times = condition_features(torch.tensor([0, 100, 500, 999]), torch.full((4,), 0.1))
    edges = condition_features(torch.zeros(4, dtype=torch.int64), torch.tensor([0.01, 0.05, 0.1, 0.5]))
    for features in (times, edges):
        assert torch.pdist(features).min() > 0.3


def test_identity_is_easy():
    """A fresh network's decision is its input's: the shortcut dominates."""
    network, (cubes, times, edges) = make_network(NetworkConfig()), make_inputs(1)
    bits = torch.where(cubes > 0, 1.0, -1.0)
    with torch.no_grad():
        agree = ((network(bits, times, edges) > 0) == (bits > 0)).float().mean()
    assert agree > 0.999


def test_every_parameter_gets_a_gradient():
    network, inputs = make_network().train(), make_inputs(2)
    network.logits(*inputs).square().mean().backward()
    for name, value in network.named_parameters():
        assert value.grad is not None, name
        assert value.grad.abs().max() > 0, name


def test_every_output_depends_on_far_away_input():
    """The 4^3 level lets a corner of the cube see well beyond its neighbours."""
    network, (cubes, times, edges) = make_network(), make_inputs(1)
    cubes.requires_grad_()
    network.logits(cubes, times, edges)[0, 0, 0, 0, 0].backward()
    assert cubes.grad[0, 0, 16:, 16:, 16:].abs().max() > 0


def test_inputs_unchanged_and_extra_channels_used():
    network, (cubes, times, edges) = (
        make_network(NetworkConfig(channels=CHANNEL_NAMES, widths=(8, 8, 8))),
        make_inputs(1, 3),
    )
    kept = cubes.clone()
    with torch.no_grad():
        first = network(cubes, times, edges)
        second = network(torch.cat([cubes[:, :2], -cubes[:, 2:]], dim=1), times, edges)
    assert torch.equal(cubes, kept)
    assert not torch.equal(first, second)


def test_parameters_and_work_of_the_sizes():
    counts = {name: parameter_count(RestorationNet(config)) for name, config in SIZES.items()}
    assert counts["xs"] < counts["s"] < counts["m"] < counts["l"]
    assert counts["m"] < 1_000_000
    assert counts["m"] * 4 < 4_000_000
    work = [gflop(config) for config in SIZES.values()]
    assert work == sorted(work)


def test_gflop_counts_what_runs():
    """Against the multiply-adds of each convolution, seen by hooks."""
    network, total = make_network(), []

    def count(module, _inputs, output):
        kernel = module.weight[0].numel()
        total.append(2 * output[0].numel() * kernel)

    for module in network.modules():
        if isinstance(module, torch.nn.Conv3d):
            module.register_forward_hook(count)
    with torch.no_grad():
        network(*make_inputs(1))
    missed = 2 * (4**3 * 8 * 8 * 16 + 8**3 * 8 * 16 * 8)  # Upsample calls the functional form
    assert (sum(total) + missed) / 1e9 == pytest.approx(gflop(TINY), rel=1e-9)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"channels": ("view_count",)}, "channels must start with"),
        ({"widths": (8, 8)}, "three multiples of 8"),
        ({"widths": (8, 8, 12)}, "three multiples of 8"),
        ({"blocks": (0, 0, 0)}, "not all 0"),
        ({"condition_width": 0}, "condition_width"),
    ],
)
def test_config_refuses(change, message):
    with pytest.raises(ValueError, match=message):
        NetworkConfig(**change)


def test_config_round_trip_and_unknown_keys():
    assert NetworkConfig.from_dict(TINY.to_dict()) == TINY
    with pytest.raises(ValueError, match="unknown keys \\['depth'\\]"):
        NetworkConfig.from_dict({"depth": 3})


def test_wrong_shapes_are_named():
    network, (cubes, times, edges) = make_network(), make_inputs(2)
    with pytest.raises(ValueError, match="channels must have shape"):
        network(cubes[:, :, :16], times, edges)
    with pytest.raises(ValueError, match="timestep must have shape \\(2,\\)"):
        network(cubes, times[:1], edges)
    with pytest.raises(ValueError, match="edge_fraction must have shape \\(2,\\)"):
        network(cubes, times, edges[:, None])


@pytest.mark.parametrize("value", [-1.0, 1.0])
@pytest.mark.parametrize("timestep", [0, 999])
def test_empty_and_full_cubes_are_finite(value, timestep):
    cubes = torch.full((1, 1, 32, 32, 32), value)
    with torch.no_grad():
        x0_pred = make_network()(cubes, torch.tensor([timestep]), torch.tensor([1e-6]))
    assert np.isfinite(x0_pred.numpy()).all()
