"""The side of a field's cells, from its densities: grids of all kinds, smooth fields, and those that say nothing."""

import numpy as np
import pytest

from unghost.cleaning.pitch_estimation import MOST_QUERIES, estimate_pitch, fallback_pitch
from unghost.cleaning.queries import make_query
from unghost.core.occupancy import opacity_from_density
from unghost.fields.adapters.grids import grid_density_fn

BOX = np.array([[-1.0] * 3, [1.0] * 3])


@pytest.fixture
def rng():
    return np.random.default_rng(3)


def estimate(density_fn, box=BOX, seed=0):
    query = make_query(density_fn, place=np.mean(box, axis=0), caller="test")
    return estimate_pitch(query, box, rng=np.random.default_rng(seed))


def random_field(kind, resolution, **options):
    """A field of a kind with wide random parameters, as after a training: it varies in every cell."""
    torch = pytest.importorskip("torch")
    from unghost.fields.kinds import make_field

    field = make_field(kind, resolution, **{"contract": False, **options})
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


def fitted_field(kind, resolution, steps=80):
    """A field whose opacities were fitted to a ball above a floor."""
    torch = pytest.importorskip("torch")
    from unghost.fields.kinds import make_field

    field, generator = make_field(kind, resolution, contract=False), torch.Generator().manual_seed(0)
    groups = [{"params": group, "lr": 0.02 * rate} for group, rate in field.parameter_groups()]
    optimizer = torch.optim.Adam(groups)
    for _ in range(steps):
        places = torch.rand(8192, 3, generator=generator) * 2 - 1
        solid = ((places - 0.1).norm(dim=-1) < 0.45) | ((places[:, 2] + 0.7).abs() < 0.06)
        loss = ((1 - torch.exp(-field.density_fn(places)[:, 0] * 0.03) - 0.95 * solid.float()) ** 2).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return field


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["dense", "hash"])
@pytest.mark.parametrize("resolution", [24, 48, 100, 200])
def test_the_cells_of_dense_and_hash_grids(kind, resolution):
    field = random_field(kind, resolution)
    found = estimate(field.density_fn)
    assert found.source == "cells"
    assert found.pitch == pytest.approx(field.field_pitch, rel=0.02)  # asked for: within a factor 1.5
    assert found.queries <= MOST_QUERIES


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["dense", "hash"])
@pytest.mark.parametrize("resolution", [48, 128])
def test_the_cells_of_a_field_that_was_fitted_to_a_scene(kind, resolution):
    field = fitted_field(kind, resolution)
    found = estimate(field.density_fn)
    assert found.source == "cells"
    assert found.pitch == pytest.approx(field.field_pitch, rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["dense", "hash"])
def test_a_contracted_field_is_judged_by_the_part_that_is_not(kind):
    field = random_field(kind, 64, contract=True)
    assert estimate(field.density_fn).pitch == pytest.approx(4 / 64, rel=0.05)


@pytest.mark.parametrize("precision", ["half", "bfloat16"])
def test_densities_of_half_precision(precision):
    field = random_field("dense", 64)
    found = estimate(lambda positions: getattr(field.density_fn(positions), precision)())
    assert found.pitch == pytest.approx(field.field_pitch, rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_the_seed_matters_little(seed):
    field = fitted_field("hash", 64, steps=40)
    assert estimate(field.density_fn, seed=seed).pitch == pytest.approx(field.field_pitch, rel=0.02)


@pytest.mark.parametrize(
    ("sides", "shape", "pitch"),
    [
        ((3.0, 1.0, 1.5), (96, 32, 48), 1 / 32),
        ((1.0, 1.0, 0.25), (128, 128, 32), 1 / 128),
        ((2.0, 1.0, 1.5), (64, 64, 64), 1.5 / 64),  # cells that are no cubes: the middle one of their sides
    ],
)
def test_boxes_that_are_no_cubes(rng, sides, shape, pitch):
    box = np.array([[5.0, -2.0, 0.0], np.add([5.0, -2.0, 0.0], sides)])
    found = estimate(grid_density_fn(rng.random(shape) ** 4 * 50, box), box)
    assert found.pitch == pytest.approx(pitch, rel=0.02)


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("factor", [1e-6, 1e6])
def test_units_of_length_and_of_density_do_not_matter(rng, unit, factor):
    field = grid_density_fn(rng.random((64, 64, 64)) ** 4, BOX)
    found = estimate(lambda positions: field(positions / unit) * (factor / unit), BOX * unit)
    assert found.pitch == pytest.approx(2 / 64 * unit, rel=0.02)


def test_a_box_far_from_the_origin(rng):
    box = BOX + 200.0  # float32 resolves 1.5e-5 there
    found = estimate(grid_density_fn(rng.random((64, 64, 64)) ** 4, box), box)
    assert found.pitch == pytest.approx(2 / 64, rel=0.02)


def test_a_box_in_the_middle_of_a_grid(rng):
    field = grid_density_fn(rng.random((96, 96, 96)) ** 4, BOX)
    assert estimate(field, [[-0.4, -0.3, -0.5], [0.5, 0.4, 0.6]]).pitch == pytest.approx(2 / 96, rel=0.02)


def test_nearest_neighbours(rng):
    grid = rng.random((50, 50, 50)) ** 3 * 40
    found = estimate(lambda p: grid[tuple(np.clip(((p + 1) * 25).astype(int), 0, 49).T)])
    assert (found.source, found.pitch) == ("cells", pytest.approx(0.04, rel=0.02))


def test_places_with_invalid_densities_are_left_out(rng):
    grid = grid_density_fn(rng.random((64, 64, 64)) ** 4, BOX)

    def field(positions):
        values = grid(positions)[:, 0].astype(np.float64)
        values[positions[:, 0] > 0.3] = np.nan
        values[positions[:, 1] > 0.5] = np.inf
        values[positions[:, 2] > 0.7] = -1.0
        return values

    assert estimate(field).pitch == pytest.approx(2 / 64, rel=0.02)
    for value in (np.nan, np.inf, -1.0):
        found = estimate(lambda positions, value=value: np.full(len(positions), value))
        assert (found.source, found.varies) == ("extent", False)


def half_wavelength(density_fn, lines=60, samples=4001):
    """The reference that the docstring states, by central differences on long lines."""
    rng = np.random.default_rng(1)
    places = rng.uniform(-1, 1, (lines, 1, 3)) * np.ones((1, samples, 1))
    line, at = np.linspace(-1, 1, samples), np.arange(lines) % 3
    places[np.arange(lines), :, at] = line
    query = make_query(density_fn, place=np.zeros(3), caller="test")
    opacity = opacity_from_density(query(places.reshape(-1, 3)).reshape(lines, samples), 2 / 128)
    spacing = 10 * (line[1] - line[0])  # float32 densities: no finer
    first = (opacity[:, 20:] - opacity[:, :-20]) / (2 * spacing)
    second = (opacity[:, 20:] - 2 * opacity[:, 10:-10] + opacity[:, :-20]) / spacing**2
    return np.pi * np.sqrt((first**2).mean() / (second**2).mean())


def waves(half, count=60):
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(count, 3))
    numbers, phases = (
        directions / np.linalg.norm(directions, axis=1, keepdims=True) * np.pi / half,
        rng.random(count) * 7,
    )
    return lambda p: 30 * np.exp(np.sin(p @ numbers.T + phases).sum(axis=1) / np.sqrt(count) * 2)


@pytest.mark.slow
@pytest.mark.parametrize("half", [0.02, 0.03, 0.05])
def test_a_field_without_cells_has_half_a_wavelength(half):
    found, reference = estimate(waves(half)), half_wavelength(waves(half))
    assert found.source == "smoothness"
    assert reference / 2 < found.pitch < 2 * reference
    assert half / 2 < found.pitch < 2 * half
    assert found.queries <= MOST_QUERIES


@pytest.mark.slow
@pytest.mark.parametrize("resolution", [32, 64])
def test_an_mlp_has_half_a_wavelength(resolution):
    field = random_field("mlp", resolution)
    found, reference = estimate(field.density_fn), half_wavelength(field.density_fn)
    assert found.source == "smoothness"
    assert reference / 2 < found.pitch < 2 * reference
    assert field.field_pitch / 2.5 < found.pitch < 2.5 * field.field_pitch  # of its highest frequency


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(
    "solid",
    [
        lambda p: np.linalg.norm(p, axis=-1) < 0.5,
        lambda p: (np.linalg.norm(p, axis=-1) < 0.5) | (np.abs(p[:, 2] + 0.7) < 0.06),
        lambda p: (np.abs(p) < 0.4).all(axis=-1) | (np.abs(p[:, 2] + 0.7) < 0.06),
    ],
    ids=["ball", "ball and floor", "box and floor"],
)
def test_sharp_edges_without_cells_leave_the_extent(solid, seed):
    found = estimate(lambda p: 80.0 * solid(p), seed=seed)
    assert (found.source, found.varies, found.pitch) == ("extent", True, 2 / 128)
    assert "sharp edges" in found.reason


def test_a_field_that_is_smoother_than_any_grid_has_a_bounded_pitch():
    found = estimate(lambda p: 10 * np.exp(-4 * (p**2).sum(axis=1)))
    assert (found.source, found.pitch) == ("smoothness", 2 / 32)


@pytest.mark.parametrize("value", [0.0, 3.0])
def test_a_constant_field_says_nothing_yet(value):
    found = estimate(lambda p: np.full(len(p), value))
    assert (found.source, found.varies, found.pitch) == ("extent", False, fallback_pitch(BOX))


def test_fields_before_their_training_say_nothing_yet():
    pytest.importorskip("torch")
    from unghost.fields.kinds import make_field

    for kind in ("dense", "hash"):
        found = estimate(make_field(kind, 64).density_fn)
        assert (found.source, found.varies) == ("extent", False)


def test_a_flat_box(rng):
    box = np.array([[-1.0, -1.0, 0.0], [1.0, 1.0, 0.01]])  # thinner than a line is long
    found = estimate(grid_density_fn(rng.random((64, 64, 1)) ** 4, box), box)
    assert found.pitch == pytest.approx(2 / 64, rel=0.02)


def test_an_impossible_box_is_refused():
    with pytest.raises(ValueError, match="estimate_pitch: aabb"):
        estimate_pitch(lambda p: p[:, 0], [[0, 0, 0], [1, 1, 0]], rng=np.random.default_rng(0))
