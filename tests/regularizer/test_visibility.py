import time
import tracemalloc

import numpy as np
import pytest

from unghost.core.cameras import Cameras
from unghost.core.frames import random_rotations
from unghost.regularizer.view_grid import OPEN, ViewGrid, image_rectangles
from unghost.regularizer.visibility import (
    SAMPLES_PER_RAY,
    ViewCounter,
    camera_sphere,
    grow_box,
    ray_points,
    visibility_points,
)

BOX = np.array([[-1.0, -1.0, -1.0], [1.0, 2.0, 1.0]])


def cameras(count=24, seed=0):
    rng = np.random.default_rng(seed)
    poses = np.concatenate([random_rotations(rng, count), rng.uniform(-0.5, 0.5, (count, 3, 1))], axis=2)
    return Cameras.create(poses, np.array([300.0, 310, 200, 150]), 400, 300, np.array([0.05, -0.02, 0, 0, 1e-3, 0]))


@pytest.mark.parametrize("min_views", [1, 2, 5])
def test_counter_agrees_with_the_full_count(min_views):
    rig = cameras()
    counter = ViewCounter(rig, min_views=min_views)
    for seed in range(3):  # its order of cameras changes between calls; its answers must not
        points = np.random.default_rng(seed).uniform(-2, 2, (2000, 3))
        full = rig.view_count(points)
        counts = counter(points)
        assert ((counts < min_views) == (full < min_views)).all()
        assert (counts <= full).all()
        assert 0 < (full < min_views).mean() < 1


LENSES = {
    "pinhole": np.zeros(6),
    "phone": np.array([0.05, -0.02, 0, 0, 1e-3, 0]),
    "barrel": np.array([-0.12, 0.02, 0, 0, 0, 0]),
    "folding": np.array([-0.9, 0, 0, 0, 0, 0]),  # no border to undistort: every point is left to the exact test
}


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("min_views", [1, 2, 5])
def test_cells_settle_nothing_wrongly(lens, min_views):
    plain = cameras()
    rig = Cameras.create(plain.camera_to_world, plain.intrinsics, plain.width, plain.height, LENSES[lens])
    rng = np.random.default_rng(1)
    points = np.concatenate(
        [
            rng.uniform(BOX[0], BOX[1], (4000, 3)),
            rng.uniform(-3, 3, (1000, 3)),
            rig.origins,
            BOX,
            rig.origins - 1e-7,
            np.full((1, 3), 1e30),
        ]
    )
    full = rig.view_count(points)
    for counter in (ViewCounter(rig, min_views=min_views), ViewCounter(rig, min_views=min_views, aabb=BOX)):
        np.testing.assert_array_equal(np.minimum(counter(points), min_views), np.minimum(full, min_views))
    assert ViewCounter(rig, aabb=BOX)(np.zeros((0, 3))).shape == (0,)


FISHEYES = {
    "narrow": (400.0, np.array([0.05, -0.01, 0.002, 0, 0, 0])),
    "wide": (140.0, np.array([0.05, -0.01, 0.002, 0, 0, 0])),
    "circle": (140.0, np.array([-0.2, 0, 0, 0, 0, 0])),  # nothing beyond 74 degrees
    "beyond the plane": (80.0, np.zeros(6)),
}


@pytest.mark.parametrize("lens", FISHEYES)
@pytest.mark.parametrize("min_views", [1, 4])
def test_cells_of_fisheyes_and_of_other_sizes_settle_nothing_wrongly(lens, min_views):
    focal, bend = FISHEYES[lens]
    plain, round_ = cameras(), np.arange(24) % 2 == 0
    intrinsics = np.where(round_[:, None], [focal, focal, 200.0, 150.0], [300.0, 310.0, 100.0, 150.0])
    width = np.where(round_, 400, 200)
    rig = Cameras.create(plain.camera_to_world, intrinsics, width, 300, np.where(round_[:, None], bend, 0), round_)
    rng = np.random.default_rng(1)
    points = np.concatenate([rng.uniform(BOX[0], BOX[1], (4000, 3)), rng.uniform(-3, 3, (1000, 3)), rig.origins, BOX])
    full = np.minimum(rig.view_count(points), min_views)
    for counter in (ViewCounter(rig, min_views=min_views), ViewCounter(rig, min_views=min_views, aabb=BOX)):
        np.testing.assert_array_equal(np.minimum(counter(points), min_views), full)
    cells = ViewGrid(rig, BOX, min_views=min_views).cells
    assert (cells == OPEN).mean() < 0.9  # not all is left to the exact test


def test_occlusion_of_cameras_that_differ_in_size():
    plain = cameras(4)
    width = np.array([400, 200, 400, 200])
    rig = Cameras.create(plain.camera_to_world, plain.intrinsics, width, 300)
    rng = np.random.default_rng(3)
    depth = [rng.uniform(0.2, 2.0, (300, each)) for each in width]
    points = rng.uniform(BOX[0], BOX[1], (2000, 3))
    full = rig.view_count(points, depth_maps=depth)
    np.testing.assert_array_equal(ViewCounter(rig, min_views=9, depth_maps=depth)(points), full)
    with pytest.raises(ValueError, match="for each of the 4 cameras, got 3; the first that differs is number 3"):
        ViewCounter(rig, depth_maps=depth[:3])
    with pytest.raises(ValueError, match="got 4; the first that differs is number 1"):
        ViewCounter(rig, depth_maps=[depth[0]] * 4)


@pytest.mark.parametrize("levels", [1, 2, 4])
def test_cells_of_any_size_give_the_same_counts(levels):
    rig, points = cameras(), np.random.default_rng(8).uniform(BOX[0], BOX[1], (3000, 3))
    grid = ViewGrid(rig, BOX, min_views=2, levels=levels)
    assert grid.cells.shape == (4 << levels,) * 3
    np.testing.assert_array_equal(grid.count(points), np.minimum(rig.view_count(points), 2))
    found, inside = grid.look_up(points)
    assert inside.all()
    assert (found[found != OPEN] == grid.count(points)[found != OPEN]).all()


def test_most_of_a_box_is_settled_beforehand():
    grid = ViewGrid(cameras(), BOX, min_views=1)
    assert (grid.cells == OPEN).mean() < 0.5
    assert set(np.unique(grid.cells)) == {OPEN, 0, 1}


def test_single_pairs_are_seen_as_whole_cameras_see():
    rig = cameras()
    points = np.random.default_rng(2).uniform(-2, 2, (500, 3))
    index = np.arange(500) % len(rig)
    wanted = [bool(rig.project(camera, point)[2]) for camera, point in zip(index, points)]
    assert rig.sees(index, points).tolist() == wanted
    assert 20 < sum(wanted) < 480


@pytest.mark.parametrize("boxed", [False, True])
def test_what_something_hides_is_not_seen(boxed):
    rig = cameras(6)
    rng = np.random.default_rng(3)
    depth = rng.uniform(0.2, 2.0, (6, rig.height, rig.width))
    depth[rng.random(depth.shape) < 0.2] = np.inf
    points = rng.uniform(BOX[0], BOX[1], (3000, 3))
    counter = ViewCounter(rig, min_views=2, aabb=BOX if boxed else None, depth_maps=depth, tolerance=0.1)
    full = rig.view_count(points, depth_maps=depth, tolerance=0.1)
    np.testing.assert_array_equal(np.minimum(counter(points), 2), np.minimum(full, 2))
    assert (full < rig.view_count(points)).mean() > 0.1
    with pytest.raises(ValueError, match=r"depth_maps must have shape \(6, 300, 400\), got \(5, 300, 400\)"):
        ViewCounter(rig, depth_maps=depth[:5])


def test_zeros_of_both_signs_are_one_lens():
    plain = cameras(2)
    bend = np.zeros((2, 6))
    bend[1, 0] = -0.0
    rig = Cameras.create(plain.camera_to_world, plain.intrinsics, plain.width, plain.height, bend)
    assert rig.sees(np.array([0, 1]), np.zeros((2, 3))).shape == (2,)


def test_a_lens_that_may_fold_is_left_to_the_exact_test():
    plain = cameras(2)
    wild = np.array([-0.34, 0.223, -0.0207, -0.0572, 0.2349, 0.0234])
    sure, possible = image_rectangles(Cameras.create(plain.camera_to_world, plain.intrinsics, 400, 300, wild))
    assert np.isnan(sure).all()
    assert np.isinf(possible).all()


def test_counter_is_quick():
    rig = cameras()
    counter = ViewCounter(rig)
    points = visibility_points(np.random.default_rng(0), 8192, aabb=BOX, cameras=rig)
    seconds = []
    for _ in range(5):
        start = time.perf_counter()
        counter(points)
        seconds.append(time.perf_counter() - start)
    assert min(seconds) < 0.05  # the goal is 0.02 on a quiet core


def test_points_on_the_camera_plane_and_behind_are_unseen():
    rig = Cameras.create(np.eye(4)[None], np.array([100.0, 100, 50, 50]), 100, 100)
    points = np.array([[0, 0, -1.0], [0, 0, 0], [0.3, 0, 0], [0, 0, 1.0], [0, 0, -1e-300], [0, 0, -1e30]])
    assert ViewCounter(rig)(points).tolist() == [1, 0, 0, 0, 1, 1]


@pytest.mark.parametrize("kind", ["mixed", "rays", "uniform"])
def test_points_stay_in_the_box_and_are_repeatable(kind):
    rig = cameras()
    points = visibility_points(np.random.default_rng(3), 501, aabb=BOX, cameras=rig, kind=kind)
    assert points.shape == (501, 3)
    assert ((points >= BOX[0]) & (points <= BOX[1])).all()
    again = visibility_points(np.random.default_rng(3), 501, aabb=BOX, cameras=rig, kind=kind)
    assert (points == again).all()


def test_rays_lie_on_lines_from_the_sphere_through_the_middle():
    rig = cameras()
    points = ray_points(np.random.default_rng(0), 64, cameras=rig, aabb=BOX).reshape(2, 32, 3)
    for line in points:
        spread = np.linalg.svd(line - line.mean(axis=0), compute_uv=False)
        assert spread[1] < 1e-6 * spread[0]
        direction = (line[1] - line[0]) / np.linalg.norm(line[1] - line[0])
        offset = BOX.mean(axis=0) - line[0]
        miss = np.linalg.norm(offset - (offset @ direction) * direction)
        assert miss <= np.linalg.norm(BOX[1] - BOX[0]) / 4 + 1e-6
    middle, radius = camera_sphere(rig)
    assert (np.linalg.norm(rig.origins - middle, axis=1) <= radius + 1e-12).all()


def test_rays_go_through_the_scene_and_out_again():
    rig = cameras(1)
    points = ray_points(np.random.default_rng(0), 64000, cameras=rig, aabb=BOX).reshape(-1, SAMPLES_PER_RAY, 3)
    along = BOX.mean(axis=0) - rig.origins[0]
    depth = (points - rig.origins[0]) @ along / (along @ along)  # 1 in the plane of the box's middle
    enter, leave = depth.min(axis=1), depth.max(axis=1)
    corners = (np.stack(np.meshgrid(*BOX.T, indexing="ij"), axis=-1) - rig.origins[0]) @ along / (along @ along)
    assert leave.max() > 1 + 0.6 * (corners.max() - 1)
    assert np.median(leave) > 1.1
    assert enter.min() < 1 - 0.5 * min(1.0, 1 - corners.min())


def test_one_camera_is_a_sphere_of_no_radius():
    rig = cameras(1)
    points = visibility_points(np.random.default_rng(0), 100, aabb=BOX, cameras=rig)
    assert np.isfinite(points).all()


def test_errors():
    rig = cameras(2)
    with pytest.raises(ValueError, match="kind must be one of"):
        visibility_points(np.random.default_rng(0), 1, aabb=BOX, cameras=rig, kind="all")
    with pytest.raises(ValueError, match="reach"):
        grow_box(BOX, 0.5)
    with pytest.raises(ValueError, match="must not be empty"):
        visibility_points(np.random.default_rng(0), 1, aabb=BOX, cameras=rig.select(slice(0, 0)))
    with pytest.raises(ValueError, match="min_views"):
        ViewCounter(rig, min_views=0)
    with pytest.raises(ValueError, match=r"shape \(N, 3\)"):
        ViewCounter(rig)(np.zeros(3))


@pytest.mark.slow
def test_memory_does_not_grow_with_the_cameras():
    points = np.random.default_rng(5).uniform(BOX[0], BOX[1], (20_000, 3))
    most = []
    for count in (50, 2000):
        rig = cameras(count)
        tracemalloc.start()
        ViewCounter(rig, min_views=count, aabb=BOX)(points)  # nobody drops out
        most.append(tracemalloc.get_traced_memory()[1] / 1e6)
        tracemalloc.stop()
    assert most[1] < most[0] + 40  # megabytes; all the cameras' answers at once would take 130 more
