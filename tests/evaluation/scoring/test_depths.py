import numpy as np
import pytest

from unghost.core.cameras import Cameras
from unghost.evaluation.scoring.depths import optical_depth, ray_depth

CAMERAS = Cameras.create(np.tile(np.eye(4), (2, 1, 1)), np.array([20.0, 20.0, 10.0, 8.0]), 20, 16)


def test_the_distance_to_a_plane_is_its_depth_along_the_axis():
    along_rays = np.stack([-4.0 / CAMERAS.rays(index)[1][..., 2] for index in range(2)])
    np.testing.assert_allclose(optical_depth(along_rays, CAMERAS), 4.0)
    np.testing.assert_allclose(ray_depth(np.full((2, 16, 20), 4.0), CAMERAS), along_rays)
    assert np.isinf(ray_depth(np.full((2, 16, 20), np.inf), CAMERAS)).all()


@pytest.mark.parametrize("convert", [optical_depth, ray_depth])
def test_another_shape_is_refused(convert):
    with pytest.raises(
        ValueError, match=rf"{convert.__name__}: depth must have shape \(2, 16, 20\), got \(1, 16, 20\)"
    ):
        convert(np.ones((1, 16, 20)), CAMERAS)
