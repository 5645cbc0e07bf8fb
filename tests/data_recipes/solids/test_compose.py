import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from unghost.core.distances import signed as sd
from unghost.core.frames import CubeFrame, random_rotations, unit_lattice
from unghost.data_recipes.recipe import Recipe
from unghost.data_recipes.solids.compose import (
    ComposedObject,
    Part,
    compose_object,
    dilate,
    random_dilation,
    sample_cube,
    shell_from_distance,
    surface_point,
)
from unghost.data_recipes.solids.narrow_band import shell_in_cube

RECIPE = Recipe()


def ball_part(center, radius, operation="add"):
    return Part(lambda p: sd.sphere(p, 0.5), np.array(center), np.eye(3), 2 * radius, operation)


def test_dilation_by_zero_is_the_identity():
    occupancy = np.random.default_rng(0).random((8, 8, 8)) < 0.2
    for faces_only in (False, True):
        grown = dilate(occupancy, 0, faces_only=faces_only)
        np.testing.assert_array_equal(grown, occupancy)
        assert grown is not occupancy


def test_dilation_of_one_voxel_by_hand():
    point = np.zeros((7, 7, 7), dtype=bool)
    point[3, 3, 3] = True
    assert dilate(point, 1).sum() == 27  # 3^3
    assert dilate(point, 2).sum() == 125  # 5^3
    assert dilate(point, 1, faces_only=True).sum() == 7  # itself and six
    assert dilate(point, 2, faces_only=True).sum() == 25  # the octahedron 1 + 6 + 18
    assert point.sum() == 1


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**31), iterations=st.integers(1, 3), faces_only=st.booleans())
def test_dilation_matches_scipy(seed, iterations, faces_only):
    ndimage = pytest.importorskip("scipy.ndimage")
    occupancy = np.random.default_rng(seed).random((9, 9, 9)) < 0.03
    structure = ndimage.generate_binary_structure(3, 1 if faces_only else 3)
    np.testing.assert_array_equal(
        dilate(occupancy, iterations, faces_only=faces_only),
        ndimage.binary_dilation(occupancy, structure, iterations=iterations),
    )


def test_negative_dilation_is_refused():
    with pytest.raises(ValueError, match="iterations must be >= 0, got -1"):
        dilate(np.zeros((4, 4, 4), dtype=bool), -1)


def test_random_dilation_of_nothing_and_never():
    rng = np.random.default_rng(0)
    assert not random_dilation(rng, np.zeros((8, 8, 8), dtype=bool), 3).any()
    occupancy = rng.random((8, 8, 8)) < 0.1
    np.testing.assert_array_equal(random_dilation(rng, occupancy, 0), occupancy)


def test_shell_of_a_plane_is_one_layer():
    distance = np.broadcast_to(np.arange(8.0)[:, None, None] - 3.2, (8, 8, 8))
    shell = shell_from_distance(distance)  # the plane x = 3.2 voxel centres lies within half a voxel of centre 3 only
    assert shell[3].all()
    assert shell.sum() == 64


def test_shell_does_not_depend_on_the_unit_or_the_slope_of_the_distance():
    distance = sd.sphere(unit_lattice(16), 0.31)
    np.testing.assert_array_equal(shell_from_distance(distance), shell_from_distance(0.3 * distance))


def test_shell_keeps_sheets_thinner_than_a_voxel():
    height = unit_lattice(16)[..., 2]
    shell = shell_from_distance(np.abs(height - 0.01) - 0.001)
    assert shell.any(axis=2).all()  # no holes


def test_shell_of_a_ball_has_the_voxels_its_surface_crosses():
    lattice, radius = unit_lattice(32), 0.37
    offsets = np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T / 64
    corners = np.linalg.norm(lattice[..., None, :] + offsets, axis=-1) < radius
    crossed = corners.any(axis=-1) & ~corners.all(axis=-1)
    shell = shell_from_distance(sd.sphere(lattice, radius))
    assert (shell & crossed).sum() / crossed.sum() > 0.995  # no holes
    assert (shell & crossed).sum() / (shell | crossed).sum() > 0.93


def test_operations():
    ends = np.array([[-0.4, 0, 0], [0.4, 0, 0]])
    both = ComposedObject((ball_part([-0.4, 0, 0], 0.3), ball_part([0.4, 0, 0], 0.3)), 1.4)
    np.testing.assert_allclose(both.distance(ends), [-0.3, -0.3])
    cut = ComposedObject((ball_part([0, 0, 0], 0.6), ball_part([0.4, 0, 0], 0.3, "cut")), 1.2)
    np.testing.assert_allclose(cut.distance(ends), [-0.2, 0.3])  # 0.4 - 0.6; inside the cavity by 0.3


def test_leaving_far_parts_out_changes_no_cube():
    lattice = unit_lattice(12).reshape(-1, 3)
    fewer = 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        composed = compose_object(rng, RECIPE)
        center, _ = surface_point(rng, composed)
        edge = 0.15 * composed.extent
        near = composed.near(center, edge * np.sqrt(3) / 2)
        positions = lattice * edge + center
        np.testing.assert_array_equal(near.distance(positions) < 0, composed.distance(positions) < 0)
        fewer += len(near.parts) < len(composed.parts)
    assert fewer > 15  # else the test shows nothing


def test_an_object_seen_from_a_cube_is_the_same_object_in_its_coordinates():
    for seed in range(20):
        rng = np.random.default_rng(seed)
        composed = compose_object(rng, RECIPE)
        frame = CubeFrame(rng.normal(size=3) * 0.2, 0.07, random_rotations(rng, 1)[0])
        positions = frame.lattice(6).reshape(-1, 3)
        seen = composed.seen_from(frame).distance(unit_lattice(6).reshape(-1, 3))
        np.testing.assert_allclose(seen * 0.07, composed.distance(positions), atol=1e-6)  # sines are float32


def test_cavity_alone_is_nothing():
    composed = ComposedObject((ball_part([0, 0, 0], 0.1), ball_part([1, 0, 0], 0.3, "cut")), 2.0)
    assert composed.near(np.array([1.2, 0, 0]), 0.2).parts == ()


def test_surface_points_lie_on_the_surface():
    misses = []
    for seed in range(100):
        rng = np.random.default_rng(seed)
        composed = compose_object(rng, RECIPE)
        point, normal = surface_point(rng, composed)
        misses.append(abs(float(composed.distance(point[None])[0])) / composed.extent)
        assert np.linalg.norm(normal) == pytest.approx(1.0, abs=1e-6)
    assert np.quantile(misses, 0.9) < 1e-3  # of the extent; a voxel of the smallest cube is 3e-4


def test_sample_depends_on_its_generator_alone():
    first = sample_cube(np.random.default_rng([0, 7]), RECIPE)
    sample_cube(np.random.default_rng([0, 8]), RECIPE)
    again = sample_cube(np.random.default_rng([0, 7]), RECIPE)
    np.testing.assert_array_equal(first[0], again[0])
    assert first[1] == again[1]


def test_cubes_are_varied_and_within_the_recipe():
    drawn = [sample_cube(np.random.default_rng([1, i]), RECIPE) for i in range(250)]
    counts = np.array([occupancy.sum() for occupancy, _, _ in drawn])
    fractions = np.array([fraction for _, fraction, _ in drawn])
    assert all(occupancy.shape == (32, 32, 32) and occupancy.dtype == bool for occupancy, _, _ in drawn)
    assert fractions.min() >= 0.01
    assert fractions.max() <= 0.2
    assert np.median(np.log(fractions)) == pytest.approx(np.log(0.01 * 0.2) / 2, abs=0.3)
    assert 0.02 <= (counts == 0).mean() <= 0.2  # truly empty ones are there, and not too many
    assert (counts < 300).mean() > (counts == 0).mean()  # near-empty ones too
    assert (counts == 32**3).mean() < 0.02
    assert 1000 < np.median(counts) < 6000


def test_a_cube_says_where_in_its_object_it_lies():
    recipe = dataclasses.replace(RECIPE, max_dilation=0, solid_share=0.0, shell_thickness=(1.0, 1.0))
    filled = 0
    for index in range(40):
        occupancy, fraction, frame = sample_cube(np.random.default_rng([2, index]), recipe)
        rng = np.random.default_rng([2, index])
        rng.random(2)  # the edge fraction, and whether the cube is empty
        if frame is None:
            assert not occupancy.any()
            continue
        composed = compose_object(rng, recipe)
        assert frame.edge_length == fraction * composed.extent
        again = shell_in_cube(composed.seen_from(frame).distance, thickness=1.0, solid=False)
        assert (again != occupancy).mean() < 1e-4  # parts that only fillets reach are left out of a sample
        filled += bool(occupancy.any())
    assert filled > 25


def test_shares_of_one_and_zero():
    for i in range(10):
        empty, _, frame = sample_cube(np.random.default_rng(i), dataclasses.replace(RECIPE, empty_share=1.0))
        assert not empty.any()
        assert frame is None
    wall = dataclasses.replace(
        RECIPE,
        families=("ball",),
        parts=(1, 1),
        empty_share=0.0,
        on_share=1.0,
        near_share=0.0,
        max_dilation=0,
        hollow_share=0.0,
        bumpy_share=0.0,
        center_jitter=0.0,
    )
    for i in range(10):
        thin, _, _ = sample_cube(np.random.default_rng(i), dataclasses.replace(wall, solid_share=0.0))
        full, _, _ = sample_cube(np.random.default_rng(i), dataclasses.replace(wall, solid_share=1.0))
        assert (full >= thin).all()
        assert thin.sum() < 4000 < full.sum()
