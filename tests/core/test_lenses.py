"""Fisheyes, against OpenCV's formula written out; and cameras that differ in size."""

import dataclasses
import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from unghost.core.cameras import Cameras, distort, undistort, warn_if_turned_away
from unghost.core.frames import cube_lattices, random_rotations
from unghost.core.lenses import fisheye_angle, fisheye_radius, widest_angle
from unghost.core.visibility.rectangles import image_rectangles
from unghost.core.visibility.transmittance import TransmittanceMaps
from unghost.core.visibility.view_counts import count_views, frustum_normals, pinholes

WIDE = np.array([0.05, -0.01, 0.002, -0.0005, 0.0, 0.0])  # grows up to 128 degrees
FOLDS = np.array([-0.2, 0.0, 0.0, 0.0, 0.0, 0.0])  # theta (1 - .2 theta^2) turns back at sqrt(1 / .6) = 74 degrees


def fisheye(bend=WIDE, *, pose=None, lens=(24.0, 25.0, 32.0, 30.0), width=64, height=64):
    pose = np.eye(4)[None] if pose is None else pose
    return Cameras.create(pose, np.array(lens), width, height, bend, fisheye=True)


def opencv(point, lens, bend):
    """cv2.fisheye.projectPoints of one point in OpenCV's axes (y down, z ahead), a line of its manual at a time."""
    x, y, z = point
    a, b = x / z, y / z
    r = np.sqrt(a * a + b * b)
    theta = np.arctan(r)
    k1, k2, k3, k4 = bend[:4]
    theta_d = theta * (1 + k1 * theta**2 + k2 * theta**4 + k3 * theta**6 + k4 * theta**8)
    fx, fy, cx, cy = lens
    return fx * theta_d / r * a + cx, fy * theta_d / r * b + cy


def poses(rng, count):
    return np.concatenate([random_rotations(rng, count), rng.uniform(-1, 1, (count, 3, 1))], axis=2)


def test_fisheye_projects_as_opencv():
    rng = np.random.default_rng(0)
    points = rng.uniform([-3, -3, 0.05], [3, 3, 2], (200, 3))
    wanted = [opencv(point, (24.0, 25.0, 32.0, 30.0), WIDE) for point in points]
    pixels, depth, visible = fisheye().project(0, points * [1, -1, -1])
    np.testing.assert_allclose(pixels, wanted, atol=1e-10)
    np.testing.assert_allclose(depth, points[:, 2])
    inside = [0 <= column <= 64 and 0 <= row <= 64 for column, row in wanted]
    assert visible.tolist() == inside
    assert 20 < sum(inside) < 200


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 100_000), bend=st.sampled_from([WIDE, FOLDS, np.zeros(6)]))
def test_fisheye_rays_and_projection_are_inverse(seed, bend):
    rng = np.random.default_rng(seed)
    view = fisheye(bend, pose=poses(rng, 2))
    pixels = np.concatenate([rng.uniform(0, 64, (60, 2)), [[32.0, 30.0]]])
    radius = np.hypot(*((pixels - [32, 30]) / [24, 25]).T)
    pixels = pixels[radius < 0.999 * fisheye_radius(np.array(widest_angle(bend)), bend)]
    origins, directions = view.rays(1, pixels)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1.0)
    found, depth, visible = view.project(1, origins + rng.uniform(0.1, 50, (len(pixels), 1)) * directions)
    np.testing.assert_allclose(found, pixels, atol=1e-6)
    assert visible.all()
    assert np.array_equal(depth > 0, -(directions @ view.camera_to_world[1, :, 2]) > 0)


def test_fisheye_sees_beyond_its_plane_but_not_itself_nor_what_folds():
    """f = 20, k = 0: 100 degrees off the axis lands 34.9 pixels from the middle of 80, 130 degrees 45.4."""
    view = fisheye(np.zeros(6), lens=(20.0, 20.0, 40.0, 40.0), width=80, height=80)
    angle = np.deg2rad([0.0, 100.0, 130.0, 180.0])
    points = np.stack([np.sin(angle), 0 * angle, -np.cos(angle)], axis=1)
    points[3, 0] = 0.0
    pixels, depth, visible = view.project(0, np.concatenate([points, np.zeros((1, 3))]))
    assert visible.tolist() == [True, True, False, False, False]
    assert pixels[1, 0] == pytest.approx(40 + 20 * np.deg2rad(100))
    assert depth[1] == pytest.approx(np.cos(np.deg2rad(100)))
    assert np.isfinite(pixels).all()
    folded = fisheye(FOLDS, lens=(20.0, 20.0, 40.0, 40.0), width=80, height=80)
    assert widest_angle(FOLDS) == pytest.approx(np.sqrt(1 / 0.6))
    assert folded.project(0, points[:1])[2][0]
    for degrees, seen in ((73.0, True), (75.0, False), (100.0, False)):  # all of them would land in the image
        point = np.array([np.sin(np.deg2rad(degrees)), 0.0, -np.cos(np.deg2rad(degrees))])
        assert folded.project(0, point)[2] == seen
    beyond = folded.rays(0, np.array([[0.5, 0.5]]))[1][0]  # outside the image circle: the widest ray there is
    assert np.arccos(-beyond[2]) == pytest.approx(np.sqrt(1 / 0.6))


def test_fisheye_angle_is_the_inverse_up_to_the_fold():
    angle = np.linspace(0, 1.0, 101)
    for bend in (WIDE, FOLDS, np.array([0.3, -0.2, 0.1, 0.05, 0, 0]), np.zeros(6)):
        reach = angle * widest_angle(bend) * 0.999
        np.testing.assert_allclose(fisheye_angle(fisheye_radius(reach, bend), bend), reach, atol=1e-10)
    assert fisheye_angle(np.array([50.0]), FOLDS)[0] == pytest.approx(widest_angle(FOLDS))


@pytest.mark.parametrize(
    ("bend", "reach"),
    [
        ([-0.25, 0.06, 0, 0, 0, 0], 1.3),  # an action camera
        ([-0.3, 0.1, -0.01, 0, 1e-3, -2e-3], 1.2),
        ([0.3, 0.1, 0, 0, 1e-3, 2e-3], 1.0),  # where plain iteration runs away
        ([-0.25, 0, 0, 0, 0, 0], 1.14),  # up to where it folds, at 1.155
    ],
)
def test_wide_lenses_are_undistorted_too(bend, reach):
    bend, angle = np.array(bend, dtype=float), np.linspace(0, 2 * np.pi, 24)[:, None]
    radius = np.linspace(0, reach, 20)
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    np.testing.assert_allclose(undistort(*distort(x, y, bend), bend), [x, y], atol=1e-7)


def test_image_coordinates_that_nothing_reaches_are_finite():
    """r (1 - .25 r^2) is at most .77, at r = 1.155: 40 is the image of nothing within the lens's reach."""
    bend = np.array([-0.25, 0, 0, 0, 0, 0])
    found, _ = undistort(np.array([0.5, 2.0, 40.0]), np.zeros(3), bend)
    assert distort(found[:1], np.zeros(1), bend)[0] == pytest.approx(0.5)
    assert np.isfinite(found).all()
    assert found[2] == pytest.approx(np.sqrt(1 / 0.75))


def test_occlusion_beyond_the_plane():
    """90 to 115 degrees: depth along the axis falls with the distance, and what lies behind is hidden all the same."""
    view = fisheye(np.zeros(6), lens=(20.0, 20.0, 40.0, 40.0), width=80, height=80)
    _, directions = view.rays(0)
    depth = -directions[..., 2] * 2.0  # a sphere of radius 2 about the camera
    assert depth.min() < 0
    along = np.array([directions[40, 2], directions[40, 40], directions[2, 40]])
    assert along[0, 2] > 0
    points = (np.array([1.9, 2.5])[:, None, None] * along).reshape(-1, 3)
    assert view.view_count(points, depth_maps=depth[None]).tolist() == [1, 1, 1, 0, 0, 0]
    nothing = np.where(depth > 0, np.inf, -np.inf)
    assert (view.view_count(points, depth_maps=nothing[None]) == 1).all()


RIGS = {
    "narrow": dict(bend=WIDE, lens=(80.0, 80.0, 32.0, 30.0)),
    "wide": dict(bend=WIDE, lens=(24.0, 25.0, 32.0, 30.0)),
    "circle": dict(bend=FOLDS, lens=(24.0, 25.0, 32.0, 30.0)),
    "all round": dict(bend=np.zeros(6), lens=(10.0, 10.0, 32.0, 32.0)),
    "off": dict(bend=WIDE, lens=(40.0, 40.0, -5.0, 20.0)),
}


@pytest.mark.parametrize("rig", RIGS)
def test_rectangles_hold_what_they_say(rig):
    view = fisheye(**RIGS[rig])
    sure, possible = (each[0] for each in image_rectangles(view))
    rng = np.random.default_rng(4)
    flat = np.tan(rng.uniform(-1.5, 1.5, (20000, 2)))
    seen = view.project(0, np.concatenate([flat * [1, -1], -np.ones((20000, 1))], axis=1))[2]
    inner, outer = (
        (flat[:, 0] >= box[0]) & (flat[:, 0] <= box[1]) & (flat[:, 1] >= box[2]) & (flat[:, 1] <= box[3])
        for box in (sure, possible)
    )
    assert not (inner & ~seen).any()
    assert not (seen & ~outer).any()
    assert inner.sum() > 100 or rig == "off"
    if np.isfinite(possible).all():
        assert (~outer).sum() > 100


@pytest.mark.parametrize("rig", RIGS)
def test_view_counts_of_fisheyes_are_exact(rig):
    rng = np.random.default_rng(5)
    views = fisheye(pose=poses(rng, 6), **RIGS[rig])
    cubes = rng.uniform(-1.5, 1.5, (8, 3)), np.exp(rng.uniform(np.log(0.05), 0, 8)), random_rotations(rng, 8)
    expected = views.view_count(cube_lattices(*cubes))
    np.testing.assert_array_equal(count_views(views, *cubes), expected)
    assert pinholes(views) is views
    with pytest.raises(ValueError, match="be no fisheyes"):
        frustum_normals(views)
    assert 0 < expected.mean() < 6 or rig == "all round"


def mixed(rng, count=9):
    """Portrait, landscape and a fisheye of another size."""
    kind = np.arange(count) % 3
    width, height = np.choose(kind, [40, 30, 50]), np.choose(kind, [30, 40, 50])
    lens = np.stack([np.full(count, 30.0), np.full(count, 30.0), width / 2, height / 2], axis=1)
    bend = np.where((kind == 1)[:, None], [0.05, -0.02, 0, 0, 1e-3, 0], 0.0)
    return Cameras.create(poses(rng, count), lens, width, height, bend, kind == 2)


def one_by_one(cameras):
    """The same cameras as rigs of one, each with its own size as two numbers."""
    for k in range(len(cameras)):
        width, height = cameras.size(k)
        lens = cameras.intrinsics[k], width, height, cameras.distortion[k], cameras.fisheye[k]
        yield Cameras.create(cameras.camera_to_world[[k]], *lens)


def test_sizes_of_cameras_that_differ():
    views = mixed(np.random.default_rng(0))
    assert not views.same_size
    assert views.size(1) == (30, 40)
    assert [group.tolist() for group in views.by_size()] == [[0, 3, 6], [1, 4, 7], [2, 5, 8]]
    with pytest.raises(ValueError, match=r"Cameras.width: .*40 x 30: 3 cameras, 30 x 40: 3 .*by_size"):
        _ = views.width
    with pytest.raises(ValueError, match=r"Cameras.height"):
        _ = views.height
    assert [(part.width, part.height) for part in map(views.select, views.by_size())] == [(40, 30), (30, 40), (50, 50)]
    assert views.resized(0.5).sizes.tolist() == (views.sizes // 2).tolist()
    assert views.rays(1)[1].shape == (40, 30, 3)
    again = pickle.loads(pickle.dumps(views))
    assert (again.sizes == views.sizes).all()
    assert not again.same_size
    moved = dataclasses.replace(views, camera_to_world=views.camera_to_world[::-1])
    assert (moved.sizes == views.sizes).all()
    assert (moved.fisheye == views.fisheye).all()
    assert (moved.origins == views.origins[::-1]).all()
    assert dataclasses.replace(views, width=7, height=5).width == 7
    with pytest.raises(ValueError, match="width and height must be given"):
        Cameras(views.camera_to_world, views.intrinsics)
    none = Cameras.create(np.zeros((0, 3, 4)), np.ones(4), 7, 5)
    assert (none.width, none.height, none.by_size()) == (7, 5, [])
    with pytest.raises(ValueError, match="there are none"):
        _ = views.select([]).width


def test_everything_about_mixed_cameras_is_as_for_each_alone():
    rng = np.random.default_rng(6)
    views = mixed(rng)
    points = rng.uniform(-2, 2, (3000, 3))
    alone = np.stack([each.project(0, points)[2] for each in one_by_one(views)])
    assert (alone.mean(axis=1) > 0.01).all()
    np.testing.assert_array_equal(views.view_count(points), alone.sum(axis=0))
    index = rng.integers(len(views), size=len(points))
    np.testing.assert_array_equal(views.sees(index, points), alone[index, np.arange(len(points))])
    for k, each in enumerate(one_by_one(views)):
        np.testing.assert_array_equal(views.rays(k)[1], each.rays(0)[1])
    cubes = rng.uniform(-1, 1, (5, 3)), rng.uniform(0.05, 1.0, 5), random_rotations(rng, 5)
    apart = sum(count_views(each, *cubes).astype(int) for each in one_by_one(views))
    np.testing.assert_array_equal(count_views(views, *cubes), apart)
    straight = pinholes(views)
    assert straight.flat_sided.tolist() == (~views.fisheye).tolist()
    assert (straight.sizes == views.sizes).all()


def test_occlusion_with_maps_of_different_sizes():
    rng = np.random.default_rng(7)
    views = mixed(rng, 4)
    depth = [np.abs(rng.normal(size=(height, width))) for width, height in views.sizes]
    points = rng.uniform(-2, 2, (500, 3))
    apart = [each.view_count(points, depth_maps=[depth[k]]) for k, each in enumerate(one_by_one(views))]
    np.testing.assert_array_equal(views.view_count(points, depth_maps=depth), sum(apart))
    assert (views.view_count(points) > sum(apart)).any()


def test_transmittance_of_mixed_cameras():
    """A wall hides what lies behind it from every camera, whatever its size and lens."""
    pose = np.repeat(np.eye(4)[None, :3], 3, axis=0)
    width, height = np.array([40, 30, 200]), np.array([30, 40, 150])
    lens = np.stack([width / 2, width / 2, width / 2, height / 2], axis=1)
    views = Cameras.create(pose, lens, width, height, None, [False, False, True])

    def wall(positions):
        return np.where(np.abs(positions[:, 2] + 1.5) < 0.1, 50.0, 0.0)

    box = np.array([[-1.0, -1.0, -3.0], [1.0, 1.0, -1.0]])
    maps = TransmittanceMaps.build(wall, views, aabb=box, field_pitch=0.05)
    assert maps.columns.shape == (3, 32)
    for index in range(3):
        one = TransmittanceMaps.build(wall, views.select(index), aabb=box, field_pitch=0.05)
        for each in (maps, one):
            before, behind = each.best_view(np.array([[0.2, 0.1, -1.2], [0.2, 0.1, -2.0]]))
            assert before > 0.99
            assert behind < 0.01


def test_turned_away_fisheyes_are_noticed():
    away = fisheye(pose=np.eye(4)[None] * [1, 1, 1, 1], lens=(60.0, 60.0, 32.0, 32.0))
    with pytest.warns(UserWarning, match="axes"):
        warn_if_turned_away(away, np.array([[-0.5, -0.5, 1.0], [0.5, 0.5, 2.0]]), caller="me")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (dict(width=[4, 4, 4]), r"numbers or have shape \(2,\), got \(3,\) and \(\)"),
        (dict(width=[4, 0]), "must be >= 1"),
        (dict(fisheye=True, distortion=np.array([0, 0, 0, 0, 1e-3, 0])), "p1 = p2 = 0"),
    ],
)
def test_impossible_sizes_and_fisheyes_are_refused(changes, words):
    pose = np.repeat(np.eye(4)[None], 2, axis=0)
    with pytest.raises(ValueError, match=words):
        Cameras.create(pose, **{"intrinsics": np.ones(4), "width": 4, "height": 4, **changes})
