"""What every kind of field promises to fitting, rendering and harvesting."""

import copy

import numpy as np
import pytest
import torch

from unghost.fields.implicit import LOOKS
from unghost.fields.kinds import KINDS, make_field
from unghost.fields.rendering import Sampling, render_rays, render_view
from unghost.fields.training import TrainingConfig, train_field

QUICK = TrainingConfig(rays=256, sampling=Sampling(near=0.1, middle=2.6, near_samples=40, far_samples=0))
ENCODED = sorted(set(KINDS) - {"dense"})
every_kind = pytest.mark.parametrize("kind", sorted(KINDS))


def small(kind, **options):
    return make_field(kind, 24, **{"contract": False, **options})


def random_start(kind, **options):
    """A field that varies in space: its first layer's or table's values are drawn wide."""
    field = small(kind, **options)
    generator = torch.Generator().manual_seed(4)
    with torch.no_grad():
        for name, value in field.named_parameters():
            if "table" in name:
                value.normal_(0, 2, generator=generator)
            elif name == "trunk.0.weight":
                value.mul_(2)
        if kind != "dense":
            field.trunk[-1].weight.mul_(20)
    return field


@pytest.mark.slow
@every_kind
def test_each_kind_learns_a_ball_in_a_room(kind, photos):
    cameras, images = photos
    field, kept = small(kind), images.copy()
    errors = []

    def before(field, step):
        if step == 0:
            errors.append(np.mean((render_view(field, cameras, 0, sampling=QUICK.sampling)["rgb"] - images[0]) ** 2))

    report = train_field(field, cameras, images, steps=120, config=QUICK, regularizer=before)
    view = render_view(field, cameras, 0, sampling=QUICK.sampling)
    assert view["rgb"].shape == (18, 24, 3)
    assert report["steps"] == 120
    assert np.mean((view["rgb"] - images[0]) ** 2) < 0.3 * errors[0]  # the best constant colour has 0.51 of it
    assert view["accumulation"].mean() > 0.5
    np.testing.assert_array_equal(images, kept)


@pytest.mark.slow
@every_kind
def test_the_seed_of_the_start_and_of_the_run_decide_and_nothing_else(kind, photos):
    state, probes, field = torch.random.get_rng_state(), [], None
    points = torch.rand(50, 3, generator=torch.Generator().manual_seed(0)) * 1.6 - 0.8
    for start, seed in ((0, 0), (0, 0), (0, 1), (1, 0)):
        field = small(kind, seed=start)
        train_field(field, *photos, steps=6, seed=seed, config=QUICK)
        probes.append(field.density_fn(points).detach())
    assert torch.equal(torch.random.get_rng_state(), state)
    assert torch.equal(probes[0], probes[1])
    assert not torch.equal(probes[0], probes[2])
    assert torch.equal(probes[0], probes[3]) == (kind == "dense")  # a dense grid starts even
    twin = copy.deepcopy(field)
    assert torch.equal(twin.density_fn(points), probes[3])


@every_kind
@pytest.mark.parametrize("contracted", [True, False])
def test_density_is_positive_and_follows_the_shape_rule(kind, contracted):
    field = random_start(kind, contract=contracted)
    generator = torch.Generator().manual_seed(1)
    for shape in [(3,), (0, 3), (5, 3), (2, 4, 3), (2, 0, 3)]:
        density = field.density_fn(torch.rand(shape, generator=generator) * 6 - 3)
        assert density.shape == (*shape[:-1], 1)
        assert density.isfinite().all()
        assert (density >= 0).all()
    assert field.density_fn(torch.zeros(2, 3, dtype=torch.float64)).dtype == torch.float32
    np.testing.assert_array_equal(field.aabb, [[-1, -1, -1], [1, 1, 1]])
    outside = field.density_fn(torch.tensor([[1.01, 0.0, 0.0], [0.0, -7.0, 0.0], [1e20, 1e20, 1e20]]))
    assert bool(outside.any()) == contracted
    broken = field.density_fn(torch.tensor([[float("nan"), 0.0, 0.0], [0.0, 0.0, 0.0]]))
    assert broken[0].isnan().all()
    assert broken[1].isfinite().all()


@every_kind
@pytest.mark.parametrize("resolution", [16, 40])
def test_initial_opacity_of_a_cell_means_the_same(kind, resolution):
    field = make_field(kind, resolution, initial_opacity=0.05)
    density = field.density_fn(torch.rand(200, 3, generator=torch.Generator().manual_seed(2)) * 2 - 1)
    opacity = -torch.expm1(-density * field.field_pitch)
    np.testing.assert_allclose(opacity.median().item(), 0.05, rtol=0.25)
    np.testing.assert_allclose(field.field_pitch, 4 / resolution, rtol=0.07)  # dense: nodes at both ends


@every_kind
def test_colour_lies_in_the_unit_range_and_depends_on_place_and_view(kind):
    field = random_start(kind)
    with torch.no_grad():
        for name, value in field.named_parameters():
            if name.startswith("head") and name.endswith("weight"):
                value.mul_(10)
    positions = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.4, 0.3, -0.6]])
    directions = torch.tensor([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    color = field.color(positions, directions)
    assert ((color >= 0) & (color <= 1)).all()
    assert not torch.allclose(color[0], color[1])
    assert not torch.allclose(color[0], color[2])
    assert field.color(torch.zeros(0, 3), torch.zeros(0, 3)).shape == (0, 3)


@every_kind
def test_one_query_says_what_density_and_colour_say(kind):
    field = random_start(kind)
    positions = torch.rand(30, 3, generator=torch.Generator().manual_seed(6)) * 2.4 - 1.2
    rows = torch.tensor([29, 0, 7, 7])
    directions = torch.nn.functional.normalize(torch.randn(4, 3, generator=torch.Generator().manual_seed(7)), dim=1)
    density, shade = field.query(positions)
    torch.testing.assert_close(density, field.density_fn(positions)[:, 0])
    torch.testing.assert_close(shade(rows, directions), field.color(positions[rows], directions))
    assert shade(rows[:0], directions[:0]).shape == (0, 3)


@every_kind
def test_every_parameter_is_fitted_once_and_has_a_gradient(kind):
    field = random_start(kind)
    grouped = [parameter for parameters, _ in field.parameter_groups() for parameter in parameters]
    assert len(grouped) == len({id(parameter) for parameter in grouped})
    assert {id(parameter) for parameter in grouped} == {id(parameter) for parameter in field.parameters()}
    assert all(relative > 0 for _, relative in field.parameter_groups())
    origins = torch.tensor([[-0.9, 0.0, 0.0], [0.0, -0.9, 0.1]])
    directions = torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    rendering = render_rays(field, origins, directions, QUICK.sampling)
    (rendering.rgb.sum() + rendering.weights[:, :10].sum()).backward()
    for name, parameter in field.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.abs().sum() > 0, name


@pytest.mark.slow
@pytest.mark.parametrize("kind", ENCODED)
def test_what_is_skipped_is_nearly_empty(kind):
    field = random_start(kind)
    with torch.no_grad():
        field.trunk[-1].bias[0] -= {"hash": 3.0, "mlp": 0.5}[kind]
    for _ in range(12):
        occupied = field.occupied_nodes(0.02)
    positions = torch.rand(20_000, 3, generator=torch.Generator().manual_seed(5)) * 2 - 1
    kept = occupied[field.nearest_nodes(positions)]
    opacity = -torch.expm1(-field.density_fn(positions)[:, 0] * field.field_pitch)
    opaque = opacity > 0.02
    assert 0.02 < opaque.float().mean() < 0.98
    assert (~kept).any()
    assert (opaque & ~kept).sum() < 0.01 * opaque.sum()  # a look sees one point a cell
    assert opacity[~kept].max() < 0.2 * opacity.max()


@pytest.mark.parametrize("kind", ENCODED)
def test_the_memory_of_what_is_empty_looks_elsewhere_each_time_and_fades(kind):
    field, again = random_start(kind), random_start(kind)
    first = field.occupied_nodes(0.02)
    assert torch.equal(first, again.occupied_nodes(0.02))
    peak = field.peak.clone()
    field.occupied_nodes(0.02)
    assert (field.peak >= 0.95 * peak - 1e-7).all()
    assert (field.peak > peak).any()
    assert (field.peak < peak).any()
    assert "peak" not in field.state_dict()
    # nodes at -1, -1 + 2/47, ..: the middle of the axis lies between the nodes 23 and 24
    corner = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0], [9.0, 9.0, 9.0], [-1.0, -1.0, 0.01]])
    assert field.nearest_nodes(corner).tolist() == [0, LOOKS**3 - 1, LOOKS**3 - 1, 24]


def test_an_unknown_kind_is_refused():
    with pytest.raises(ValueError, match="make_field: kind must be one of dense, hash, mlp, got 'splat'"):
        make_field("splat", 64)
