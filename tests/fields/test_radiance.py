import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from unghost.fields.radiance import RadianceConfig, RadianceField, contract


def random_field(*, contracted=True, resolution=12, seed=0):
    field = RadianceField(RadianceConfig(resolution, 6, contract=contracted))
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        field.density_table.normal_(0, 4, generator=generator)
        field.color_table.normal_(generator=generator)
    return field


@pytest.mark.parametrize(
    ("position", "expected"),
    [
        ([0.3, -0.5, 1.0], [0.3, -0.5, 1.0]),  # inside: unchanged
        ([2.0, 0.0, 0.0], [1.5, 0.0, 0.0]),  # 2 - 1/2
        ([-4.0, 2.0, 1.0], [-1.75, 0.875, 0.4375]),  # (2 - 1/4) * p / 4
        ([0.0, 0.0, 1e30], [0.0, 0.0, 2.0]),
    ],
)
def test_contract_known_values(position, expected):
    torch.testing.assert_close(contract(torch.tensor(position)), torch.tensor(expected))


@given(st.lists(st.floats(-1e6, 1e6, width=32), min_size=3, max_size=3))
@settings(max_examples=60, deadline=None)
def test_contract_stays_in_the_cube_and_keeps_the_direction(position):
    point = torch.tensor(position, dtype=torch.float64)
    inside = contract(point)
    assert inside.abs().max() <= 2.0
    torch.testing.assert_close(
        torch.linalg.cross(point, inside), torch.zeros(3, dtype=torch.float64), atol=1e-6, rtol=0
    )


@pytest.mark.parametrize("contracted", [True, False])
def test_density_is_positive_and_follows_the_shape_rule(contracted):
    field = random_field(contracted=contracted)
    generator = torch.Generator().manual_seed(1)
    for shape in [(3,), (0, 3), (5, 3), (2, 4, 3), (2, 0, 3)]:
        positions = torch.rand(shape, generator=generator) * 6 - 3
        density = field.density_fn(positions)
        assert density.shape == (*shape[:-1], 1)
        assert (density >= 0).all()
        assert density.isfinite().all()
    assert field.density_fn(torch.zeros(2, 3, dtype=torch.float64)).dtype == torch.float32


def test_initial_opacity_means_the_same_at_any_resolution():
    for resolution in (16, 40):
        for contracted in (True, False):
            field = RadianceField(RadianceConfig(resolution, 8, initial_opacity=0.05, contract=contracted))
            density = field.density_fn(torch.zeros(1, 3))
            opacity = -torch.expm1(-density * field.field_pitch)
            np.testing.assert_allclose(opacity.item(), 0.05, rtol=1e-4)


def test_field_pitch_and_aabb():
    # nodes at both ends of [-2, 2]: 40 cells of 0.1; of [-1, 1]: 40 cells of 0.05
    assert RadianceField(RadianceConfig(41, 8)).field_pitch == pytest.approx(0.1)
    field = RadianceField(RadianceConfig(41, 8, contract=False))
    assert field.field_pitch == pytest.approx(0.05)
    np.testing.assert_array_equal(field.aabb, [[-1, -1, -1], [1, 1, 1]])


def test_resampling_keeps_opacity_per_cell_and_colour():
    field = random_field(resolution=9)
    positions = contract(torch.randn(200, 3, generator=torch.Generator().manual_seed(2)))
    directions = torch.nn.functional.normalize(positions, dim=1)
    depth, color = field.density_fn(positions) * field.field_pitch, field.color(positions, directions)
    field.resample(17, 11)  # 8 cells to 16 and 5 to 10: every old node stays a node, every old cell is halved
    assert (field.resolution, field.color_resolution) == (17, 11)
    torch.testing.assert_close(field.density_fn(positions) * field.field_pitch, depth, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(field.color(positions, directions), color, atol=1e-4, rtol=1e-4)
    assert field.density_table.requires_grad
    assert len(list(field.parameters())) == 2


def test_uncontracted_field_is_empty_outside_however_far():
    field = random_field(contracted=False)
    outside = torch.tensor([[1.01, 0.0, 0.0], [0.0, -7.0, 0.0], [1e10, 0.0, 0.0], [1e20, 1e20, 1e20]])
    density = field.density_fn(outside)
    assert not density.any()
    density.sum().backward()
    assert field.density_table.grad.isfinite().all()
    assert not field.density_table.grad.any()


def test_positions_that_are_not_finite_give_nan_not_a_crash():
    field = RadianceField(RadianceConfig(64, 8))
    for value in (float("nan"), float("inf"), -float("inf")):
        density = field.density_fn(torch.tensor([[value, 0.0, 0.0], [0.0, 0.0, 0.0]]))
        assert density[0].isnan().all()
        assert density[1].isfinite().all()


def test_density_gradient_reaches_the_table():
    field = random_field()
    field.density_fn(torch.zeros(1, 3)).sum().backward()
    assert (field.density_table.grad > 0).sum() == 8


def test_color_lies_in_the_unit_range_and_depends_on_the_view():
    field = random_field()
    positions = torch.zeros(2, 3)
    directions = torch.tensor([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    color = field.color(positions, directions)
    assert ((color > 0) & (color < 1)).all()
    assert not torch.allclose(color[0], color[1])
    with torch.no_grad():
        field.color_table.zero_()
    torch.testing.assert_close(field.color(positions, directions), torch.full((2, 3), 0.5))
    assert field.color(torch.zeros(0, 3), torch.zeros(0, 3)).shape == (0, 3)


def test_nearest_nodes_by_hand():
    field = RadianceField(RadianceConfig(5, 4, contract=False))  # nodes at -1, -0.5, 0, 0.5, 1
    positions = torch.tensor([[-1.0, -1.0, -1.0], [0.2, 0.3, 1.0], [9.0, 9.0, 9.0]])
    # (2, 3, 4) -> (2 * 5 + 3) * 5 + 4
    assert field.nearest_nodes(positions).tolist() == [0, 69, 124]


def test_occupied_nodes_dilate_by_one():
    field = RadianceField(RadianceConfig(7, 4, initial_opacity=1e-6))
    with torch.no_grad():
        field.density_table.view(7, 7, 7)[3, 3, 0] = 5.0
    occupied = field.occupied_nodes(0.01).view(7, 7, 7)
    assert occupied.sum() == 3 * 3 * 2
    assert occupied[2:5, 2:5, :2].all()


def test_what_is_skipped_is_nearly_empty():
    field = random_field(resolution=14)
    with torch.no_grad():
        field.density_table -= 9.0
    positions = torch.rand(4000, 3, generator=torch.Generator().manual_seed(5)) * 4 - 2
    kept = field.occupied_nodes(0.02)[field.nearest_nodes(positions)]
    opacity = -torch.expm1(-field.density_fn(positions)[:, 0] * field.field_pitch)
    assert 0.05 < kept.float().mean() < 0.95
    assert opacity[~kept].max() <= 0.02
    assert opacity[kept].max() > 0.1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"resolution": 3}, "resolutions must be >= 4, got 3"),
        ({"color_resolution": 1}, "resolutions must be >= 4, got 160, 1"),
        ({"initial_opacity": 0.0}, r"initial_opacity must lie in \(0, 1\), got 0.0"),
        ({"initial_opacity": 1.0}, r"initial_opacity must lie in \(0, 1\), got 1.0"),
    ],
)
def test_bad_configs_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        RadianceConfig(**arguments)
