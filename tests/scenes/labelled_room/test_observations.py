import numpy as np
import pytest

from unghost.core.lattice import look_up_cells
from unghost.scenes.labelled_room import AABB, build_room, room_cameras, room_points
from unghost.scenes.labelled_room.observations import CLEARANCE, _distance


@pytest.fixture(scope="module")
def room():
    return build_room(3)


@pytest.fixture(scope="module")
def cameras(room):
    return room_cameras(room, 16, seed=3)


def test_cameras_stand_in_the_clear_and_see_the_room(room, cameras):
    assert _distance(room, cameras.origins).min() > CLEARANCE
    assert ((cameras.origins > AABB[0]) & (cameras.origins < AABB[1])).all()
    places = np.random.default_rng(0).uniform(AABB[0] + 0.3, AABB[1] - 0.3, size=(2000, 3))
    assert (cameras.view_count(places) >= 2).mean() > 0.8


@pytest.mark.slow
def test_points_lie_on_true_surfaces_and_not_on_ghosts(room, cameras):
    points = room_points(room, cameras, 1500, seed=3, noise=0.3, wrong=0.0)
    assert 1000 < len(points) <= 1500
    assert points.share_in_view(cameras) == 1.0
    assert np.quantile(np.abs(_distance(room, points.xyz)), 0.95) < room.pitch
    ghosts = look_up_cells(room.ghost_kind >= 0, points.xyz, aabb=AABB, pitch=room.pitch, outside=False)
    assert ghosts.mean() < 0.05
    wrong = room_points(room, cameras, 1500, seed=3, noise=0.3, wrong=0.2)
    far = np.abs(_distance(room, wrong.xyz)) > 2 * room.pitch
    assert 0.1 < far.mean() < 0.25  # some wrong ones land on a surface


@pytest.mark.slow
def test_nothing_solid_is_between_a_point_and_the_cameras_that_observed_it(room, cameras):
    points = room_points(room, cameras, 400, seed=4, noise=1e-6, wrong=0.0)
    start, end = cameras.origins[points.camera], points.xyz[points.point]
    share = np.linspace(0, 1, 400)[:, None, None]
    length = np.linalg.norm(end - start, axis=1)[:, None]
    places = start + share * (1 - 3 * room.pitch / length) * (end - start)
    assert (_distance(room, places).min(axis=0) < -0.3 * room.pitch).mean() < 0.02


def test_a_seed_is_a_set_and_impossible_numbers_are_refused(room, cameras):
    one, two = (room_points(room, cameras, 50, seed=1) for _ in range(2))
    np.testing.assert_array_equal(one.xyz, two.xyz)
    for options in ({"count": 0}, {"wrong": 1.0}):
        with pytest.raises(ValueError, match=r"room_points: count must be >= 1 and wrong in \[0, 1\)"):
            room_points(room, cameras, **options)
