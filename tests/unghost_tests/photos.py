import numpy as np
import pytest

from unghost.core.cameras import Cameras, look_at
from unghost.scenes.solids import Light, Solid, SolidScene, Texture


@pytest.fixture(scope="session")
def photos():
    """Ten small photos of a red ball in a smoothly coloured room."""
    red = Texture(np.array([0.9, 0.2, 0.1]), np.array([0.9, 0.2, 0.1]))
    walls = Texture(np.array([0.1, 0.3, 0.9]), np.array([0.6, 0.9, 0.4]), "gradient", 0.25)
    room = Solid("box", (np.full(3, 0.9),), np.zeros(3), walls, 0.0, inside_out=True)
    ball = Solid("sphere", (0.3,), np.zeros(3), red, 0.3)
    scene = SolidScene([room, ball], [Light(np.array([0.3, 0.3, 0.7]), 0.4)])
    angle = np.linspace(0, 2 * np.pi, 10, endpoint=False)
    origins = np.stack([0.8 * np.cos(angle), 0.8 * np.sin(angle), 0.3 * np.cos(3 * angle)], axis=1)
    cameras = Cameras.create(look_at(origins, np.zeros((10, 3))), np.array([16.0, 16.0, 12.0, 9.0]), 24, 18)
    images = [scene.render(*(ray.reshape(-1, 3) for ray in cameras.rays(index)))[0] for index in range(10)]
    return cameras, np.stack(images).reshape(10, 18, 24, 3).astype(np.float32)
