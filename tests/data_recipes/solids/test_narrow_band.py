import numpy as np
import pytest

from unghost.core.distances import signed as sd
from unghost.core.frames import CubeFrame, random_rotations
from unghost.data_recipes.recipe import Recipe
from unghost.data_recipes.solids.compose import compose_object, shell_from_distance, surface_point
from unghost.data_recipes.solids.narrow_band import shell_in_cube


def twin(distance, frame, thickness, solid):
    """Every voxel asked."""
    values = distance(frame.lattice().reshape(-1, 3)).reshape((32,) * 3)
    shell = shell_from_distance(values.astype(np.float32), thickness=thickness)
    return shell | (values < 0) if solid else shell


def both(distance, frame, thickness=1.0, solid=False):
    def seen(p):
        return distance(p @ (frame.rotation.T * frame.edge_length) + frame.center) / frame.edge_length

    return shell_in_cube(seen, thickness=thickness, solid=solid), twin(distance, frame, thickness, solid)


@pytest.mark.slow
@pytest.mark.parametrize("solid", [False, True])
def test_equals_asking_every_voxel_on_composed_objects(solid):
    voxels = differing = 0
    for seed in range(80):
        rng = np.random.default_rng(seed)
        composed = compose_object(rng, Recipe())
        edge = composed.extent * np.exp(rng.uniform(np.log(0.01), np.log(0.2)))
        center = surface_point(rng, composed)[0] + rng.uniform(-0.5, 0.5, size=3) * edge
        frame = CubeFrame(center, edge, random_rotations(rng, 1)[0])
        found, expected = both(composed.distance, frame, thickness=float(rng.uniform(0.9, 1.15)), solid=solid)
        voxels, differing = voxels + expected.sum(), differing + (found != expected).sum()
    assert voxels > 80 * 500
    assert differing <= 1e-5 * voxels  # sums in another order may decide a tie otherwise


@pytest.mark.parametrize("thickness", [0.3, 1.0, 5.0])
@pytest.mark.parametrize("offset", [0.0, 0.124, 0.49, 0.51])
def test_planes_through_blocks_and_beside_the_cube(thickness, offset):
    frame = CubeFrame(np.zeros(3), 1.0)
    for normal in ((1, 0, 0), (0, -1, 0), (1, 2, -3), (1, 1, 1)):
        found, expected = both(lambda p, n=normal: sd.half_space(p, n, offset), frame, thickness, solid=True)
        np.testing.assert_array_equal(found, expected)


def test_sheets_thinner_than_a_voxel_and_corners():
    frame = CubeFrame(np.array([0.1, 0, 0]), 1.0, random_rotations(np.random.default_rng(0), 1)[0])
    for solid in (
        lambda p: sd.box(p, (0.4, 0.3, 0.001)),
        lambda p: sd.box(p, (0.3, 0.3, 0.3)),
        lambda p: sd.cylinder(p, 0.004, 0.5),
        lambda p: -sd.cone(p, 0.3, 0.5),
    ):
        found, expected = both(solid, frame)
        np.testing.assert_array_equal(found, expected)
        assert found.any()


def test_far_away_is_empty_deep_inside_is_full_and_little_is_asked():
    asked = []

    def distance(p, radius):
        asked.append(len(p))
        return sd.sphere(p, radius)

    assert not shell_in_cube(lambda p: distance(p - 3.0, 1.0), solid=True).any()
    assert not shell_in_cube(lambda p: distance(p, 9.0)).any()
    assert shell_in_cube(lambda p: distance(p, 9.0), solid=True).all()
    assert sum(asked) == 3 * 512
    asked.clear()
    shell_in_cube(lambda p: distance(p, 0.4))
    assert sum(asked) < 0.6 * 32**3


@pytest.mark.parametrize("thickness", [0.0, np.nan, np.inf])
def test_thickness_out_of_range_is_refused(thickness):
    with pytest.raises(ValueError, match="shell_in_cube: thickness must be finite and > 0"):
        shell_in_cube(lambda p: p[:, 0], thickness=thickness)
