import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from unghost.core.cameras import Cameras
from unghost.core.frames import cube_lattices, random_rotations
from unghost.core.visibility.view_counts import count_views, frustum_normals, pinholes


def random_cameras(rng, count, *, distortion=None):
    poses = np.concatenate([random_rotations(rng, count), rng.uniform(-1, 1, size=(count, 3, 1))], axis=2)
    focal = rng.uniform(12, 60, size=(count, 2))
    middle = rng.uniform([15, 10], [25, 20], size=(count, 2))
    return Cameras.create(poses, np.concatenate([focal, middle], axis=1), 40, 30, distortion)


def random_cubes(rng, count):
    edges = np.exp(rng.uniform(np.log(0.05), np.log(3.0), size=count))
    return rng.uniform(-1, 1, size=(count, 3)), edges, random_rotations(rng, count)


def count_one_by_one(cameras, points):
    """A camera and a point at a time, by the definition of a pixel."""
    counts = np.zeros(len(points), dtype=int)
    for index, point in enumerate(points):
        for pose, (fx, fy, cx, cy) in zip(cameras.camera_to_world, cameras.intrinsics):
            x, y, z = pose[:, :3].T @ (point - pose[:, 3])
            if z < 0:
                column, row = fx * x / -z + cx, fy * y / z + cy
                counts[index] += 0 <= column <= cameras.width and 0 <= row <= cameras.height
    return counts


@pytest.mark.parametrize("seed", range(3))
def test_view_counts_equal_a_loop(seed):
    rng = np.random.default_rng(seed)
    cameras, frames = random_cameras(rng, 7), random_cubes(rng, 6)
    counts = count_views(cameras, *frames)
    assert counts.dtype == np.uint8
    assert counts.shape == (6, 32, 32, 32)
    lattice = cube_lattices(*frames)
    chosen = rng.integers(32, size=(40, 3))
    for index in range(6):
        some = tuple(chosen.T)
        np.testing.assert_array_equal(counts[index][some], count_one_by_one(cameras, lattice[index][some]))


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=15, deadline=None)
def test_view_counts_equal_the_convention(seed):
    rng = np.random.default_rng(seed)
    cameras, frames = random_cameras(rng, 5), random_cubes(rng, 3)
    expected = cameras.view_count(cube_lattices(*frames))
    assert (count_views(cameras, *frames) != expected).sum() <= 2  # within rounding of a side
    cube = np.array([[0.0, 0.0, 0.0]]), np.array([1e-3]), np.eye(3)[None]  # at the centre of its own camera
    cameras = Cameras.create(np.eye(4)[None], np.array([20.0, 20.0, 20.0, 15.0]), 40, 30)
    half = count_views(cameras, *cube)[0]
    assert not half[:, :, 16:].any()  # behind: +z
    assert half[14:18, 14:18, 0].all()


def test_view_counts_with_distortion_and_many_cameras():
    rng = np.random.default_rng(3)
    bent = random_cameras(rng, 3, distortion=np.array([-0.1, 0.02, 0.0, 0.0, 1e-3, 0.0]))
    frames = random_cubes(rng, 2)
    np.testing.assert_array_equal(count_views(bent, *frames), bent.view_count(cube_lattices(*frames)))
    with pytest.raises(ValueError, match="frustum_normals: cameras must have no distortion"):
        frustum_normals(bent)
    poses = np.repeat(np.eye(4)[None], 300, axis=0)
    crowd = Cameras.create(poses, np.array([20.0, 20.0, 20.0, 15.0]), 40, 30)
    ahead = np.array([[0.0, 0.0, -0.9]]), np.array([0.1]), np.eye(3)[None]
    assert (count_views(crowd, *ahead) == 255).all()
    assert count_views(crowd, np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3, 3))).shape == (0, 32, 32, 32)


def test_straightened_borders_lie_where_they_did_on_average():
    """A lens with radial distortion alone, by hand: the middle of the left border is at the smallest radius of all."""
    bend = np.array([0.05, 0.0, 0.0, 0.0, 0.0, 0.0])
    bent = Cameras.create(np.eye(4)[None], np.array([100.0, 100.0, 100.0, 75.0]), 200, 150, bend)
    straight = pinholes(bent)
    assert not straight.distortion.any()
    left = straight.intrinsics[0, 2] / straight.intrinsics[0, 0]  # tangent of the angle to the left border
    # a point at tangent r lands at r (1 + .05 r^2): on the border's middle r = .9554, in its corner .9361
    middle, corner = (-pinhole_x(bent, (0.0, row)) for row in (75.0, 0.0))
    assert middle == pytest.approx(0.9554, abs=1e-3)
    assert corner < left < middle
    assert pinholes(straight) is straight


def pinhole_x(cameras, pixel):
    _, direction = cameras.rays(0, np.array([pixel]))
    return direction[0, 0] / -direction[0, 2]


def test_straightened_borders_hardly_change_a_phones_counts():
    rng = np.random.default_rng(0)
    bend = np.array([0.08, -0.12, 0.0, 0.0, 5e-4, -5e-4])
    bent, frames = random_cameras(rng, 12, distortion=bend), random_cubes(rng, 4)
    assert pinholes(bent) is bent  # some of these are as wide as no phone, and fold back
    bent = Cameras.create(bent.camera_to_world, np.array([34.0, 34.0, 20.0, 15.0]), 40, 30, bend)
    exact, quick = count_views(bent, *frames).astype(int), count_views(pinholes(bent), *frames).astype(int)
    assert (exact > 0).mean() > 0.2
    assert (exact != quick).mean() < 0.08
    assert np.abs(exact - quick).max() <= 2
