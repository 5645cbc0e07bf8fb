import numpy as np
import pytest

from unghost.data_recipes.solids import distances

HALF_PI = np.pi / 2
SQUARE = np.array([[0.0, 0], [2, 0], [2, 2], [0, 2]])


def at(*point):
    return np.array([point], dtype=np.float64)


BY_HAND = [
    (distances.extrude(np.array([3.0]), np.array([6.0]), 2.0), 5.0),  # 3 beside, 4 above
    (distances.extrude(np.array([-0.5]), np.array([1.8]), 2.0), -0.2),
    (distances.corner([np.array([3.0]), np.array([4.0]), np.array([-9.0])]), 5.0),
    (distances.corner([np.array([-3.0]), np.array([-4.0])]), -3.0),
    (distances.wedge(np.array([1.0]), np.array([2.0]), HALF_PI), np.sqrt(0.5)),  # one off the line v = u
    (distances.wedge(np.array([-4.0]), np.array([-3.0]), HALF_PI), 5.0),  # behind the apex
    (distances.wedge(np.array([2.0]), np.array([0.0]), HALF_PI), -np.sqrt(2.0)),
    (distances.ellipsoid(at(3, 0, 0), (1, 2, 3)), 2.0),
    (distances.ellipsoid(at(0, 0, 0), (1, 2, 3)), -1.0),
    (distances.ellipsoid(at(3, 4, 0), (2, 2, 2)), 3.0),
    (distances.ellipsoid(at(0, 0, 2.9), (3, 3, 3)), -0.1),
    (distances.polyline([np.array([1.0]), np.array([3.0])], np.array([[0.0, 0], [2, 0], [2, 2]])), np.sqrt(2.0)),
    (distances.polygon(np.array([1.0]), np.array([0.5]), SQUARE), -0.5),
    (distances.polygon(np.array([5.0]), np.array([6.0]), SQUARE), 5.0),
    (distances.bent_sheet(at(0, 0, 0), 1.0, 1.0, 0.5, 0.2), -0.1),
    (distances.bent_sheet(at(0, 3.5, 0), 1.0, 1.0, 0.5, 0.2), 2.9),
    (distances.bent_sheet(at(1, 0, 3), 1.0, HALF_PI, 0.5, 0.2), 1.9),  # straight above the rim at (1, 0, 1)
    (distances.bent_sheet(at(0, 0, 1), 1.0, 1.0, 0.5, 0.2), 0.9),  # the centre of the bend
    (distances.lattice(at(0, 0, 0), 1.0, 0.25, 1), -np.hypot(0.25, 0.25)),  # a node: out through an edge of a bar
    (distances.lattice(at(0.5, 0, 0), 1.0, 0.25, 1), -0.25),
    (distances.lattice(at(0.5, 0.5, 0.5), 1.0, 0.25, 1), np.hypot(0.25, 0.25)),
    (distances.lattice(at(4.25, 0, 0), 1.0, 0.25, 1), 3.0),  # bars end at 1.25
    (distances.lattice(at(1.15, 0, 0), 1.0, 0.25, 1), -0.1),
    (distances.studs(at(0, 0, 2), 1.0, 0.4, 0.1, 2), 1.7),
    (distances.studs(at(0.5, 0.5, 0.3), 1.0, 0.2, 0.1, 2), 0.3),
]


@pytest.mark.parametrize(("found", "expected"), BY_HAND)
def test_by_hand(found, expected):
    assert found.item() == pytest.approx(expected, abs=1e-7)


@pytest.mark.parametrize("angle", [0.3, HALF_PI, 2.7])
def test_bent_sheet_and_wedge_at_acute_right_and_obtuse_angles_against_points_on_them(angle):
    rng = np.random.default_rng(0)
    probes = rng.uniform(-1.5, 1.5, size=(400, 3))
    turns = np.linspace(-angle, angle, 4001)
    arc = np.stack([0.7 * np.sin(turns), np.zeros(4001), 0.7 - 0.7 * np.cos(turns)], axis=1)
    flat = probes * [1, 0, 1]
    nearest = np.linalg.norm(flat[:, None] - arc, axis=2).min(axis=1)
    over = np.maximum(np.abs(probes[:, 1]) - 0.3, 0)
    found = distances.bent_sheet(probes, 0.7, angle, 0.3, 0.02)
    np.testing.assert_allclose(found, np.hypot(nearest, over) - 0.01, atol=1e-4)
    rays = np.linspace(0, 5, 5001)[:, None] * [np.cos(angle / 2), np.sin(angle / 2)]
    plane = np.abs(probes[:, :2]) * np.where(probes[:, :2] < 0, [-1, 1], 1)  # the wedge is symmetric in v
    nearest = np.linalg.norm(plane[:, None] - rays, axis=2).min(axis=1)
    inside = np.abs(np.arctan2(probes[:, 1], probes[:, 0])) < angle / 2
    np.testing.assert_allclose(
        distances.wedge(probes[:, 0], probes[:, 1], angle), np.where(inside, -nearest, nearest), atol=1e-3
    )


@pytest.mark.slow
@pytest.mark.parametrize("radii", [(0.5, 0.5, 0.5), (0.5, 0.3, 0.125), (0.125, 0.5, 0.125), (1e-3, 1.0, 0.2)])
def test_ellipsoid_nearest_points_in_and_beside_its_planes_of_symmetry(radii):
    rng = np.random.default_rng(1)
    points = rng.uniform(-0.8, 0.8, size=(3000, 3))
    points[rng.random(points.shape) < 0.2] = 0.0  # principal planes, axes, the centre
    points[rng.random(points.shape) < 0.05] = 1e-7
    found, axes = distances.ellipsoid(points, radii), np.array(radii)
    inside = ((points / axes) ** 2).sum(axis=1) < 1
    assert ((found < 0) == inside).all()
    assert np.isfinite(found).all()
    # the nearest point of a solid moves the distance down its own slope: so does the next one
    surface = rng.normal(size=(20_000, 3))
    surface *= axes / np.linalg.norm(surface, axis=1, keepdims=True)
    for start in range(0, 3000, 300):
        part = points[start : start + 300]
        nearest = np.sqrt(((part**2).sum(1)[:, None] - 2 * part @ surface.T + (surface**2).sum(1)).clip(0).min(axis=1))
        assert (np.abs(found[start : start + 300]) <= nearest + 1e-7).all()
        assert np.median(nearest - np.abs(found[start : start + 300])) < 5e-3


def test_shapes_are_kept_whatever_the_order_in_memory_and_inputs_untouched():
    points = np.random.default_rng(4).normal(size=(2, 3, 4, 3))
    before = points.copy()
    for solid in (
        lambda p: distances.ellipsoid(p, (0.5, 0.2, 0.3)),
        lambda p: distances.bent_sheet(p, 0.5, 1.0, 0.5, 0.1),
        lambda p: distances.lattice(p, 0.5, 0.1, 2),
        lambda p: distances.studs(p, 0.5, 0.1, 0.05, 2),
        lambda p: distances.polygon(p[..., 0], p[..., 1], SQUARE),
    ):
        grid = solid(points)
        assert grid.shape == (2, 3, 4)
        np.testing.assert_allclose(solid(np.asfortranarray(points.reshape(-1, 3))), grid.reshape(-1), atol=1e-14)
        np.testing.assert_array_equal(points, before)
