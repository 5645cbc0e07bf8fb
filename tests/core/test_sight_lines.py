import dataclasses

import numpy as np
import pytest

from unghost.core.cameras import Cameras, look_at
from unghost.core.sight_lines import REACH, SightLines
from unghost.core.sparse_points import SparsePoints

BOX = np.array([[-1.0, -1.2, -0.8], [1.1, 1.0, 0.9]])


def rig(count=6, radius=2.5, seed=0):
    rng = np.random.default_rng(seed)
    origins = rng.normal(size=(count, 3))
    origins *= radius / np.linalg.norm(origins, axis=1, keepdims=True)
    return Cameras.create(look_at(origins, np.zeros((count, 3))), np.array([80.0, 80.0, 64.0, 48.0]), 128, 96)


def observed(xyz, cameras, every=1, **options):
    """Each point, observed by every camera."""
    pairs = np.stack(np.meshgrid(np.arange(len(xyz)), np.arange(0, len(cameras), every), indexing="ij"), -1)
    point, camera = pairs.reshape(-1, 2).T
    return SparsePoints.create(xyz, point=point, camera=camera, cameras=cameras, **options)


def cells_of(lines):
    shape = lines.crossing_count.shape
    origin = lines.aabb.mean(axis=0) - np.array(shape) * lines.pitch / 2
    return origin + np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1) * lines.pitch  # lowest corners


def counted_slowly(lines):
    """Segment by segment, cell by cell: the slabs of the cell's three axes must overlap over a positive length."""
    low = cells_of(lines)
    total = np.zeros(low.shape[:3], dtype=int)
    for start, end in zip(lines.starts, lines.ends):
        along = end - start
        first, second = (low - start) / along, (low + lines.pitch - start) / along
        enter = np.maximum(np.minimum(first, second).max(axis=-1), 0.0)
        leave = np.minimum(np.maximum(first, second).min(axis=-1), 1.0)
        total += leave > enter
    return total


@pytest.mark.slow
@pytest.mark.parametrize("pitch", [0.07, 0.31, 3.0])
def test_counts_are_those_of_the_slow_twin(pitch):
    cameras = rig()
    xyz = np.random.default_rng(1).uniform(-1.5, 1.5, size=(40, 3))  # some beyond the box
    lines = SightLines.build(observed(xyz, cameras), cameras, aabb=BOX, pitch=pitch, margin_cells=0.2, robust=False)
    assert len(lines) > 100
    np.testing.assert_array_equal(lines.crossing_count, counted_slowly(lines))


def test_support_is_a_sum_of_tents():
    cameras = rig()
    xyz = np.random.default_rng(2).uniform(-1.2, 1.2, size=(30, 3))
    lines = SightLines.build(observed(xyz, cameras), cameras, aabb=BOX, pitch=0.11)
    centers = cells_of(lines) + lines.pitch / 2
    tents = np.maximum(0.0, 1 - np.abs(centers[..., None, :] - xyz) / (REACH * lines.pitch)).prod(axis=-1)
    np.testing.assert_allclose(lines.support_sum, tents.sum(axis=-1), atol=1e-5)


def test_axis_parallel_lines_through_the_middle_of_cells():
    pose = look_at(np.array([[3.0, 0.05, 0.05]]), np.array([[0.0, 0.05, 0.05]]))
    camera = Cameras.create(pose, np.array([80.0, 80.0, 64.0, 48.0]), 128, 96)
    points = SparsePoints.create([[0.05, 0.05, 0.05]], point=[0], camera=[0])  # no cameras given: no uncertainty
    lines = SightLines.build(points, camera, aabb=[[-1.0] * 3, [1.0] * 3], pitch=0.1, margin_cells=2.0)
    row = lines.crossing_count[:, 10, 10]
    assert row.tolist() == [0] * 12 + [1] * 8  # from the face at 1 to two cells before the point in cell 10
    assert lines.crossing_count.sum() == row.sum()


def test_the_frame_and_its_unit_do_not_matter():
    cameras, xyz = rig(), np.random.default_rng(3).uniform(-1, 1, size=(30, 3))
    places = np.random.default_rng(4).uniform(-1, 1, size=(500, 3))
    lines = SightLines.build(observed(xyz, cameras), cameras, aabb=BOX, pitch=0.1)
    for scale in (1e-6, 1e6):
        poses = cameras.camera_to_world.copy()
        poses[:, :, 3] *= scale
        scaled = Cameras.create(poses, cameras.intrinsics, 128, 96)
        other = SightLines.build(observed(xyz * scale, scaled), scaled, aabb=BOX * scale, pitch=0.1 * scale)
        np.testing.assert_allclose(other.crossings(places * scale), lines.crossings(places), rtol=1e-3, atol=1e-3)
        np.testing.assert_allclose(other.support(places * scale), lines.support(places), rtol=1e-3, atol=1e-3)


@pytest.mark.slow
def test_many_photos_and_points_mean_what_few_mean():
    """A plane watched from above: between cameras and plane, near the plane, behind it."""
    rng = np.random.default_rng(5)
    places = {
        "free": np.stack([*rng.uniform(-0.5, 0.5, (2, 400)), np.full(400, 0.5)], axis=1),
        "surface": np.stack([*rng.uniform(-0.5, 0.5, (2, 400)), np.zeros(400)], axis=1),
        "behind": np.stack([*rng.uniform(-0.5, 0.5, (2, 400)), np.full(400, -0.5)], axis=1),
    }
    found = []
    for photos, count in ((10, 300), (10, 5000), (60, 300), (60, 5000)):
        origins = np.stack([*rng.uniform(-0.8, 0.8, (2, photos)), np.full(photos, 1.5)], axis=1)
        cameras = Cameras.create(look_at(origins, np.zeros((photos, 3))), np.array([80.0, 80.0, 64.0, 48.0]), 128, 96)
        xyz = np.stack([*rng.uniform(-0.8, 0.8, (2, count)), np.zeros(count)], axis=1)
        lines = SightLines.build(observed(xyz, cameras), cameras, aabb=[[-1.0] * 3, [1.0] * 3], pitch=0.1)
        found.append({name: (lines.crossings(at).mean(), lines.support(at).mean()) for name, at in places.items()})
    free = [each["free"][0] for each in found]
    surface = [each["surface"][1] for each in found]
    assert max(free) < 2 * min(free)
    assert max(surface) < 2 * min(surface)
    for each in found:
        assert each["behind"] == (0.0, 0.0)
        assert each["surface"][0] < 0.1 * each["free"][0]
        assert each["free"][1] == 0.0


def test_uncertain_points_keep_their_distance():
    """Two cameras side by side know little of depth: the line ends early, or is not drawn."""
    origins = np.array([[0.0, 0.0, 2.0], [0.02, 0.0, 2.0]])
    cameras = Cameras.create(look_at(origins, np.zeros((2, 3))), np.array([80.0, 80.0, 64.0, 48.0]), 128, 96)
    near = SightLines.build(observed(np.zeros((1, 3)), cameras), cameras, aabb=BOX, pitch=0.05)
    assert len(near) == 0
    without = SightLines.build(observed(np.zeros((1, 3)), cameras), cameras, aabb=BOX, pitch=0.05, margin_sigmas=0.0)
    assert len(without) == 2
    np.testing.assert_allclose(np.linalg.norm(without.ends, axis=1), 0.1, rtol=1e-3)


def test_samples_lie_on_their_lines():
    cameras = rig()
    points = observed(np.zeros((4, 3)), cameras)
    wide = [[-3.0] * 3, [3.0] * 3]
    lines = SightLines.build(points, cameras, aabb=wide, pitch=0.1, margin_sigmas=0.0, robust=False)
    places, lengths = lines.sample(np.random.default_rng(0), 100, samples=8)
    assert places.shape == (100, 8, 3)
    assert lengths == pytest.approx(np.full(100, 2.3), abs=1e-9)
    radius = np.linalg.norm(places, axis=-1)
    assert (np.diff(radius, axis=1) < 0).all()  # from the camera inwards, one in each part
    assert radius.min() > 0.2
    assert len(np.unique(places[:, 0].round(3), axis=0)) > 50
    ends, covered = lines.sample_ends(np.random.default_rng(0), 50, reach=0.2)
    assert covered == 0.4
    radius = np.linalg.norm(ends, axis=-1)
    assert radius.max() < 0.2
    assert radius.min(axis=1).max() < 0.06
    assert (np.linalg.svd(ends - ends.mean(axis=1, keepdims=True), compute_uv=False)[:, 1] < 1e-9).all()
    inner = SightLines.build(points, cameras, aabb=BOX, pitch=0.1, margin_sigmas=0.0, robust=False)
    places, lengths = inner.sample(np.random.default_rng(0), 200)
    assert (places >= BOX[0] - 1e-9).all()
    assert (places <= BOX[1] + 1e-9).all()


def ball_on_a_floor(photos, count, wrong, seed=0):
    """Cameras on an arc, points of a ball (radius .4) on a floor (z = -.5) as they see them, some put elsewhere."""
    rng = np.random.default_rng(seed)
    angle = np.linspace(0, 4.5, photos)
    origins = np.stack([1.4 * np.cos(angle), 1.4 * np.sin(angle), 0.3 + 0.3 * np.sin(3 * angle)], axis=1)
    targets = np.tile([0.0, 0.0, -0.1], (photos, 1))
    cameras = Cameras.create(look_at(origins, targets), np.array([90.0, 90.0, 64.0, 48.0]), 128, 96)
    outward = rng.normal(size=(count, 3))
    xyz = 0.4 * outward / np.linalg.norm(outward, axis=1, keepdims=True)
    floor = np.arange(count) % 2 == 0
    xyz[floor] = np.stack([*rng.uniform(-0.95, 0.95, (2, floor.sum())), np.full(floor.sum(), -0.5)], axis=1)
    point, camera = (part.ravel() for part in np.meshgrid(np.arange(count), np.arange(photos), indexing="ij"))
    ray = xyz[point] - origins[camera]
    distance = np.linalg.norm(ray, axis=1)
    toward = (origins[camera] * ray).sum(axis=1) / distance
    inside = toward**2 - (origins[camera] ** 2).sum(axis=1) + 0.16
    hidden = (inside > 0) & (-toward - np.sqrt(np.maximum(inside, 0)) < distance - 1e-3)
    seen = cameras.sees(camera, xyz[point]) & ~hidden & (rng.random(len(point)) < 0.35)
    point, camera = point[seen], camera[seen]
    for index in np.flatnonzero(rng.random(count) < wrong):
        of = camera[point == index]
        if len(of):
            start = origins[rng.choice(of)]
            xyz[index] = start + (xyz[index] - start) * rng.uniform(0.3, 1.9) + rng.normal(0, 0.02, 3)
    return cameras, SparsePoints.create(xyz, point=point, camera=camera, cameras=cameras)


@pytest.mark.slow
@pytest.mark.parametrize("wrong", [0.0, 0.08])
def test_wrong_points_neither_open_walls_nor_hide_air(wrong):
    cameras, points = ball_on_a_floor(30, 5000, wrong)
    box, pitch = [[-1.0] * 3, [1.0] * 3], 2 / 96
    found = {}
    for robust in (True, False):
        lines = SightLines.build(points, cameras, aabb=box, pitch=pitch, robust=robust)
        center = cells_of(lines) + pitch / 2
        radius, height = np.linalg.norm(center, axis=-1), center[..., 2] + 0.5
        solid = (radius < 0.4 - 3 * pitch) | (height < -3 * pitch)
        skin = np.minimum(abs(radius - 0.4), abs(height)) < 0.6 * pitch
        air = (radius > 0.4 + 3 * pitch) & (height > 3 * pitch)
        found[robust] = [float((lines.crossing_count[part] > 0).mean()) for part in (solid, skin, air)]
    assert found[True][0] < 0.004
    assert found[True][1] < 0.12
    assert found[True][2] > 0.9 * found[False][2]
    assert found[False][1] > 2 * found[True][1]
    if wrong:
        assert found[False][0] > 0.05  # what one wrong point in twelve does where nobody looks


def test_what_cannot_be_a_line_is_none():
    cameras = rig(2)
    empty = SightLines.build(SparsePoints.create(np.zeros((0, 3))), cameras, aabb=BOX, pitch=0.1)
    assert len(empty) == 0
    assert empty.crossings(np.zeros((3, 3))).tolist() == [0.0] * 3
    with pytest.raises(ValueError, match="there is no sight line"):
        empty.sample(np.random.default_rng(0), 4)
    at_camera = SparsePoints.create(cameras.origins[:1], point=[0], camera=[0], cameras=cameras)
    assert len(SightLines.build(at_camera, cameras, aabb=BOX, pitch=0.1)) == 0
    trackless = SightLines.build(SparsePoints.create(np.zeros((1, 3))), cameras, aabb=BOX, pitch=0.1)
    assert len(trackless) == 0
    assert trackless.support(np.zeros((1, 3)))[0] > 0
    outside = np.array([[9.0, 0.0, 0.0], [np.nan, 0.0, 0.0]])
    assert trackless.support(outside).tolist() == [0.0, 0.0]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"pitch": 0.0}, "pitch must be finite and > 0"),
        ({"pitch": float("nan")}, "pitch must be finite and > 0"),
        ({"pitch": 1e-4}, "makes .* cells, at most"),
        ({"pitch": 0.1, "margin_cells": -1.0}, "margins must be >= 0"),
        ({"pitch": 0.1, "reach": 0.5}, r"reach must be in \[1, 1048576\], got 0.5"),
        ({"pitch": 0.1, "reach": float("nan")}, "reach must be in"),
        ({"pitch": 0.1, "reach": 1e9}, "reach must be in"),
    ],
)
def test_refusals(options, message):
    cameras = rig(2)
    with pytest.raises(ValueError, match=message):
        SightLines.build(observed(np.zeros((1, 3)), cameras), cameras, aabb=BOX, **options)


def spread(seed=6, near=40, far=40, outwards=9.0):
    """Cameras round the box; points in it and, in all directions, beyond it."""
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=(far, 3))
    direction /= np.abs(direction).max(axis=1, keepdims=True)
    return rig(8), np.concatenate([rng.uniform(-0.8, 0.8, (near, 3)), direction * rng.uniform(1.3, outwards, (far, 1))])


def test_what_lies_in_the_box_does_not_depend_on_the_reach():
    cameras, xyz = spread(outwards=40.0)
    places = np.random.default_rng(0).uniform(*BOX, (2000, 3))
    points = observed(xyz, cameras)
    short, long = (
        SightLines.build(points, cameras, aabb=BOX, pitch=0.1, field_pitch=0.005, margin_sigmas=0.0, reach=reach)
        for reach in (1.0, 20.0)
    )
    for name in ("starts", "ends", "targets", "crossing_count", "support_sum"):
        np.testing.assert_array_equal(getattr(long, name), getattr(short, name))
    np.testing.assert_array_equal(long.crossings(places), short.crossings(places))
    assert short.shells == ()
    assert [len(shell) > 0 for shell in long.shells] == [True] * 5
    assert len(long) == len(short) + sum(map(len, long.shells))
    assert len(short) > 50


@pytest.mark.slow
@pytest.mark.parametrize("robust", [False, True])
def test_counts_of_shells_are_those_of_the_slow_twin(robust):
    cameras, xyz = spread()
    points = observed(xyz, cameras)
    lines = SightLines.build(points, cameras, aabb=BOX, pitch=0.15, reach=6.0, robust=robust)
    inner = BOX
    for shell in lines.shells:
        np.testing.assert_array_equal(shell.crossing_count, counted_slowly(shell))
        middle = (shell.starts + shell.ends) / 2
        assert ((middle < inner[0]) | (middle > inner[1])).any(axis=1).all()
        assert ((middle >= shell.aabb[0]) & (middle <= shell.aabb[1])).all()
        inner = shell.aabb
    np.testing.assert_allclose(inner - inner.mean(axis=0), 6 * (BOX - BOX.mean(axis=0)))


def test_the_pieces_of_a_line_add_up():
    """From (-7, .1, .2) through the box [-1, 1]^3 to a point at x = 30 that is as good as free of a margin."""
    camera = Cameras.create(
        look_at(np.array([[-7.0, 0.1, 0.2]]), np.array([[30.0, 0.1, 0.2]])), np.array([80.0, 80.0, 64.0, 48.0]), 128, 96
    )
    points = SparsePoints.create([[30.0, 0.1, 0.2]], point=[0], camera=[0])
    box = [[-1.0] * 3, [1.0] * 3]
    lines = SightLines.build(points, camera, aabb=box, pitch=0.25, margin_cells=0.0, robust=False, reach=10.0)
    spans = [sorted(zip(each.starts[:, 0].round(9), each.ends[:, 0].round(9))) for each in (lines, *lines.shells)]
    assert spans == [[(-1, 1)], [(-2, -1), (1, 2)], [(-4, -2), (2, 4)], [(-7, -4), (4, 8)], [(8, 10)]]
    places = np.array([[x, 0.1, 0.2] for x in (-8.5, -6.5, -3, -1.5, 0, 1.5, 3, 7, 9.5, 10.5, 29)])
    assert (lines.crossings(places) > 0).tolist() == [False] + [True] * 8 + [False] * 2
    _, lengths = lines.sample(np.random.default_rng(0), 400)
    assert set(lengths.round(9)) == {1.0, 2.0, 3.0, 4.0}
    single = SightLines.build(points, camera, aabb=box, pitch=0.25, margin_cells=2.0, robust=False, reach=64.0)
    ends = np.concatenate([each.ends[:, 0] for each in single.shells]).max()
    assert ends == pytest.approx(1 / (1 / 30 + 0.5))  # eq. 10 of mip-NeRF 360: 2 - 1 / n less two cells of 1 / 4


def test_points_beyond_the_box_support_and_are_sampled():
    cameras, xyz = spread(near=0)
    points = observed(xyz, cameras, error=np.full(len(xyz), 0.0))
    lines = SightLines.build(points, cameras, aabb=BOX, pitch=0.1, field_pitch=0.02, robust=False, reach=16.0)
    assert (lines.support(xyz) > 0).all()
    assert (SightLines.build(points, cameras, aabb=BOX, pitch=0.1, robust=False).support(xyz) == 0).all()
    assert (
        lines.crossings(np.concatenate([level.starts + 0.5 * (level.ends - level.starts) for level in lines.shells]))
        > 0
    ).all()
    places, lengths = lines.sample(np.random.default_rng(0), 500)
    assert np.isfinite(places).all()
    assert (places < BOX[0]).any()
    assert (lengths > 0).all()
    ends, covered = lines.sample_ends(np.random.default_rng(0), 300, reach=0.04)
    assert covered.shape == (300,)
    assert covered.min() > 0.08  # more than in the box
    nearest = np.linalg.norm(ends[:, :, None] - xyz, axis=-1).min(axis=(1, 2))
    assert (nearest < covered / 8).all()
    assert (lines.crossings(np.full((1, 3), 1e3)) == 0).all()


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_far_points_are_finite_or_counted(scale):
    """From a thousand to a million boxes away, in every unit."""
    origins = rig(8).origins * scale
    cameras = Cameras.create(look_at(origins, np.zeros((8, 3))), np.array([80.0, 80.0, 64.0, 48.0]), 128, 96)
    direction = np.random.default_rng(0).normal(size=(40, 3))
    xyz = scale * direction * np.logspace(3, 6, 40)[:, None]
    points = observed(xyz, cameras)
    options = {"aabb": BOX * scale, "pitch": 0.1 * scale, "reach": 2.0**20}
    vague = SightLines.build(points, cameras, margin_sigmas=0.0, **options)
    assert len(vague.sample_ends(np.random.default_rng(0), 100, reach=0.2 * scale)[0]) == 0
    exact = dataclasses.replace(points, uncertainty=np.zeros(len(points)))
    lines = SightLines.build(exact, cameras, margin_sigmas=0.0, **options)
    assert len(lines.shells) == 20
    assert (
        lines.report["observations"]
        == 320
        == len(lines.starts) + sum(lines.report[name] for name in ("too_near", "outside", "outvoted"))
    )
    places, lengths = lines.sample(np.random.default_rng(0), 1000)
    ends, covered = lines.sample_ends(np.random.default_rng(0), 100, reach=0.2 * scale)
    found = [lines.crossings(places), lines.support(xyz), lines.crossings(xyz), places, lengths, ends, covered]
    assert all(np.isfinite(each).all() for each in found)
    assert len(ends) == 100
    uncertain = SightLines.build(points, cameras, aabb=BOX * scale, pitch=0.1 * scale, reach=2.0**20)
    assert uncertain.report["too_near"] == 320  # half a pixel is more than all the distance


@pytest.mark.parametrize("reach", [1.0, 8.0])
def test_the_unit_does_not_matter_beyond_the_box(reach):
    cameras, xyz = spread()
    places = np.random.default_rng(4).uniform(-4, 4, size=(500, 3))
    lines = SightLines.build(observed(xyz, cameras), cameras, aabb=BOX, pitch=0.1, reach=reach)
    assert (lines.crossings(places[np.abs(places).max(axis=1) > 1.5]) > 0).any() == (reach > 1)
    for scale in (2.0**-20, 2.0**20):  # exact, so that ties are not broken by rounding
        poses = cameras.camera_to_world.copy()
        poses[:, :, 3] *= scale
        scaled = Cameras.create(poses, cameras.intrinsics, 128, 96)
        points = observed(xyz * scale, scaled)
        other = SightLines.build(points, scaled, aabb=BOX * scale, pitch=0.1 * scale, reach=reach)
        np.testing.assert_allclose(other.crossings(places * scale), lines.crossings(places), rtol=1e-3, atol=1e-3)
        np.testing.assert_allclose(other.support(places * scale), lines.support(places), rtol=1e-3, atol=1e-3)


def test_an_empty_box_costs_nothing():
    """Twice the box, eight times the cells: the same block is stored and looked up."""
    cameras, xyz = rig(radius=0.5), np.random.default_rng(3).uniform(-0.5, 0.5, size=(30, 3))
    box = np.array([[-1.0] * 3, [1.0] * 3])
    places = np.random.default_rng(4).uniform(-1, 1, size=(500, 3))
    small, large = (
        SightLines.build(observed(xyz, cameras), cameras, aabb=box * side, pitch=0.1) for side in (1.0, 2.0)
    )
    assert small.crossed.shape == large.crossed.shape
    assert small.supported.shape == large.supported.shape
    np.testing.assert_array_equal(small.crossed, large.crossed)
    np.testing.assert_allclose(small.supported, large.supported, atol=1e-6)
    np.testing.assert_allclose(small.crossings(places), large.crossings(places), atol=1e-5)
    np.testing.assert_allclose(small.support(places), large.support(places), atol=1e-5)
    np.testing.assert_array_equal(large.crossing_count[10:30, 10:30, 10:30], small.crossing_count)
    assert large.crossing_count.sum() == small.crossing_count.sum() > 0


def test_duplicates_count_as_often_as_they_are_given():
    cameras, xyz = rig(), np.random.default_rng(3).uniform(-0.5, 0.5, size=(30, 3))
    once, twice = (
        SightLines.build(observed(np.tile(xyz, (n, 1)), cameras), cameras, aabb=BOX, pitch=0.1, robust=False)
        for n in (1, 2)
    )
    np.testing.assert_array_equal(twice.crossing_count, 2 * once.crossing_count)
    np.testing.assert_allclose(twice.support_sum, 2 * once.support_sum, rtol=1e-6)
    places = np.random.default_rng(4).uniform(*BOX, size=(500, 3))
    np.testing.assert_allclose(twice.crossings(places), once.crossings(places), rtol=1e-5)  # relative: no matter


@pytest.mark.parametrize("reach", [1.0, 16.0])
def test_points_that_all_lie_outside(reach):
    """Lines pass through the box, or not at all; nothing supports in it."""
    cameras = rig(2)
    through = SightLines.build(observed(-cameras.origins * 2, cameras), cameras, aabb=BOX, pitch=0.1, reach=reach)
    assert len(through.starts) > 0
    assert through.support_sum.max() == 0
    away = SparsePoints.create(cameras.origins * 3, point=[0, 1], camera=[0, 1])
    lines = SightLines.build(away, cameras, aabb=BOX, pitch=0.1, reach=reach)
    assert len(lines.starts) == 0
    assert lines.report["outside"] == 2
    assert lines.crossing_count.max() == 0
    assert (lines.crossings(np.zeros((5, 3))) == 0).all()
    ends, _ = lines.sample_ends(np.random.default_rng(0), 4, reach=0.1)
    assert len(ends) == (0 if reach == 1 else 4)


@pytest.mark.parametrize("place", [[0.0, 0.0, 0.0], [-1.0, -1.2, -0.8], [1.1, 1.0, 0.9]])
def test_a_single_point(place):
    cameras = rig()
    lines = SightLines.build(observed(np.array([place]), cameras), cameras, aabb=BOX, pitch=0.1, reach=2.0)
    assert np.isfinite(lines.crossings(np.array([place]))).all()
    assert lines.support(np.array([place]))[0] > 0
    assert lines.report["outvoted"] == 0


def test_a_point_at_a_camera_is_no_line_and_hides_none():
    cameras = rig()
    xyz = np.random.default_rng(3).uniform(-0.5, 0.5, size=(30, 3))
    clean = SightLines.build(observed(xyz, cameras), cameras, aabb=BOX * 3, pitch=0.1, reach=3.0)
    point, camera = (part.ravel() for part in np.meshgrid(np.arange(30), np.arange(6), indexing="ij"))
    given = SparsePoints.create(
        np.concatenate([xyz, cameras.origins[:1]]),
        point=np.append(point, 30),
        camera=np.append(camera, 0),
        cameras=cameras,
    )
    lines = SightLines.build(given, cameras, aabb=BOX * 3, pitch=0.1, reach=3.0)
    assert lines.report["too_near"] == clean.report["too_near"] + 1
    np.testing.assert_array_equal(lines.crossing_count, clean.crossing_count)


def test_ends_are_of_points_that_are_certain_enough():
    """Of points that may lie farther off than what the term covers, it is not known that matter is there."""
    cameras, xyz = spread()
    points = observed(xyz, cameras)
    sigma = np.where(np.arange(len(points)) % 2 == 0, 0.05, 0.3)
    lines = SightLines.build(
        dataclasses.replace(points, uncertainty=sigma), cameras, aabb=BOX, pitch=0.1, margin_sigmas=0.0
    )
    assert set(lines.uncertainty) == {0.05, 0.3}
    places, _ = lines.sample_ends(np.random.default_rng(0), 400, reach=0.1)
    middles = places.mean(axis=1)  # stratified about the point
    nearest = np.linalg.norm(middles[:, None] - points.xyz, axis=2).argmin(axis=1)
    assert len(places) == 400
    assert (nearest % 2 == 0).mean() > 0.95
    assert len(lines.sample_ends(np.random.default_rng(0), 9, reach=0.01)[0]) == 0
