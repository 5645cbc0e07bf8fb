import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from unghost.core.frames import CubeFrame, cube_lattices, edge_fraction, random_rotations, unit_lattice

coordinates = st.floats(-100, 100, allow_nan=False)


def test_unit_lattice_is_cell_centred_and_indexed_xyz():
    lattice = unit_lattice(4)
    assert lattice.shape == (4, 4, 4, 3)
    np.testing.assert_allclose(lattice[:, 0, 0, 0], [-0.375, -0.125, 0.125, 0.375])
    np.testing.assert_allclose(lattice[1, 2, 3], [-0.125, 0.125, 0.375])  # [i, j, k] is [x, y, z]


@given(
    center=st.tuples(coordinates, coordinates, coordinates),
    edge=st.floats(1e-3, 1e3),
    resolution=st.integers(1, 9),
    seed=st.integers(0, 10_000),
)
def test_lattice_round_trip(center, edge, resolution, seed):
    rotation = random_rotations(np.random.default_rng(seed), 1)[0]
    frame = CubeFrame(np.array(center), edge, rotation)
    index = np.stack(np.meshgrid(*[np.arange(resolution)] * 3, indexing="ij"), axis=-1)
    np.testing.assert_array_equal(frame.voxel_index(frame.lattice(resolution), resolution), index)


def test_lattice_by_hand():
    frame = CubeFrame(np.array([1.0, 2.0, 3.0]), 2.0)
    np.testing.assert_allclose(frame.lattice(2)[0, 1, 1], [0.5, 2.5, 3.5])
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # cube x points along world y
    turned = CubeFrame(np.zeros(3), 2.0, turn)
    np.testing.assert_allclose(turned.lattice(2)[1, 0, 0], turn @ [0.5, -0.5, -0.5])


def test_cube_of_a_batch_equals_the_cube_alone():
    rng = np.random.default_rng(0)
    centers, edges, rotations = rng.normal(size=(5, 3)), rng.uniform(0.1, 2, 5), random_rotations(rng, 5)
    batch = cube_lattices(centers, edges, rotations, resolution=3)
    for i in range(5):
        alone = CubeFrame(centers[i], edges[i], rotations[i]).lattice(3)
        np.testing.assert_allclose(batch[i], alone, atol=1e-14)
    assert cube_lattices(np.zeros((0, 3)), np.zeros(0)).shape == (0, 32, 32, 32, 3)


def test_ball_against_its_volume():
    frame = CubeFrame(np.array([3.0, -1.0, 0.5]), 2.0, random_rotations(np.random.default_rng(3), 1)[0])
    inside = np.linalg.norm(frame.lattice(64) - frame.center, axis=-1) < 0.8
    volume = inside.sum() * (2.0 / 64) ** 3
    assert volume == pytest.approx(4 / 3 * np.pi * 0.8**3, rel=2e-3)


def test_edge_fraction_is_of_the_longest_side():
    assert edge_fraction(0.5, np.array([[0, 0, 0], [1, 10, 2]])) == pytest.approx(0.05)


def test_random_rotations_are_uniform_on_so3():
    rotations = random_rotations(np.random.default_rng(7), 20_000)
    np.testing.assert_allclose(rotations @ rotations.swapaxes(1, 2), np.tile(np.eye(3), (20_000, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(rotations), 1.0, atol=1e-12)
    # Haar measure: E[R] = 0, E[R_ij^2] = 1/3, and the angle has density (1 - cos a) / pi on [0, pi].
    assert np.abs(rotations.mean(axis=0)).max() < 5 * np.sqrt(1 / 3 / 20_000)
    assert np.abs((rotations**2).mean(axis=0) - 1 / 3).max() < 0.012
    angle = np.arccos(np.clip((np.trace(rotations, axis1=1, axis2=2) - 1) / 2, -1, 1))
    grid = np.linspace(0, np.pi, 50)
    empirical = np.searchsorted(np.sort(angle), grid) / len(angle)
    assert np.abs(empirical - (grid - np.sin(grid)) / np.pi).max() < 1.63 / np.sqrt(20_000)  # Kolmogorov, 1 %


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((np.zeros(2), 1.0), r"center must have shape \(3,\), got \(2,\)"),
        ((np.zeros(3), 0.0), "edge_length must be finite and > 0, got 0.0"),
        ((np.zeros(3), np.nan), "edge_length must be finite"),
        ((np.zeros(3), 1.0, 2 * np.eye(3)), "orthonormal"),
    ],
)
def test_impossible_frames_are_refused(arguments, words):
    with pytest.raises(ValueError, match=words):
        CubeFrame(*arguments)


def test_shape_errors_say_what_was_given():
    with pytest.raises(ValueError, match=r"centers must have shape \(N, 3\), got \(3,\)"):
        cube_lattices(np.zeros(3), np.zeros(1))
    with pytest.raises(ValueError, match=r"edge_lengths must have shape \(2,\), got \(3,\)"):
        cube_lattices(np.zeros((2, 3)), np.zeros(3))
    with pytest.raises(ValueError, match="resolution must be >= 1, got 0"):
        unit_lattice(0)
