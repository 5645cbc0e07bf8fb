import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from unghost.core.frames import unit_lattice
from unghost.data_recipes.inspection.thickness import half_lattice_distance, local_thickness


def block(*lengths, start=5, resolution=32):
    occupied = np.zeros((resolution,) * 3, dtype=bool)
    occupied[tuple(slice(start, start + length) for length in lengths)] = True
    return occupied


@pytest.mark.parametrize("thick", [1, 2, 3, 4, 7, 16])
def test_slabs_and_rods_have_their_own_thickness(thick):
    slab = np.zeros((32,) * 3, dtype=bool)
    slab[:, 4 : 4 + thick] = True
    np.testing.assert_allclose(local_thickness(slab), thick)
    np.testing.assert_allclose(local_thickness(block(thick, thick, 20)), thick)


def test_each_part_has_its_own_thickness():
    """A block of 8 and, apart from it, a sheet of 2: 512 voxels at 8, 2 * 32 * 32 at 2, in the order of the voxels."""
    occupied = block(8, 8, 8, start=10)
    occupied[28:30] = True
    np.testing.assert_allclose(local_thickness(occupied), [8.0] * 512 + [2.0] * 2048)


def test_a_fin_on_a_wall_keeps_its_own():
    """A wall of 6 with a long fin of 1: the fin's far half does not climb into the wall."""
    occupied = np.zeros((32,) * 3, dtype=bool)
    occupied[:6] = True
    occupied[6:, 16] = True
    found = np.zeros((32,) * 3)
    found[occupied] = local_thickness(occupied)
    np.testing.assert_allclose(found[20:, 16], 1.0)
    np.testing.assert_allclose(found[:6, :10], 6.0)


def test_a_ball_is_a_little_less_than_its_diameter():
    for radius in (4.0, 8.0, 12.0):
        found = local_thickness(np.linalg.norm(unit_lattice(), axis=-1) * 32 < radius)
        assert 2 * radius - 2 < found.max() <= 2 * radius


def test_the_cubes_border_ends_a_part():
    occupied = np.zeros((32,) * 3, dtype=bool)
    occupied[:3] = True
    np.testing.assert_allclose(local_thickness(occupied), 3.0)


def test_empty_and_full():
    assert local_thickness(np.zeros((8, 8, 8), dtype=bool)).shape == (0,)
    np.testing.assert_array_equal(local_thickness(np.ones((8, 8, 8), dtype=bool)), np.full(512, 8.0))
    assert np.isinf(half_lattice_distance(np.ones((2, 3, 4), dtype=bool))).all()


def slow_distance(occupied):
    """Every place against every empty place, by the book."""
    shape = tuple(2 * n - 1 for n in occupied.shape)
    filled = np.zeros(shape, dtype=bool)
    for place in np.ndindex(shape):
        touched = [sorted({p // 2, (p + 1) // 2}) for p in place]
        filled[place] = occupied[np.ix_(*touched)].all()
    empty = np.argwhere(~filled)
    distance = np.zeros(shape)
    for place in np.argwhere(filled):
        distance[tuple(place)] = np.sqrt(((empty - place) ** 2).sum(axis=1).min()) / 2 if len(empty) else np.inf
    return distance


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**31), share=st.sampled_from([0.1, 0.6, 0.95]))
def test_distance_agrees_with_the_slow_twin(seed, share):
    occupied = np.random.default_rng(seed).random((4, 5, 3)) < share
    kept = occupied.copy()
    np.testing.assert_allclose(half_lattice_distance(occupied), slow_distance(occupied))
    np.testing.assert_array_equal(occupied, kept)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**31), share=st.sampled_from([0.02, 0.5, 0.98]))
def test_thickness_is_at_least_the_ball_at_the_voxel_and_at_most_the_cube(seed, share):
    occupied = np.random.default_rng(seed).random((9, 9, 9)) < share
    own = 2 * half_lattice_distance(np.pad(occupied, 1))[2:-2:2, 2:-2:2, 2:-2:2][occupied]
    found = local_thickness(occupied)
    assert found.shape == (int(occupied.sum()),)
    assert (found >= own - 1e-5).all()
    assert (found <= 9).all()
