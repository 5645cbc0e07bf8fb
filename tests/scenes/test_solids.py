import numpy as np
import pytest

from unghost.core.frames import random_rotations
from unghost.scenes.solids import PATTERNS, SHAPES, Light, Solid, SolidScene, Texture

RED, BLUE = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
PLAIN = Texture(RED, RED)
EXACT = {
    "sphere": ((0.3,), 0.3),
    "box": ((np.array([0.3, 0.2, 0.1]),), 0.4),
    "rounded_box": ((np.array([0.3, 0.2, 0.2]), 0.05), 0.45),
    "cylinder": ((0.2, 0.3), 0.4),
    "tube": ((0.25, 0.05, 0.2), 0.36),
    "torus": ((0.3, 0.08), 0.4),
    "cone": ((0.25, 0.35), 0.4),
    "capsule": ((np.array([0.0, 0.0, -0.2]), np.array([0.1, 0.0, 0.2]), 0.1), 0.35),
    "polyline_tube": ((np.array([[-0.2, 0, 0], [0, 0.1, 0.1], [0.2, 0, 0]]), 0.05), 0.3),
}


def scene_of(names, seed, *, room=False):
    rng = np.random.default_rng(seed)
    solids = [Solid("box", (np.full(3, 1.5),), np.zeros(3), PLAIN, 0.0, inside_out=True)] if room else []
    for name in names:
        parameters, bound = EXACT[name]
        solids.append(Solid(name, parameters, rng.uniform(-1, 1, 3), PLAIN, bound, random_rotations(rng, 1)[0]))
    return SolidScene(solids, [])


def test_every_exact_shape_is_covered():
    assert set(EXACT) == set(SHAPES) - {"ellipsoid", "sampled"}  # a bound; and tests/core/distances/test_sampled.py


@pytest.mark.parametrize("room", [False, True])
def test_culling_equals_the_plain_minimum(room):
    scene = scene_of(list(EXACT) * 3, 3, room=room)
    points = np.random.default_rng(4).uniform(-2, 2, size=(9000, 3))  # more than one chunk
    values = np.stack([solid.distance(points) for solid in scene.solids])
    distance, owner = scene.nearest(points)
    np.testing.assert_allclose(distance, values.min(axis=0), atol=1e-12)
    np.testing.assert_allclose(values[owner, np.arange(len(points))], distance, atol=1e-12)
    assert len(np.unique(owner)) == len(scene.solids)
    np.testing.assert_array_equal(scene.signed_distance(points.reshape(90, 100, 3)), distance.reshape(90, 100))


def test_culling_with_ellipsoids_stays_between_the_plain_minimum_and_the_truth():
    rng = np.random.default_rng(0)
    radii = np.array([0.3, 0.2, 0.1])
    leaves = [
        Solid("ellipsoid", (radii,), rng.uniform(-1, 1, 3), PLAIN, 0.3, random_rotations(rng, 1)[0]) for _ in range(8)
    ]
    scene = SolidScene([*leaves, *scene_of(["sphere", "box"], 1).solids], [])
    points = rng.uniform(-1.5, 1.5, size=(4000, 3))
    plain = np.min([solid.distance(points) for solid in scene.solids], axis=0)
    distance = scene.signed_distance(points)
    assert (distance >= plain - 1e-12).all()
    np.testing.assert_array_equal(distance < 0, plain < 0)
    outside = distance > 0
    for _ in range(30):  # nothing solid within the distance
        direction = rng.normal(size=(int(outside.sum()), 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        near = points[outside] + 0.999 * distance[outside, None] * direction
        assert np.min([solid.distance(near) for solid in scene.solids], axis=0).min() > 0


@pytest.mark.parametrize("name", [*EXACT, "ellipsoid"])
def test_a_turned_solid_moves_with_its_frame(name):
    parameters = EXACT[name][0] if name in EXACT else (np.array([0.3, 0.2, 0.1]),)
    rng = np.random.default_rng(2)
    rotation, center = random_rotations(rng, 1)[0], np.array([0.4, -0.2, 0.1])
    local = rng.uniform(-0.5, 0.5, size=(2000, 3))
    turned = Solid(name, parameters, center, PLAIN, 1.0, rotation).distance(local @ rotation.T + center)
    np.testing.assert_allclose(turned, SHAPES[name](local, *parameters), atol=1e-12)
    assert (turned < 0).any()
    hollow = Solid(name, parameters, center, PLAIN, 0.0, rotation, inside_out=True)
    np.testing.assert_allclose(hollow.distance(local @ rotation.T + center), -turned, atol=1e-12)


def test_trace_hits_a_ball_where_geometry_says():
    scene = SolidScene([Solid("sphere", (1.0,), np.zeros(3), PLAIN, 1.0)], [])
    offset = np.array([0.0, 0.3, 0.6, 0.9, 1.1])
    origins = np.stack([np.full(5, -3.0), offset, np.zeros(5)], axis=1)
    distance = scene.trace(origins, np.tile([1.0, 0.0, 0.0], (5, 1)))
    np.testing.assert_allclose(distance[:4], 3 - np.sqrt(1 - offset[:4] ** 2), atol=4e-3)
    assert np.isinf(distance[4])


def test_rays_that_never_meet_the_floor_see_the_sky():
    """A ray that leaves a floor at a small angle takes many steps; running out of them is no hit."""
    floor = Solid("box", (np.array([12.0, 12.0, 0.05]),), np.array([0, 0, -0.05]), PLAIN, 17.0)
    scene = SolidScene([floor], [], sky=BLUE)
    slope = np.geomspace(1e-3, 0.5, 60)
    directions = np.stack([np.cos(slope), np.zeros(60), np.sin(slope)], axis=1)
    origins = np.tile([0.0, 0.0, 0.004], (60, 1))
    for steps in (8, 96, 256):
        distance = scene.trace(origins, directions, steps=steps)
        hit = np.isfinite(distance)
        points = origins[hit] + distance[hit, None] * directions[hit]
        assert (np.abs(scene.signed_distance(points)) < 1e-2 + 4e-3 * distance[hit]).all()
    assert not np.isfinite(distance[slope > 0.01]).any()
    color, _ = scene.render(origins[slope > 0.01], directions[slope > 0.01])
    np.testing.assert_array_equal(color, np.broadcast_to(BLUE, color.shape))


def test_trace_beyond_far_is_sky():
    scene = SolidScene([Solid("sphere", (1.0,), np.array([20.0, 0.0, 0.0]), PLAIN, 1.0)], [])
    ray = np.zeros((1, 3)), np.array([[1.0, 0.0, 0.0]])
    np.testing.assert_allclose(scene.trace(*ray), 19.0, atol=5e-3)
    assert np.isinf(scene.trace(*ray, far=10.0)).all()


def test_normals_of_a_ball_point_outward():
    directions = np.random.default_rng(0).normal(size=(50, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    scene = SolidScene([Solid("sphere", (0.7,), np.zeros(3), PLAIN, 0.7)], [])
    np.testing.assert_allclose(scene.normals(0.7 * directions), directions, atol=2e-3)


def test_shading_by_hand():
    # the top of a ball: normal +z, lit from straight above, seen from straight above, no gloss
    scene = SolidScene(
        [Solid("sphere", (1.0,), np.zeros(3), PLAIN, 1.0)], [Light(np.array([0, 0, 3.0]), 0.3)], ambient=0.5
    )
    top, down = np.array([[0.0, 0.0, 1.0]]), np.array([[0.0, 0.0, -1.0]])
    np.testing.assert_allclose(scene.shade(top, down), [[0.5 + 0.3, 0.0, 0.0]], atol=1e-3)
    # from below the light does not reach, and the ambient light is halved: 0.5 * (0.75 - 0.25)
    np.testing.assert_allclose(scene.shade(-top, -down), [[0.25, 0.0, 0.0]], atol=1e-3)
    glossy = SolidScene(
        [Solid("sphere", (1.0,), np.zeros(3), Texture(RED, RED, gloss=0.5), 1.0)], scene.lights, ambient=0.5
    )
    np.testing.assert_allclose(
        glossy.shade(top, down), [[0.8 + 0.15, 0.15, 0.15]], atol=5e-3
    )  # 0.3 * 0.5 in every channel


def test_patterns_mix_within_the_unit_range():
    points = np.random.default_rng(0).uniform(-5, 5, size=(500, 3))
    for name, pattern in PATTERNS.items():
        mix = pattern(points)
        assert mix.shape == (500,)
        assert mix.min() >= 0.0
        assert mix.max() <= 1.0
        assert np.ptp(mix) == 0.0 if name == "plain" else np.ptp(mix) > 0.5
        albedo = Texture(RED, BLUE, name, grain=1.0, wavelength=0.3).albedo(points)
        assert albedo.shape == (500, 3)
        assert (albedo >= 0).all()
        assert (albedo <= 1).all()


def test_checker_by_hand():
    points = np.array([[0.1, 0.1, 0.1], [1.1, 0.1, 0.1], [1.1, 1.1, 0.1], [-0.5, 0.1, 0.1]])
    np.testing.assert_array_equal(PATTERNS["checker"](points), [0, 1, 0, 1])
    np.testing.assert_allclose(Texture(RED, BLUE, "checker", wavelength=1.0).albedo(points[:2]), [RED, BLUE])
