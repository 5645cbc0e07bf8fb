import numpy as np
import pytest

from unghost.data_recipes.primitives import FAMILIES, log_uniform


def test_there_is_variety():
    assert len(FAMILIES) >= 20


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


def test_log_uniform_is_uniform_in_the_logarithm():
    draws = np.log(log_uniform(np.random.default_rng(0), 0.01, 0.2, 20000))
    quantiles = (np.quantile(draws, [0.25, 0.5, 0.75]) - np.log(0.01)) / np.log(20)
    np.testing.assert_allclose(quantiles, [0.25, 0.5, 0.75], atol=0.02)
