import numpy as np
import pytest

from unghost.core.cameras import Cameras


@pytest.fixture(scope="session")
def photographed():
    """A ball and a box on a floor, photographed from +x: their -x sides are seen by nobody."""
    pytest.importorskip("torch")
    from unghost.fields import furniture, scenes, solids

    rng = np.random.default_rng(0)
    texture = furniture.random_texture(rng)
    scene = solids.SolidScene(
        [
            solids.Solid("sphere", (0.3,), np.array([0.2, 0.3, -0.1]), texture, 0.3),
            solids.Solid("box", (np.array([0.2, 0.2, 0.3]),), np.array([-0.2, -0.4, -0.1]), texture, 0.42),
            solids.Solid("box", (np.array([2.0, 2.0, 0.1]),), np.array([0.0, 0.0, -0.55]), texture, 2.84),
        ],
        [],
    )
    origins = np.array([[0.95, 0.0, 0.2], [0.9, 0.3, 0.4]])
    poses = scenes.look_at(origins, np.array([[0.0, 0.0, -0.2]] * 2))
    cameras = Cameras.create(poses, np.array([24.0, 24.0, 20.0, 15.0]), 40, 30)
    rays = [[ray.reshape(-1, 3) for ray in cameras.rays(index)] for index in range(2)]
    depth = [scene.trace(*ray) * -(ray[1] @ poses[index, :, 2]) for index, ray in enumerate(rays)]
    images = np.zeros((2, 30, 40, 3), dtype=np.float32)
    return scenes.PhotographedScene(scene, cameras, cameras, images, np.stack(depth).reshape(2, 30, 40))
