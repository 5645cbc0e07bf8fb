import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn import functional

from unghost.core.channels import CHANNEL_NAMES, LEAST_KNOWN, UNKNOWN
from unghost.prior.networks.context import context_features, interpolation
from unghost.prior.networks.restoration import (
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


WEIGHTS_OF_ONE_CHANNEL = {
    "stem": (8, 8, 3, 3, 3),
    "down_middle": (16, 8, 2, 2, 2),
    "down_coarse": (8, 16, 2, 2, 2),
    "head": (8, 8, 3, 3, 3),
    "condition.0": (8, 18),
    "condition.2": (8, 8),
    "condition.4": (40, 8),
    "up_middle.mix": (128, 8, 1, 1, 1),
    "up_fine.mix": (64, 16, 1, 1, 1),
}


def test_a_network_of_one_channel_keeps_its_layout():
    """Published weights have these names and shapes."""
    state = make_network().state_dict()
    for name, shape in WEIGHTS_OF_ONE_CHANNEL.items():
        assert tuple(state[f"{name}.weight"].shape) == shape
    assert not [name for name in state if "context" in name]
    assert len(state) == 28
    assert NetworkConfig.from_dict({"channels": 1, "widths": [8, 16, 8], "condition_width": 8}) == TINY
    with pytest.raises(ValueError, match="channels must start with"):
        NetworkConfig.from_dict({"channels": ["surroundings"]})


def test_each_channel_moves_the_output_and_gets_gradients():
    names = ("signed_opacity", "view_count", "surroundings")
    network, (cubes, times, edges) = make_network(NetworkConfig(channels=names, widths=(8, 16, 8))), make_inputs(2, 3)
    with torch.no_grad():
        before = network(cubes, times, edges)
        for channel in range(3):
            other = cubes.clone()
            other[:, channel] = -1.0
            assert (network(other, times, edges) - before).abs().max() > 1e-4, names[channel]
    network.train().logits(cubes, times, edges).square().mean().backward()
    for name, value in network.named_parameters():
        assert value.grad.abs().max() > 0, name


def test_surroundings_unknown_and_empty_are_told_apart():
    config = NetworkConfig(channels=("signed_opacity", "surroundings"), widths=(8, 16, 8))
    network, (cubes, times, edges) = make_network(config), make_inputs(1, 2)
    empty, unknown = cubes.clone(), cubes.clone()
    empty[:, 1], unknown[:, 1] = LEAST_KNOWN, UNKNOWN
    with torch.no_grad():
        assert (network(empty, times, edges) - network(unknown, times, edges)).abs().max() > 1e-5


def test_context_features_by_hand():
    channel = torch.tensor([UNKNOWN, LEAST_KNOWN, -0.125, 1.0]).repeat_interleave(2).reshape(1, 1, 8, 1, 1)
    found = context_features(channel.expand(1, 1, 8, 2, 2))
    assert found.shape == (1, 2, 4, 1, 1)
    # opacities (less than 0 counts as) 0, 0, .25, 1
    assert found[0, 0].flatten().tolist() == pytest.approx([-1.0, -1.0, 0.0, 1.0], abs=1e-6)
    assert found[0, 1].flatten().tolist() == pytest.approx([1.0, 0.0, 0.0, 0.0], abs=1e-6)


def test_what_lies_about_the_cube_is_put_where_it_is():
    """A ramp along one axis of the surroundings, handed through, is the same ramp on the cube's grid."""
    part, weights = interpolation()
    places = 3 * ((torch.arange(8) + 0.5) / 8 - 0.5)
    for axis in range(3):
        ramp = places.reshape([8 if i == axis else 1 for i in range(3)]).expand(8, 8, 8)
        fine = (ramp[part, part, part].reshape(1, -1) @ torch.from_numpy(weights)).reshape(8, 8, 8)
        expected = ((torch.arange(8) + 0.5) / 8 - 0.5).reshape([8 if i == axis else 1 for i in range(3)])
        torch.testing.assert_close(fine, expected.expand(8, 8, 8), rtol=0, atol=1e-6)


def test_further_channels_are_cheap():
    one, all_ = (gflop(NetworkConfig(channels=CHANNEL_NAMES[:count])) for count in (1, 3))
    assert all_ < 1.15 * one


def test_inputs_unchanged_and_extra_channels_used():
    network, (cubes, times, edges) = (
        make_network(NetworkConfig(channels=CHANNEL_NAMES, widths=(8, 8, 8))),
        make_inputs(1, len(CHANNEL_NAMES)),
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


@pytest.mark.parametrize("count", [1, 3])
def test_gflop_counts_what_runs(count):
    """Against the multiply-adds of each convolution, seen by hooks."""
    config = dataclasses.replace(TINY, channels=CHANNEL_NAMES[:count])
    network, total = make_network(config), []

    def work(module, _inputs, output):
        kernel = module.weight[0].numel()
        total.append(2 * output[0].numel() * kernel)

    for module in network.modules():
        if isinstance(module, torch.nn.Conv3d):
            module.register_forward_hook(work)
    with torch.no_grad():
        network(*make_inputs(1, count))
    missed = 2 * (4**3 * 8 * 8 * 16 + 8**3 * 8 * 16 * 8)  # Upsample calls the functional form
    missed += 2 * 8 * 4**3 * 8**3 if count == 3 else 0  # the interpolation is no module
    assert (sum(total) + missed) / 1e9 == pytest.approx(gflop(config), rel=1e-9)


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
