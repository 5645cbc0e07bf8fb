import numpy as np
import pytest
import torch

from unghost.core.cameras import Cameras
from unghost.fields.radiance import RadianceConfig, RadianceField
from unghost.fields.rendering import Rendering, Sampling, depth_spread, median_distance, render_rays, render_view

SAMPLING = Sampling(near=0.1, middle=3.1, far_samples=0, near_samples=300)


def slab_field(density, low=0.0, resolution=81):
    """An uncontracted field that is empty below x = ``low`` and has ``density`` from there to x = 1."""
    field = RadianceField(RadianceConfig(resolution, 4, contract=False))
    x = torch.linspace(-1, 1, resolution)
    raw = np.log(np.expm1(density * field.field_pitch))
    with torch.no_grad():
        values = torch.where(x >= low - 1e-6, raw, -40.0)
        field.density_table.copy_(values[:, None, None].expand(-1, resolution, resolution).reshape(-1, 1))
    return field


def ray_along_x(count=1):
    return torch.tensor([[-2.0, 0.0, 0.0]] * count), torch.tensor([[1.0, 0.0, 0.0]] * count)


def test_edges_are_even_then_even_in_inverse_distance():
    edges = Sampling(near=0.5, middle=2.0, far=8.0, near_samples=3, far_samples=3).edges()
    # 0.5 1 1.5 2, then 1 / (1/2, 3/8, 1/4, 1/8)
    torch.testing.assert_close(edges, torch.tensor([0.5, 1.0, 1.5, 2.0, 8 / 3, 4.0, 8.0]))
    assert len(Sampling(near_samples=4, far_samples=0).edges()) == 5


@pytest.mark.parametrize("density", [0.3, 2.0, 30.0])
def test_a_slab_absorbs_what_beer_and_lambert_say(density):
    rendering = render_rays(slab_field(density), *ray_along_x(), SAMPLING)
    np.testing.assert_allclose(rendering.accumulation.item(), 1 - np.exp(-density), atol=0.02)  # length 1
    transmittance = torch.exp(-(rendering.density * SAMPLING.edges().diff()).sum(1))
    torch.testing.assert_close(rendering.accumulation, 1 - transmittance, atol=1e-5, rtol=0)
    assert (rendering.weights >= 0).all()
    assert rendering.weights.shape == (1, 300)
    assert rendering.edges.shape == (1, 301)


@pytest.mark.parametrize("density", [2.0, 30.0])
def test_median_distance_of_a_slab(density):
    distance = median_distance(render_rays(slab_field(density), *ray_along_x(), SAMPLING))
    # the slab begins 2 units away; the field's last empty cell (0.025) ramps up
    np.testing.assert_allclose(distance.item(), 2.0 + np.log(2) / density, atol=0.02)


def test_median_distance_by_hand_and_inf_where_too_thin():
    weights = torch.tensor([[0.25, 0.5, 0.25], [0.1, 0.2, 0.1], [0.9, 0.0, 0.0], [0.0, 0.0, 0.0]])
    edges = torch.tensor([1.0, 2.0, 4.0, 8.0]).expand(4, -1)
    unused = torch.zeros(4, 3)
    distance = median_distance(Rendering(unused, weights, edges, unused, unused))
    # half of 0.5 into [2, 4]; never; 0.5 / 0.9 into [1, 2]; never
    torch.testing.assert_close(distance, torch.tensor([3.0, np.inf, 1 + 0.5 / 0.9, np.inf], dtype=torch.float32))


def test_empty_field_renders_nothing():
    field = slab_field(1e-9, low=2.0)
    rendering = render_rays(field, *ray_along_x(2), SAMPLING)
    assert rendering.accumulation.max() < 1e-6
    assert not rendering.rgb.any()
    assert median_distance(rendering).isinf().all()


def test_no_rays():
    rendering = render_rays(slab_field(1.0), torch.zeros(0, 3), torch.zeros(0, 3), SAMPLING)
    assert rendering.rgb.shape == (0, 3)
    assert rendering.weights.shape == (0, 300)


def test_color_of_an_opaque_wall():
    field = slab_field(500.0)
    with torch.no_grad():
        field.color_table[:, 0] = 4.0  # constant coefficient of red
    rgb = render_rays(field, *ray_along_x(), SAMPLING).rgb[0]
    red = torch.sigmoid(torch.tensor(4.0 * 0.28209479)).item()
    np.testing.assert_allclose(rgb.detach().numpy(), [red, 0.5, 0.5], atol=5e-3)


def test_jitter_stays_in_its_interval_and_follows_the_generator():
    field = slab_field(2.0)
    origins, directions = ray_along_x(3)
    drawn = [
        render_rays(field, origins, directions, SAMPLING, generator=torch.Generator().manual_seed(seed))
        for seed in (0, 0, 1)
    ]
    torch.testing.assert_close(drawn[0].positions, drawn[1].positions, atol=0, rtol=0)
    assert not torch.equal(drawn[0].positions, drawn[2].positions)
    distance = drawn[0].positions[..., 0] + 2.0
    assert (distance >= drawn[0].edges[:, :-1] - 1e-5).all()
    assert (distance <= drawn[0].edges[:, 1:] + 1e-5).all()


def test_skipping_nothing_changes_nothing():
    origins, directions = ray_along_x(2)
    results = []
    for skip in (False, True):
        field = slab_field(3.0, resolution=21)
        occupied = torch.ones(21**3, dtype=torch.bool) if skip else None
        rendering = render_rays(field, origins, directions, SAMPLING, occupied=occupied)
        rendering.rgb.sum().backward()
        results.append((rendering.rgb, rendering.weights, rendering.density, field.density_table.grad))
    for plain, skipped in zip(*results):
        torch.testing.assert_close(plain, skipped, atol=1e-6, rtol=1e-6)


def test_skipping_empty_space_barely_changes_the_picture():
    field = slab_field(3.0)
    rendering = render_rays(field, *ray_along_x(), SAMPLING)
    occupied = field.occupied_nodes(1e-3)
    assert 0.3 < occupied.float().mean() < 0.7
    skipped = render_rays(field, *ray_along_x(), SAMPLING, occupied=occupied)
    torch.testing.assert_close(skipped.weights, rendering.weights, atol=1e-4, rtol=0)


def test_skipping_everything_is_empty_but_still_has_a_graph():
    field = slab_field(3.0, resolution=9)
    nothing = torch.zeros(9**3, dtype=torch.bool)
    rendering = render_rays(field, *ray_along_x(), SAMPLING, occupied=nothing)
    assert not rendering.weights.any()
    rendering.weights.sum().backward()
    assert not field.density_table.grad.any()


def test_render_view_sees_the_slab_at_its_depth_in_any_chunking():
    field = slab_field(300.0)
    # looking along +x from x = -2: right is -y, up is z, back is -x
    pose = np.array([[[0.0, 0.0, -1.0, -2.0], [-1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]]])
    cameras = Cameras.create(pose, np.array([30.0, 30.0, 4.0, 3.0]), 8, 6)
    view = render_view(field, cameras, 0, sampling=SAMPLING)
    assert view["rgb"].shape == (6, 8, 3)
    cosine = cameras.rays(0)[1][..., 0]
    np.testing.assert_allclose(view["depth"], 2.0 / cosine, atol=0.03)
    np.testing.assert_allclose(view["accumulation"], 1.0, atol=1e-3)
    again = render_view(field, cameras, 0, sampling=SAMPLING, chunk=7)
    for name in view:
        np.testing.assert_allclose(again[name], view[name], atol=1e-5)
    beside = Cameras.create(np.repeat(pose, 2, axis=0), cameras.intrinsics[0], [5, 8], [9, 6])
    for name, values in render_view(field, beside, 1, sampling=SAMPLING).items():
        np.testing.assert_array_equal(values, view[name])
    away = Cameras.create(
        pose * np.array([1.0, 1.0, -1.0, 1.0]) * np.array([-1.0, 1.0, 1.0, 1.0]), cameras.intrinsics, 8, 6
    )
    behind = render_view(field, away, 0, sampling=SAMPLING, background=0.25)
    np.testing.assert_allclose(behind["rgb"], 0.25, atol=1e-6)
    assert np.isinf(behind["depth"]).all()


def test_depth_spread_by_hand():
    edges = torch.tensor([1.0, 3.0, 5.0]).expand(3, -1)
    unused = torch.zeros(3, 3)
    weights = torch.tensor([[1.0, 0.0], [0.5, 0.5], [0.0, 0.0]])
    spread = depth_spread(Rendering(unused, weights, edges, unused, unused))
    # all at 2; half at 2 and half at 4: log 2 apart, deviation half of that; all light leaves at 5
    torch.testing.assert_close(spread, torch.tensor([0.0, np.log(2.0) / 2, 0.0], dtype=torch.float32))


def test_values_are_averaged_as_colours_are():
    camera = Cameras.create(np.eye(4)[None, :3], np.array([8.0, 8.0, 2.0, 2.0]), 4, 4)
    field = slab_field(5.0, low=-2.0)
    view = render_view(field, camera, 0, sampling=SAMPLING, values=lambda positions: torch.ones(len(positions)))
    np.testing.assert_allclose(view["values"], view["accumulation"], atol=1e-6)
