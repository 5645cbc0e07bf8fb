import dataclasses

import numpy as np
import pytest

from unghost.core.cameras import Cameras
from unghost.scenes.generator import photograph, random_scene
from unghost.scenes.solids import Texture
from unghost.scenes.sparse_points import MatchingConfig, corner_strength, simulate_sparse_points

EXACT = MatchingConfig(
    points=(3000, 3000), noise=(1e-6, 1e-6), wrong=(1e-9, 1e-9), contrast=(0.003, 0.003), repeatability=(0.6, 0.6)
)


@pytest.fixture(scope="module")
def shot():
    rng = np.random.default_rng([0, 3])
    return photograph(rng, random_scene(rng), count=10, width=64, height=48)


def test_without_noise_points_lie_on_surfaces_and_are_seen_there(shot):
    exact = dataclasses.replace(shot, cameras=shot.true_cameras)
    points = simulate_sparse_points(np.random.default_rng(1), exact, EXACT)
    assert len(points) > 300
    assert np.abs(shot.scene.signed_distance(points.xyz)).max() < 5e-3  # the tracer's own tolerance
    assert points.share_in_view(shot.true_cameras) == 1.0
    for index in range(3):  # nothing hides a point from a camera that observed it
        mine = points.xyz[points.point[points.camera == index]]
        start = shot.true_cameras.origins[index]
        offset = mine - start
        distance = np.linalg.norm(offset, axis=1)
        traced = shot.scene.trace(np.broadcast_to(start, mine.shape), offset / distance[:, None])
        assert np.mean(traced > 0.9 * distance) > 0.97


def test_points_are_as_bad_as_told(shot):
    wrong = dataclasses.replace(EXACT, wrong=(0.2, 0.2))
    exact = dataclasses.replace(shot, cameras=shot.true_cameras)
    distances = [
        np.abs(shot.scene.signed_distance(simulate_sparse_points(np.random.default_rng(1), exact, config).xyz))
        for config in (EXACT, wrong)
    ]
    assert np.mean(distances[1] > 0.02) == pytest.approx(0.2, abs=0.06)  # some wrong depths lie on another surface
    noisy = dataclasses.replace(EXACT, noise=(1.0, 1.0))
    points = simulate_sparse_points(np.random.default_rng(1), exact, noisy)
    off = np.abs(shot.scene.signed_distance(points.xyz))
    assert 0.2 < np.median(off / points.uncertainty) < 3.0  # the uncertainty tells how far
    assert (points.views() >= 2).all()


def test_texture_decides_where_points_are(shot):
    """Of two halves of a floor, the textured one has nearly all of the points."""

    class HalfPlain(Texture):
        def albedo(self, positions):
            textured = super().albedo(positions)
            return np.where(positions[:, :1] > 0, textured, 0.5)

    texture = HalfPlain(np.full(3, 0.1), np.full(3, 0.9), "noise", 0.1, 0.0, 0.2)
    scene = dataclasses.replace(
        shot.scene, solids=[dataclasses.replace(solid, texture=texture) for solid in shot.scene.solids]
    )
    painted = dataclasses.replace(shot, scene=scene, look=(0.0, 0.0))
    points = simulate_sparse_points(np.random.default_rng(0), painted, EXACT)
    assert np.mean(points.xyz[:, 0] > -0.01) > 0.97


def test_strength_of_a_corner_an_edge_and_nothing():
    class Painted:
        ambient, solids = 0.7, ()

        def albedo(self, positions):
            x, y = positions[:, 0], positions[:, 1]
            bright = np.where(y > 0.5, (x > 0) & (y > 0.7), x > 0.2)  # a corner at (0, .7), an edge at x = .2
            return np.repeat(bright.astype(float)[:, None], 3, axis=1)

    pose = np.eye(3, 4)[None].copy()
    pose[0, 2, 3] = 1.0  # one unit above the plane, looking down
    cameras = Cameras.create(pose, np.array([10.0, 10.0, 5.0, 5.0]), 10, 10)
    shot = type("Shot", (), {"scene": Painted(), "true_cameras": cameras, "look": (0.0, 0.0)})
    places = np.array([[1e-3, 0.701, 0.0], [0.201, 0.0, 0.0], [-0.3, -0.3, 0.0]])
    down = np.tile([0.0, 0.0, -1.0], (3, 1))
    corner, edge, nothing = corner_strength(shot, places, down, np.zeros(3, int), step=0.1)
    assert corner > 0.1
    assert edge == pytest.approx(0.0, abs=1e-6)
    assert nothing == 0.0


def test_a_seed_is_a_set_and_its_size_varies(shot):
    one, two = (simulate_sparse_points(np.random.default_rng(3), shot) for _ in range(2))
    np.testing.assert_array_equal(one.xyz, two.xyz)
    counts = [len(simulate_sparse_points(np.random.default_rng(seed), shot)) for seed in range(8)]
    assert max(counts) > 4 * min(counts)
