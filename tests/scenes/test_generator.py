import numpy as np
import pytest

from unghost.core.cameras import Cameras, look_at
from unghost.scenes.furniture import FURNITURE, random_shape, random_texture
from unghost.scenes.generator import _small_rotations, photograph, photograph_again, random_scene, sweep
from unghost.scenes.solids import PATTERNS, Solid, SolidScene


def furnished(seed):
    """A scene and a sweep through it; the next seed where the first has no free path."""
    for attempt in range(seed, seed + 50):
        rng = np.random.default_rng(attempt)
        scene = random_scene(rng)
        try:
            return scene, sweep(rng, scene, 12)
        except RuntimeError:
            continue
    raise AssertionError("fifty scenes without a free path")


@pytest.mark.parametrize("seed", [0, 100, 200, 300])
def test_sweeps_stay_in_free_space_and_in_the_box(seed):
    scene, poses = furnished(seed)
    assert poses.shape == (12, 3, 4)
    origins = poses[:, :, 3]
    assert np.abs(origins).max() <= 1.0
    assert np.min([solid.distance(origins) for solid in scene.solids]) > 0.0
    assert scene.signed_distance(origins).min() > 0.08
    rotation = poses[:, :, :3]
    np.testing.assert_allclose(rotation @ rotation.swapaxes(1, 2), np.broadcast_to(np.eye(3), (12, 3, 3)), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(rotation), 1.0)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 4, 9])  # rooms and open floors
def test_traced_points_lie_on_surfaces(seed):
    scene, poses = furnished(seed)
    cameras = Cameras.create(poses, np.array([30.0, 30.0, 20.0, 15.0]), 40, 30)
    for index in (0, 6):
        origins, directions = (ray.reshape(-1, 3) for ray in cameras.rays(index))
        distance = scene.trace(origins, directions)
        hit = np.isfinite(distance)
        assert hit.mean() > 0.3
        gap = np.abs(scene.signed_distance(origins[hit] + distance[hit, None] * directions[hit]))
        assert gap[distance[hit] < 4.0].max() < 2e-3
        assert (gap < 1e-2 + 4e-3 * distance[hit]).all()
        # and nothing solid comes before
        for share in (0.25, 0.5, 0.75, 0.9):
            assert scene.signed_distance(origins[hit] + share * distance[hit, None] * directions[hit]).min() > -1e-6


def test_no_path_through_a_solid_block_is_an_error():
    rng = np.random.default_rng(0)
    block = SolidScene([Solid("box", (np.full(3, 2.0),), np.zeros(3), random_texture(rng), 3.5)], [])
    with pytest.raises(RuntimeError, match="no free path"):
        sweep(rng, block, 5)


def test_look_at_looks_at_its_target_with_up_up():
    rng = np.random.default_rng(1)
    origins, targets = rng.uniform(-1, 1, (20, 3)), rng.uniform(-1, 1, (20, 3))
    kept = origins.copy(), targets.copy()
    poses = look_at(origins, targets)
    cameras = Cameras.create(poses, np.array([50.0, 50.0, 32.0, 24.0]), 64, 48)
    for index in range(20):
        pixel, depth, visible = cameras.project(index, targets[index])
        np.testing.assert_allclose(pixel, [32.0, 24.0], atol=1e-6)
        np.testing.assert_allclose(depth, np.linalg.norm(targets[index] - origins[index]))
        assert visible
        above, _, _ = cameras.project(index, targets[index] + [0.0, 0.0, 1e-3])
        assert above[1] < 24.0
    np.testing.assert_array_equal(origins, kept[0])
    np.testing.assert_array_equal(targets, kept[1])


def test_look_at_straight_down_is_a_rotation():
    poses = look_at(np.array([[0.0, 0.0, 2.0], [1.0, 0.0, -2.0]]), np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]))
    np.testing.assert_allclose(np.linalg.det(poses[:, :, :3]), 1.0)
    np.testing.assert_allclose(poses[:, :, 0], [[1, 0, 0], [1, 0, 0]])
    np.testing.assert_allclose(-poses[:, :, 2], [[0, 0, -1], [0, 0, 1]])


def test_photographs_depend_on_the_generator_alone():
    scene, _ = furnished(0)
    first, again, other = (
        photograph(np.random.default_rng(seed), scene, count=3, width=16, height=12) for seed in (5, 5, 6)
    )
    for name in ("images", "depth_maps"):
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name))
    np.testing.assert_array_equal(first.cameras.camera_to_world, again.cameras.camera_to_world)
    assert not np.array_equal(first.images, other.images)


def test_what_a_photograph_holds():
    scene, _ = furnished(0)
    taken = photograph(np.random.default_rng(5), scene, count=3, width=16, height=12)
    assert taken.images.shape == (3, 12, 16, 3)
    assert taken.images.dtype == np.float32
    assert taken.images.min() >= 0.0
    assert taken.images.max() <= 1.0
    assert np.ptp(taken.images) > 0.1
    # the cameras told are near the true ones, but not the same
    moved = taken.cameras.origins - taken.true_cameras.origins
    assert 0.0 < np.abs(moved).max() < 0.05
    turned = taken.cameras.camera_to_world[:, :, :3] @ taken.true_cameras.camera_to_world[:, :, :3].swapaxes(1, 2)
    angle = np.arccos(np.clip((np.trace(turned, axis1=1, axis2=2) - 1) / 2, -1, 1))
    assert 0.0 < np.rad2deg(angle).max() < 2.0
    # a depth map holds the depth along the optical axis of what the true cameras see
    for index in range(3):
        origins, directions = taken.true_cameras.rays(index)
        forward = -taken.true_cameras.camera_to_world[index, :, 2]
        points = origins + (taken.depth_maps[index] / (directions @ forward))[..., None] * directions
        hit = np.isfinite(taken.depth_maps[index]) & (taken.depth_maps[index] < 3.0)
        assert np.abs(scene.signed_distance(points[hit])).max() < 2e-3
        _, depth, _ = taken.true_cameras.project(index, points[hit])
        np.testing.assert_allclose(depth, taken.depth_maps[index][hit])


def test_random_scenes_repeat_and_differ():
    points = np.random.default_rng(0).uniform(-1, 1, size=(300, 3))
    first, again, other = (random_scene(np.random.default_rng(seed)).signed_distance(points) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert not np.allclose(first, other)


@pytest.mark.parametrize(
    "maker", sorted(set(FURNITURE), key=lambda maker: maker.__name__), ids=lambda maker: maker.__name__
)
def test_bounding_balls_hold_their_solids(maker):
    points = np.random.default_rng(0).uniform(-1, 1, size=(4000, 3)) * np.array([1.5, 1.5, 2.0])
    for seed in range(15):
        solids = maker(np.random.default_rng(seed), np.array([0.1, -0.2, -0.5]), 0.6)
        assert solids
        for solid in solids:
            inside = points[solid.distance(points) < 0]
            assert (np.linalg.norm(inside - solid.center, axis=1) <= solid.bound + 1e-9).all()


def test_bounding_balls_of_single_shapes_hold_them():
    seen = set()
    points = np.random.default_rng(0).uniform(-3, 3, size=(20_000, 3))
    for seed in range(80):
        solid = random_shape(np.random.default_rng(seed), np.zeros(3), 1.0, np.eye(3))
        inside = points[solid.distance(points) < 0]
        assert (np.linalg.norm(inside, axis=1) <= solid.bound + 1e-9).all()
        seen.add(solid.shape)
    assert len(seen) >= 8


def test_random_textures_are_valid_and_plainness_is_plain():
    gaps = {}
    for plainness in (0.0, 1.0):
        textures = [random_texture(np.random.default_rng(seed), plainness=plainness) for seed in range(60)]
        assert all(texture.pattern in PATTERNS for texture in textures)
        assert all(0 <= min(t.first.min(), t.second.min()) <= max(t.first.max(), t.second.max()) <= 1 for t in textures)
        gaps[plainness] = np.mean([np.abs(texture.first - texture.second).mean() for texture in textures])
    assert gaps[1.0] < 0.3 * gaps[0.0]


def test_small_rotations():
    quarter = _small_rotations(np.array([[0.0, 0.0, np.pi / 2], [0.0, 0.0, 0.0]]))
    np.testing.assert_allclose(quarter[0], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)
    np.testing.assert_array_equal(quarter[1], np.eye(3))


def test_a_second_sweep_has_the_same_lens_and_look_and_no_faults():
    rng = np.random.default_rng(5)
    first = photograph(rng, random_scene(rng), count=3, width=16, height=12)
    again = photograph_again(np.random.default_rng(6), first, count=4)
    assert len(again.cameras) == len(again.images) == 4
    np.testing.assert_array_equal(again.cameras.intrinsics[0], first.true_cameras.intrinsics[0])
    assert again.look == first.look
    assert again.cameras is again.true_cameras
    repeated = photograph_again(np.random.default_rng(6), first, count=4)
    np.testing.assert_array_equal(again.images, repeated.images)
    # depth along the axis, back to the surface
    origins, directions = (ray.reshape(-1, 3) for ray in again.cameras.rays(1))
    axial = again.depth_maps[1].reshape(-1)
    hit = np.isfinite(axial)
    reach = axial[hit] / -(directions[hit] @ again.cameras.camera_to_world[1, :, 2])
    assert np.abs(first.scene.signed_distance(origins[hit] + reach[:, None] * directions[hit])).max() < 0.02
