import warnings

import numpy as np
import pytest

from unghost.core.cameras import Cameras, look_at
from unghost.core.sparse_points import SparsePoints, warn_if_not_in_view


def rig(origins):
    origins = np.asarray(origins, dtype=float)
    poses = look_at(origins, np.zeros_like(origins))
    return Cameras.create(poses, np.array([100.0, 100.0, 50.0, 50.0]), 100, 100)


CAMERAS = rig([[2.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.2, 2.0, 0.0], [0.0, 0.0, 2.0]])


def test_repeated_observations_count_once_and_order_does_not_matter():
    one = SparsePoints.create(np.eye(3), point=[2, 0, 0, 0], camera=[1, 3, 0, 3], cameras=CAMERAS)
    assert one.point.tolist() == [0, 0, 2]
    assert one.camera.tolist() == [0, 3, 1]
    assert one.views().tolist() == [2, 0, 1]


def test_uncertainty_is_the_scatter_of_triangulated_points():
    """Noise of half a pixel on each observation, each point triangulated anew by least squares."""
    rng, truth = np.random.default_rng(0), np.array([0.1, -0.2, 0.05])
    watching = [1, 2]  # a narrow baseline
    claimed = SparsePoints.create([truth], point=[0, 0], camera=watching, cameras=CAMERAS).uncertainty[0]
    found = []
    for _ in range(2000):
        information, target = np.zeros((3, 3)), np.zeros(3)
        for index in watching:
            pixels, _, _ = CAMERAS.project(index, truth[None])
            origins, rays = CAMERAS.rays(index, pixels + rng.normal(0, 0.5, size=(1, 2)))
            across = np.eye(3) - np.outer(rays[0], rays[0])
            information += across
            target += across @ origins[0]
        found.append(np.linalg.solve(information, target))
    assert np.linalg.svd(np.cov(np.array(found).T))[1][0] ** 0.5 == pytest.approx(claimed, rel=0.1)


def test_one_ray_determines_nothing_and_more_rays_more():
    def of(*cameras):
        points = SparsePoints.create(np.zeros((1, 3)), point=[0] * len(cameras), camera=cameras, cameras=CAMERAS)
        return points.uncertainty[0]

    assert of() == of(0) == np.inf
    assert of(1, 2) > 5 * of(0, 1) > 5 * of(0, 1, 3)
    assert np.isnan(SparsePoints.create(np.zeros((1, 3)), point=[0], camera=[0]).uncertainty[0])


def test_a_selection_renumbers_its_observations():
    points = SparsePoints.create(
        np.arange(12).reshape(4, 3), point=[0, 1, 3, 3], camera=[0, 1, 2, 3], error=np.arange(4)
    )
    part = points.select(np.array([False, True, False, True]))
    assert part.xyz.tolist() == [[3, 4, 5], [9, 10, 11]]
    assert part.point.tolist() == [0, 1, 1]
    assert part.camera.tolist() == [1, 2, 3]
    assert part.error.tolist() == [1, 3]


def test_of_some_cameras():
    points = SparsePoints.create(np.eye(3), point=[0, 0, 0, 1, 1], camera=[0, 1, 3, 0, 1], cameras=CAMERAS)
    part = points.of(CAMERAS, [3, 0])
    assert part.xyz.tolist() == [[1, 0, 0]]
    assert sorted(part.camera.tolist()) == [0, 1]
    again = SparsePoints.create(part.xyz, point=part.point, camera=part.camera, cameras=CAMERAS.select([3, 0]))
    assert part.uncertainty == pytest.approx(again.uncertainty)
    assert len(points.of(CAMERAS, [3, 0], least_views=1)) == 2


def test_another_frame_is_warned_of():
    points = SparsePoints.create(np.eye(3) * 0.3, point=[0, 1, 2], camera=[0, 1, 3], cameras=CAMERAS)
    assert points.share_in_view(CAMERAS) == 1.0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_if_not_in_view(points, CAMERAS, caller="clean")
        warn_if_not_in_view(SparsePoints.create(np.zeros((2, 3))), CAMERAS, caller="clean")
    far = SparsePoints.create(np.eye(3) * 300, point=[0, 1, 2], camera=[0, 1, 3], cameras=CAMERAS)
    with pytest.warns(UserWarning, match="clean: only 0% of the observations project"):
        warn_if_not_in_view(far, CAMERAS, caller="clean")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"xyz": np.zeros((3, 2))}, r"xyz must have shape \(P, 3\)"),
        ({"xyz": [[0.0, np.nan, 0.0], [0.0, 0.0, 0.0]]}, "finite, got 1 of 2 points"),
        ({"point": [3], "camera": [0]}, "point must be >= 0 and < 3"),
        ({"point": [-1], "camera": [0]}, "point must be >= 0 and < 3"),
        ({"point": [0], "camera": [4]}, "camera must be < 4"),
        ({"point": [0], "camera": [-2]}, "camera must be >= 0"),
        ({"point": [0, 1], "camera": [0]}, "one length, got 2 and 1"),
        ({"point": [0.5], "camera": [0]}, "point must hold integers"),
        ({"error": [1.0]}, "error must be"),
        ({"error": [1.0, -1.0, 0.0]}, "values >= 0"),
    ],
)
def test_refusals(arguments, message):
    with pytest.raises(ValueError, match=message):
        SparsePoints.create(**{"xyz": np.zeros((3, 3)), "cameras": CAMERAS} | arguments)


def test_one_line_says_what_there_is():
    assert (
        SparsePoints.create(np.eye(3), point=[0, 1], camera=[3, 3]).about == "3 points with 2 observations by 1 camera"
    )
    assert SparsePoints.create(np.eye(3)).about.startswith("3 points without tracks: they support density near them")
    assert SparsePoints.create(np.zeros((0, 3))).about.startswith("0 points without tracks")


def test_points_without_tracks_in_another_frame_are_warned_of():
    near = SparsePoints.create(np.random.default_rng(0).uniform(-0.3, 0.3, (5000, 3)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_if_not_in_view(near, CAMERAS, caller="clean")
        warn_if_not_in_view(SparsePoints.create(np.zeros((0, 3))), CAMERAS, caller="clean")
    far = SparsePoints.create(near.xyz + 50.0)
    with pytest.warns(UserWarning, match="clean: only 0% of the points are in view of any camera; .* one frame"):
        warn_if_not_in_view(far, CAMERAS, caller="clean")


def test_angles_are_the_largest_between_two_rays():
    xyz = np.array([[0.0, 0, 0], [0.0, 0, 0], [0.1, 0, 0], [0.0, 0, 0], [0.0, 9.0, 0], CAMERAS.origins[0]])
    point = [0, 0, 0, 1, 1, 2, 4, 4, 5, 5]
    camera = [0, 1, 2, 1, 2, 0, 0, 1, 0, 1]
    angle = SparsePoints.create(xyz, point=point, camera=camera).angles(CAMERAS)
    narrow = np.degrees(np.arctan(0.1))  # camera 2 stands .2 beside camera 1, 2 away
    np.testing.assert_allclose(angle, [90.0, narrow, 0.0, 0.0, 0.0, 0.0], atol=1e-5)


def test_filtering_counts_each_point_once_by_its_first_reason():
    xyz = np.array([[0.0, 0, 0]] * 4 + [[0.0, 9.0, 0.0]] + [[0.0, 0, 0]])
    point = [0, 0, 1, 1, 2, 2, 3, 4, 4, 5, 5]
    camera = [0, 1, 0, 1, 1, 2, 0, 0, 1, 1, 2]
    points = SparsePoints.create(xyz, point=point, camera=camera, error=[0.4, 2.5, 0.4, 0.4, 9.0, 9.0])
    result = points.filtered(CAMERAS, least_angle=10.0)
    assert result.kept.tolist() == [True, False, False, False, False, False]
    assert (result.few_views, result.large_error, result.narrow_angle) == (2, 2, 1)
    assert result.points.camera.tolist() == [0, 1]
    assert result.about.startswith(
        "5 of 6 points dropped: 2 in view of fewer than 2 photos, 2 off by more than 2 pixels"
    )
    open_ = points.filtered(CAMERAS, most_error=np.inf, least_angle=0)
    assert open_.kept.tolist() == [True, True, True, False, False, True]
    unknown = SparsePoints.create(xyz, point=point, camera=camera).filtered(CAMERAS)
    assert unknown.large_error == 0  # nothing is known of the error


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"most_error": 0}, "most_error must be > 0 pixels, got 0"),
        ({"most_error": np.nan}, "most_error must be > 0"),
        ({"least_angle": -1}, r"least_angle must be in \[0, 180\) degrees, got -1"),
        ({"least_angle": 180}, "least_angle must be in"),
        ({"cameras": CAMERAS.select([0])}, "camera must be < 1, the number of cameras, got 1"),
    ],
)
def test_filters_that_make_no_sense_are_refused(arguments, message):
    points = SparsePoints.create(np.zeros((1, 3)), point=[0, 0], camera=[0, 1])
    with pytest.raises(ValueError, match=message):
        points.filtered(**{"cameras": CAMERAS} | arguments)


def measured(rng, count, wrong):
    """Points triangulated as COLMAP does, from pixels with noise; the last ``wrong`` from wrong matches.

    Half of these have one keypoint in a wrong place, the other half were matched in two photos that stand side by side.

    Returns:
        the points, and the true places.
    """
    angle = np.linspace(0, np.pi, 24)
    origins = np.stack([3 * np.cos(angle), 3 * np.sin(angle), np.full(24, 1.0)], axis=1)
    cameras = rig(
        np.concatenate([origins, origins + np.array([0.0, 0.0, 0.05])])
    )  # each with a twin, under a degree away
    truth = rng.uniform(-0.7, 0.7, size=(count, 3))
    xyz, error, tracks = np.zeros((count, 3)), np.zeros(count), []
    for number, place in enumerate(truth):
        bad = number >= count - wrong
        side_by_side = bad and number % 2
        start = rng.integers(0, 20)
        track = [start, start + 24] if side_by_side else start + np.sort(rng.choice(5, size=4, replace=False))
        places = [
            place + (rng.normal(0, 0.4, 3) if bad and not side_by_side and k == 0 else 0) for k in range(len(track))
        ]
        pixels = [
            cameras.project(int(index), where[None])[0] + rng.normal(0, 0.5, size=(1, 2))
            for index, where in zip(track, places)
        ]
        information, target = np.zeros((3, 3)), np.zeros(3)
        for index, pixel in zip(track, pixels):
            origins, rays = cameras.rays(int(index), pixel)
            across = np.eye(3) - np.outer(rays[0], rays[0])
            information, target = information + across, target + across @ origins[0]
        xyz[number] = np.linalg.solve(information, target)
        again = [cameras.project(int(index), xyz[number][None])[0] for index in track]
        error[number] = np.mean([np.linalg.norm(one - other) for one, other in zip(again, pixels)])
        tracks += [(number, index) for index in track]
    point, camera = np.array(tracks).T
    return SparsePoints.create(xyz, point=point, camera=camera, cameras=cameras, error=error), truth, cameras


def test_of_eight_per_cent_wrong_points_hardly_any_stay():
    points, truth, cameras = measured(np.random.default_rng(3), count=500, wrong=40)
    result = points.filtered(cameras)
    right = np.arange(500) < 460
    off = np.linalg.norm(points.xyz - truth, axis=1)
    assert result.kept[right].mean() > 0.97
    assert result.kept[~right].mean() < 0.2  # a wrong keypoint may lie beside the right one
    assert result.large_error > 12
    assert result.narrow_angle > 12
    assert (~result.kept).sum() == result.few_views + result.large_error + result.narrow_angle
    far = off > 0.3  # of points in a box of 1.4
    assert far.sum() > 20
    assert far[result.kept].sum() < 0.2 * far.sum()  # those left are guesses that came out near the two cameras


def test_no_point_one_and_two_in_one_place_go_through_everything():
    for count in (0, 1, 2):
        xyz = np.zeros((count, 3))
        seen = [[number, index] for number in range(count) for index in (0, 1)]
        point, camera = np.array(seen, dtype=int).reshape(-1, 2).T
        points = SparsePoints.create(xyz, point=point, camera=camera, cameras=CAMERAS)
        assert len(points) == count
        assert points.views().tolist() == [2] * count
        assert points.angles(CAMERAS).tolist() == pytest.approx([90.0] * count)
        assert len(points.filtered(CAMERAS).points) == count
        assert len(points.of(CAMERAS, [1, 0])) == count
        assert len(points.select(np.ones(count, dtype=bool))) == count
        assert np.isnan(points.share_in_view(CAMERAS)) == (count == 0)


def test_a_point_on_a_cameras_centre_has_no_ray_of_it():
    points = SparsePoints.create(CAMERAS.origins[:1], point=[0, 0], camera=[0, 1], cameras=CAMERAS)
    assert points.uncertainty[0] == np.inf
    result = points.filtered(CAMERAS)
    assert (len(result.points), result.few_views) == (0, 1)


def test_the_uncertainty_is_of_the_matched_photos_pixels():
    """Cameras of photos at an eighth of the size, told so, give the uncertainty of the photos that were matched."""
    poses = look_at(np.array([[2.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, -2.0, 0.5]]), np.zeros((3, 3)))
    full = Cameras.create(poses, np.array([800.0, 800.0, 400.0, 400.0]), width=800, height=800)
    small = full.resized(1 / 8)
    tracks = {"point": [0, 0, 1, 1, 1], "camera": [0, 1, 0, 1, 2], "error": [0.3, 1.2]}
    places = np.array([[0.0, 0.0, 0.0], [0.1, 0.2, -0.1]])
    expected = SparsePoints.create(places, cameras=full, **tracks)
    for scale in (8.0, np.full(3, 8.0)):
        points = SparsePoints.create(places, cameras=small, pixel_scale=scale, **tracks)
        np.testing.assert_allclose(points.uncertainty, expected.uncertainty, rtol=1e-12)
    blunt = SparsePoints.create(places, cameras=small, **tracks)
    np.testing.assert_allclose(blunt.uncertainty, 8 * expected.uncertainty, rtol=1e-12)
    part = points.of(small, [0, 1])
    np.testing.assert_allclose(part.uncertainty, expected.of(full, [0, 1]).uncertainty, rtol=1e-12)
    np.testing.assert_array_equal(part.camera, [0, 1, 0, 1])
    for bad in (0.0, -1.0, np.nan, np.ones(2)):
        with pytest.raises(ValueError, match="SparsePoints: pixel_scale must be finite and > 0"):
            SparsePoints.create(places, cameras=small, pixel_scale=bad, **tracks)
