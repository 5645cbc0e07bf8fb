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
