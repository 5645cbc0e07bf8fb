import numpy as np
import pytest

from unghost.core.distances import signed as sd

SOLIDS = {  # name: (distance, exact everywhere)
    "half_space": (lambda p: sd.half_space(p, (1, 2, -0.5), 0.3), True),
    "sphere": (lambda p: sd.sphere(p, 0.7), True),
    "ellipsoid": (lambda p: sd.ellipsoid(p, (0.8, 0.3, 0.5)), False),
    "box": (lambda p: sd.box(p, (0.6, 0.3, 0.4)), True),
    "rounded_box": (lambda p: sd.rounded_box(p, (0.6, 0.3, 0.4), 0.1), True),
    "cylinder": (lambda p: sd.cylinder(p, 0.4, 0.6), True),
    "tube": (lambda p: sd.tube(p, 0.5, 0.2, 0.6), True),
    "capsule": (lambda p: sd.capsule(p, (-0.4, 0, 0.1), (0.3, 0.2, -0.3), 0.25), True),
    "torus": (lambda p: sd.torus(p, 0.6, 0.2), True),
    "cone": (lambda p: sd.cone(p, 0.5, 0.8), True),
    "polyline_tube": (lambda p: sd.polyline_tube(p, np.array([[-0.5, 0, 0], [0, 0.4, 0], [0.4, 0, 0.5]]), 0.15), False),
    "union": (lambda p: sd.union([sd.sphere(p, 0.4), sd.box(p, (0.7, 0.2, 0.2))]), False),
    "difference": (lambda p: sd.difference(sd.box(p, (0.6, 0.6, 0.6)), sd.sphere(p, 0.7)), False),
    "shell": (lambda p: sd.shell(sd.sphere(p, 0.6), 0.2), True),
    "smooth_union": (lambda p: sd.smooth_union(sd.sphere(p, 0.4), sd.box(p, (0.7, 0.2, 0.2)), 0.2), False),
}
BY_HAND = [
    (sd.half_space([[0.0, 0, 3]], (0, 0, 2), 1.0), 2.0),
    (sd.sphere(np.array([[0.0, 3, 4]]), 2.0), 3.0),
    (sd.box(np.array([[4.0, 5, 0]]), (1, 1, 1)), 5.0),
    (sd.box(np.array([[0.2, 0.0, 0.9]]), (1, 1, 1)), -0.1),
    (sd.rounded_box(np.array([[2.0, 2.0, 0]]), (1, 1, 1), 0.5), np.hypot(1.5, 1.5) - 0.5),
    (sd.cylinder(np.array([[4.0, 0, 6]]), 1.0, 2.0), 5.0),
    (sd.cylinder(np.array([[0.0, 0, 0]]), 1.0, 2.0), -1.0),
    (sd.tube(np.array([[0.0, 0, 0]]), 1.0, 0.2, 2.0), 0.9),
    (sd.capsule(np.array([[0.0, 0, 5]]), (0, 0, 0), (0, 0, 2), 1.0), 2.0),
    (sd.capsule(np.array([[3.0, 0, 0]]), (0, 0, 0), (0, 0, 0), 1.0), 2.0),
    (sd.torus(np.array([[0.0, 0, 3]]), 4.0, 1.0), 4.0),
    (sd.cone(np.array([[0.0, 0, 5]]), 1.0, 2.0), 3.0),
    (sd.cone(np.array([[0.5, 0, -2]]), 1.0, 2.0), 2.0),
    (sd.ellipsoid(np.array([[0.0, 0, 0]]), (1, 2, 3)), -1.0),
    (sd.shell(np.array([0.5]), 0.2), 0.4),
    (sd.smooth_union(np.array([0.3]), np.array([0.3]), 0.4), 0.2),
]


@pytest.mark.parametrize(("found", "expected"), BY_HAND)
def test_by_hand(found, expected):
    assert found.item() == pytest.approx(expected)


def surface_points(distance, rng, count=4000):
    """Points on the zero set, by bisection between a point inside and one outside."""
    points = rng.uniform(-1.6, 1.6, size=(200_000, 3))
    values = distance(points)
    inside, outside = points[values < 0], points[values > 0]
    a, b = inside[rng.integers(len(inside), size=count)], outside[rng.integers(len(outside), size=count)]
    for _ in range(50):
        middle = (a + b) / 2
        within = distance(middle)[:, None] < 0
        a, b = np.where(within, middle, a), np.where(within, b, middle)
    return (a + b) / 2


@pytest.mark.slow
@pytest.mark.parametrize("name", SOLIDS)
def test_never_more_than_the_distance_to_any_surface_point(name):
    distance, _ = SOLIDS[name]
    rng = np.random.default_rng(1)
    surface = surface_points(distance, rng)
    assert np.abs(distance(surface)).max() < 1e-9  # same zero set
    probes = rng.uniform(-1.5, 1.5, size=(300, 3))
    nearest = np.sqrt(((probes[:, None] - surface[None]) ** 2).sum(-1)).min(axis=1)
    assert (np.abs(distance(probes)) <= nearest + 1e-9).all()


@pytest.mark.parametrize("name", [name for name, (_, exact) in SOLIDS.items() if exact])
def test_exact_ones_reach_the_surface(name):
    distance, _ = SOLIDS[name]
    rng = np.random.default_rng(2)
    probes = rng.uniform(-1.2, 1.2, size=(500, 3))
    value, step = distance(probes), 1e-6
    gradient = np.stack(
        [(distance(probes + step * axis) - distance(probes - step * axis)) / (2 * step) for axis in np.eye(3)], axis=-1
    )
    steep = np.linalg.norm(gradient, axis=-1)
    smooth = np.abs(steep - 1) < 1e-4  # off the medial axis the slope is one
    assert smooth.mean() > 0.97
    landed = distance(probes[smooth] - (value[smooth, None] * gradient[smooth]))
    assert np.abs(landed).max() < 1e-4


@pytest.mark.parametrize("name", [name for name in SOLIDS if name != "ellipsoid"])
def test_lipschitz_constant_is_one(name):
    distance, _ = SOLIDS[name]
    rng = np.random.default_rng(3)
    points = rng.uniform(-1.5, 1.5, size=(20_000, 3))
    moved = points + rng.normal(size=points.shape) * rng.uniform(1e-4, 0.5, size=(20_000, 1))
    gap = np.linalg.norm(points - moved, axis=-1)
    assert (np.abs(distance(points) - distance(moved)) <= gap * (1 + 1e-9) + 1e-12).all()


@pytest.mark.parametrize("name", SOLIDS)
def test_shapes_are_kept_and_inputs_untouched(name):
    distance, _ = SOLIDS[name]
    points = np.random.default_rng(4).normal(size=(2, 3, 4, 3))
    before = points.copy()
    grid = distance(points)
    assert grid.shape == (2, 3, 4)
    assert grid[1, 2, 3] == pytest.approx(distance(points[1, 2, 3][None]).item())
    np.testing.assert_array_equal(points, before)


def test_ball_against_its_volume():
    points = np.random.default_rng(5).uniform(-1, 1, size=(400_000, 3))
    assert 8 * (sd.sphere(points, 0.9) < 0).mean() == pytest.approx(4 / 3 * np.pi * 0.9**3, rel=0.01)
