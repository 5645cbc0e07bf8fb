"""Options and parts of benchmarks/cleaning/cost.py."""

import numpy as np
from unghost_tests.benches import check_short

from benchmarks.cleaning import cost


def test_short():
    check_short(cost, seeds=(30,), repeats=1)


def test_cameras_of_the_ring_look_outwards_from_the_middle():
    cameras, middle = cost.ring(8), np.asarray(cost.AABB).mean(axis=0)
    np.testing.assert_allclose(cameras.origins, np.tile(middle, (8, 1)))
    forward = -cameras.camera_to_world[:, :3, 2]
    np.testing.assert_allclose(forward.sum(axis=0), 0.0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(cameras.camera_to_world[:, :3, :3]), 1.0)
