import numpy as np
import pytest

from unghost.data_recipes.solids.draws import log_whole
from unghost.data_recipes.solids.primitives import BOUNDS, FAMILIES, log_uniform

EXACT_OUTSIDE = {"cable", "lathe", "studs"}  # a bound inside
EXACT = [name for name, family in FAMILIES.items() if family not in BOUNDS]


def test_there_is_variety():
    assert len(FAMILIES) >= 28
    assert len(EXACT) >= 22


@pytest.mark.parametrize("name", FAMILIES)
def test_family_is_deterministic_finite_and_leaves_positions_alone(name):
    positions = np.random.default_rng(0).uniform(-1, 1, size=(500, 3))
    kept = positions.copy()
    first = FAMILIES[name](np.random.default_rng(5))(positions)
    assert first.shape == (500,)
    assert np.isfinite(first).all()
    np.testing.assert_array_equal(first, FAMILIES[name](np.random.default_rng(5))(positions))
    assert not np.array_equal(first, FAMILIES[name](np.random.default_rng(6))(positions))
    np.testing.assert_array_equal(positions, kept)


@pytest.mark.slow
@pytest.mark.parametrize("name", FAMILIES)
def test_solids_have_an_inside_and_an_outside(name):
    axis = (np.arange(48) + 0.5) / 24 - 1.0
    positions = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    values = [FAMILIES[name](np.random.default_rng(seed))(positions) for seed in range(6)]
    assert all((value > 0).any() for value in values)
    # thin solids may slip between the samples, but they come within half a cell's diagonal
    assert all(value.min() < np.sqrt(3) / 48 for value in values)


@pytest.mark.parametrize("name", FAMILIES)
def test_no_sign_change_nearer_than_the_distance_says(name):
    """What leaving far solids out rests on: within a ball of radius |d| the sign does not change (2 % slack)."""
    rng = np.random.default_rng(1)
    for seed in range(8):
        solid = FAMILIES[name](np.random.default_rng(seed))
        centers = rng.uniform(-1, 1, size=(300, 3))
        values = solid(centers)
        steps = rng.normal(size=(300, 3))
        steps *= (rng.uniform(size=(300, 1)) ** (1 / 3)) / np.linalg.norm(steps, axis=1, keepdims=True)
        moved = solid(centers + steps * np.abs(values)[:, None] * 0.98)
        assert (np.sign(moved) == np.sign(values)).all()


def gradient(solid, points, step=1e-6):
    sides = [solid(points + step * axis) - solid(points - step * axis) for axis in np.eye(3)]
    return np.stack(sides, axis=-1) / (2 * step)


@pytest.mark.slow
@pytest.mark.parametrize("name", EXACT)
def test_exact_families_reach_the_surface_and_no_surface_is_nearer(name):
    """Slope 1 almost everywhere; walking the distance down the slope ends on the surface; none of it is nearer."""
    for seed in range(4):
        solid, rng = FAMILIES[name](np.random.default_rng(seed)), np.random.default_rng(100 + seed)
        probes = rng.uniform(-0.7, 0.7, size=(1500, 3))
        slopes, values = gradient(solid, probes), solid(probes)
        smooth = np.abs(np.linalg.norm(slopes, axis=1) - 1) < 1e-4
        assert smooth.mean() > 0.96  # kinks, on the medial axis, are few
        surface = probes - values[:, None] * slopes
        tried = smooth & (values > 0) if name in EXACT_OUTSIDE else smooth
        landed = np.abs(solid(surface)) < 1e-4
        assert landed[tried].mean() > 0.995  # a probe's stencil may straddle a kink
        surface = surface[landed & smooth]
        squares = (probes[:, None, :] - surface[None, ::3]) ** 2
        assert (np.abs(values) <= np.sqrt(squares.sum(axis=2).min(axis=1)) + 1e-3).all()


@pytest.mark.parametrize("name", FAMILIES)
def test_distances_change_by_no_more_than_the_way_moved(name):
    rng = np.random.default_rng(3)
    for seed in range(6):
        solid = FAMILIES[name](np.random.default_rng(seed))
        points = rng.uniform(-1, 1, size=(3000, 3))
        moved = points + rng.normal(size=points.shape) * rng.uniform(1e-3, 0.2, size=(3000, 1))
        gap = np.linalg.norm(points - moved, axis=1)
        assert (np.abs(solid(points) - solid(moved)) <= gap * 1.05 + 1e-6).all()


@pytest.mark.parametrize("name", FAMILIES)
def test_the_order_in_memory_changes_nothing(name):
    positions = np.random.default_rng(0).uniform(-0.6, 0.6, size=(400, 3))
    solid = FAMILIES[name](np.random.default_rng(2))
    np.testing.assert_allclose(solid(np.asfortranarray(positions)), solid(positions), atol=1e-12)


def test_log_whole_covers_its_range_and_favours_the_small():
    rng = np.random.default_rng(0)
    draws = np.array([log_whole(rng, 2, 5) for _ in range(6000)])
    expected = np.log(np.array([3 / 2, 4 / 3, 5 / 4, 6 / 5])) / np.log(6 / 2)
    np.testing.assert_allclose([(draws == n).mean() for n in (2, 3, 4, 5)], expected, atol=0.025)
    assert draws.min() == 2
    assert draws.max() == 5


def test_log_uniform_is_uniform_in_the_logarithm():
    draws = np.log(log_uniform(np.random.default_rng(0), 0.01, 0.2, 20000))
    quantiles = (np.quantile(draws, [0.25, 0.5, 0.75]) - np.log(0.01)) / np.log(20)
    np.testing.assert_allclose(quantiles, [0.25, 0.5, 0.75], atol=0.02)
