import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from unghost.core.cameras import Cameras
from unghost.core.visibility.transmittance import CLEARANCE, TransmittanceMaps

AABB = np.array([[-1.0] * 3, [1.0] * 3])


def looking_along_x(*ys):
    """Cameras at x = -2, one for each y, that look along +x with z up; 90 degrees wide."""
    poses = np.array([[[0.0, 0.0, -1.0, -2.0], [-1.0, 0.0, 0.0, y], [0.0, 1.0, 0.0, 0.0]] for y in ys])
    return Cameras.create(poses.reshape(-1, 3, 4), np.array([32.0, 32.0, 32.0, 24.0]), 64, 48)


def wall(at=0.0, density=100.0, thickness=0.2):
    return lambda points: np.where(np.abs(points[:, 0] - at) < thickness / 2, density, 0.0)


def maps(density_fn, cameras, pitch=0.02):
    return TransmittanceMaps.build(density_fn, cameras, aabb=AABB, field_pitch=pitch)


def test_a_wall_hides_what_is_behind_and_nothing_before():
    built = maps(wall(), looking_along_x(0.0))
    along = np.stack([np.array([-1.5, -0.5, -0.2, 0.3, 0.9]), np.zeros(5), np.zeros(5)], axis=1)
    np.testing.assert_allclose(built.best_view(along), [1, 1, 1, 0, 0], atol=1e-6)


def test_uniform_fog_is_beer_lambert():
    built = maps(lambda points: np.full(len(points), 0.7), looking_along_x(0.0), pitch=0.1)
    points = np.random.default_rng(0).uniform([-0.9, -0.5, -0.3], [0.9, 0.5, 0.3], size=(200, 3))
    distance = np.linalg.norm(points - [-2.0, 0.0, 0.0], axis=1) - CLEARANCE * 0.1
    np.testing.assert_allclose(built.best_view(points), np.exp(-0.7 * distance), rtol=2e-3)


def test_the_best_of_several_counts_and_no_view_is_zero():
    half = lambda points: np.where((points[:, 1] > 0) & (np.abs(points[:, 0] + 0.5) < 0.1), 1e9, 0.0)  # noqa: E731
    point, outside = np.array([[0.5, 0.2, 0.0]]), np.array([[0.5, 0.0, 5.0], [-3.0, 0.0, 0.0]])
    hidden, other, both = (maps(half, looking_along_x(*ys)) for ys in ((0.5,), (-1.2,), (0.5, -1.2)))
    assert hidden.best_view(point) == 0.0
    assert other.best_view(point) == both.best_view(point) > 0.99
    np.testing.assert_array_equal(both.best_view(outside), [0.0, 0.0])
    assert maps(half, looking_along_x()).best_view(point) == 0.0


def test_a_camera_sees_what_is_beside_it_even_in_fog():
    built = maps(lambda points: np.full(len(points), 50.0), looking_along_x(0.0), pitch=0.1)
    assert built.best_view(np.array([[-1.9, 0.0, 0.0]])) == 1.0  # nearer than the clearance


@settings(max_examples=15, deadline=None)
@given(st.floats(0.0, 30.0), st.floats(0.0, 30.0))
def test_more_density_never_lets_more_light_through(first, second):
    low, high = sorted((first, second))
    points = np.random.default_rng(1).uniform(-1, 1, size=(100, 3))
    cameras = looking_along_x(0.0, 0.4)
    dense, thin = (maps(wall(density=density), cameras).best_view(points) for density in (high, low))
    assert (dense <= thin + 1e-6).all()
    assert ((dense >= 0) & (thin <= 1)).all()


def test_shapes_and_lattices():
    built = maps(wall(), looking_along_x(0.0))
    points = np.random.default_rng(2).uniform(-1, 1, size=(2, 4, 4, 4, 3))
    found = built.best_view(points)
    assert found.shape == (2, 4, 4, 4)
    np.testing.assert_array_equal(found.reshape(-1), built.best_view(points.reshape(-1, 3)))
    assert built.best_view(np.zeros((0, 3))).shape == (0,)


def test_tiny_photos_and_huge_densities():
    poses = looking_along_x(0.0).camera_to_world
    small = Cameras.create(poses, np.array([0.5, 0.5, 0.5, 0.5]), 1, 1)
    built = maps(wall(density=1e30), small)
    assert built.through.shape[1:3] == (1, 1)
    assert np.isfinite(built.through).all()
    assert built.best_view(np.array([[0.9, 0.0, 0.0]])) == 0.0


@pytest.mark.parametrize("bad", [np.nan, -1.0])
def test_what_is_no_density_is_refused(bad):
    with pytest.raises(ValueError, match="density must be >= 0"):
        maps(lambda points: np.full(len(points), bad), looking_along_x(0.0))


def test_what_is_no_pitch_is_refused():
    with pytest.raises(ValueError, match="field_pitch"):
        maps(wall(), looking_along_x(0.0), pitch=0.0)
