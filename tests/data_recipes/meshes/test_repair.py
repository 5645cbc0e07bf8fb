import itertools
from pathlib import Path

import numpy as np
import pytest

from unghost.core.frames import CubeFrame, random_rotations
from unghost.data_recipes.meshes.files import read_mesh_file
from unghost.data_recipes.meshes.repair import (
    RULES,
    RepairOptions,
    Topology,
    fill_solid,
    repair_triangles,
    topology,
    winding_numbers,
)
from unghost.data_recipes.meshes.voxels import voxelize_triangles

SHARED = Path(__file__).resolve().parents[3].parent / "shared" / "data"
HOSTILE = SHARED / "hostile" / "synthetic"


def box(low, high):
    """Twelve triangles, facing outwards."""
    corners = np.array(list(itertools.product(*zip(low, high))), dtype=float)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return corners[[triangle for q in quads for triangle in ((q[0], q[1], q[2]), (q[0], q[2], q[3]))]]


def ball(subdivisions=3, radius=0.5):
    trimesh = pytest.importorskip("trimesh")
    return np.asarray(trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius).triangles, dtype=float)


BOX = box([-0.5] * 3, [0.5] * 3)


def solid(triangles, frame, rule="winding", resolution=32):
    return fill_solid(triangles, frame, voxelize_triangles(frame.to_local(triangles), resolution), rule=rule)


def iou(a, b):
    return (a & b).sum() / (a | b).sum()


def test_topology_by_hand():
    assert topology(BOX) == Topology(12, 0, 0, 0, 0)
    assert topology(BOX[1:]) == Topology(11, 3, 0, 0, 3)
    turned = BOX.copy()
    turned[0] = turned[0, ::-1]
    assert topology(turned) == Topology(12, 0, 0, 3, 3)
    assert topology(np.concatenate([BOX, BOX])) == Topology(24, 0, 18, 0, 0)
    fin = np.array([[BOX[0, 0], BOX[0, 1], [3.0, 3, 3]]])
    assert topology(np.concatenate([BOX, fin])) == Topology(13, 2, 1, 0, 3)
    assert topology(np.zeros((0, 3, 3))) == Topology(0, 0, 0, 0, 0)
    assert not topology(np.zeros((0, 3, 3))).closed
    assert topology(np.concatenate([BOX, BOX[:1, [0, 0, 1]]])).faces == 12  # a needle with two equal corners
    signed_zero = np.where(BOX[:6] == 0.5, 0.0, BOX[:6]), np.where(BOX[6:] == 0.5, -0.0, BOX[6:])
    assert topology(np.concatenate(signed_zero)).closed


def test_winding_numbers_by_hand():
    points = np.array([[0, 0, 0], [0.4, -0.3, 0.2], [2, 0, 0], [0.5, 0.5, 0.50001]])
    np.testing.assert_allclose(winding_numbers(points, BOX), [1, 1, 0, 0], atol=1e-9)
    np.testing.assert_allclose(winding_numbers(points[:3], BOX[:, ::-1]), [-1, -1, 0], atol=1e-9)
    np.testing.assert_allclose(winding_numbers(points[:1], np.concatenate([BOX, BOX * 2])), [2], atol=1e-9)
    np.testing.assert_allclose(winding_numbers(points[:1], BOX[2:]), [5 / 6], atol=1e-9)  # one face is a sixth
    assert winding_numbers(np.zeros((0, 3)), BOX).shape == (0,)


def test_solid_ball_has_its_volume():
    triangles = ball()
    frame = CubeFrame(np.array([0.01, 0.02, -0.03]), 1.1, random_rotations(np.random.default_rng(0), 1)[0])
    filled = solid(triangles, frame, resolution=48)
    surface = voxelize_triangles(frame.to_local(triangles), 48)
    exact = np.einsum("fi,fi->f", triangles[:, 0], np.cross(triangles[:, 1], triangles[:, 2])).sum() / 6
    voxel = (1.1 / 48) ** 3
    assert (filled & ~surface).sum() * voxel < exact < filled.sum() * voxel
    centers = np.linalg.norm(frame.lattice(48), axis=-1)
    assert filled[centers < 0.49].all()
    assert not filled[centers > 0.5 + 1.1 / 48].any()


@pytest.mark.parametrize("rule", RULES)
def test_the_two_rules_agree_on_simple_bodies(rule):
    """Cubes on, in and off a ball, against the distance from its centre; and cubes that see only its inside."""
    if rule == "signed_distance":
        pytest.importorskip("open3d")
    triangles = ball()
    rng = np.random.default_rng(1)
    for i, rotation in enumerate(random_rotations(rng, 6)):
        frame = CubeFrame(rng.uniform(-0.5, 0.5, 3) * (i > 0), 0.3, rotation)
        filled = solid(triangles, frame, rule, resolution=16)
        radius = np.linalg.norm(frame.lattice(16), axis=-1)
        inner = np.linalg.norm(triangles.mean(axis=1), axis=1).min()
        assert filled[radius < inner].all()
        assert not filled[radius > 0.5 + 0.3 / 16].any()


def test_parts_within_and_across_parts():
    """Nested boxes are solid, a box turned inwards is a cavity, overlaps are inside (by crossings: outside)."""
    pytest.importorskip("open3d")
    frame = CubeFrame(np.array([0.01, 0.02, 0.03]), 1.7, random_rotations(np.random.default_rng(0), 1)[0])
    inner = box([-0.2] * 3, [0.2] * 3)
    middle = np.abs(frame.lattice()).max(axis=-1) < 0.12
    for triangles, winding, crossings in [
        (np.concatenate([BOX, inner]), True, False),
        (np.concatenate([BOX, inner[:, ::-1]]), False, False),
        (np.concatenate([BOX, BOX * [0.4, 1.5, 0.5]]), True, False),
        (BOX[:, ::-1], True, True),
    ]:
        assert solid(triangles, frame)[middle].all() == winding
        assert solid(triangles, frame)[middle].any() == winding
        assert solid(triangles, frame, "signed_distance")[middle].any() == crossings
    assert solid(BOX, CubeFrame(np.zeros(3), 0.5)).all()  # wholly inside: no surface in sight
    assert not solid(BOX, CubeFrame(np.full(3, 5.0), 0.5)).any()


def test_an_open_surface_has_no_inside():
    frame, surface = CubeFrame(np.zeros(3), 1.7), np.zeros((32, 32, 32), dtype=bool)
    with pytest.raises(ValueError, match="must be closed, got 3 edges that are not balanced"):
        fill_solid(BOX[1:], frame, surface)
    with pytest.raises(ValueError, match="rule must be one of winding, signed_distance, got 'parity'"):
        fill_solid(BOX, frame, surface, rule="parity")
    with pytest.raises(ValueError, match=r"surface must be bool of shape \(R, R, R\)"):
        fill_solid(BOX, frame, surface[0])
    with pytest.raises(ValueError, match=r"topology: triangles must have shape \(F, 3, 3\)"):
        topology(BOX[0])
    with pytest.raises(ValueError, match="winding_numbers: triangles must be finite, got 9"):
        winding_numbers(np.zeros((1, 3)), np.where(np.arange(12)[:, None, None] == 3, np.nan, BOX))


def messy_ball(rng):
    """A ball with 30 triangles missing, a third turned round, a fifth there twice, and every corner nudged apart."""
    triangles = ball()
    kept = np.delete(triangles, rng.choice(len(triangles), 30, replace=False), axis=0)
    turned = rng.random(len(kept)) < 1 / 3
    kept[turned] = kept[turned][:, ::-1]
    doubled = np.concatenate([kept, kept[rng.random(len(kept)) < 0.2]])
    return doubled + rng.uniform(-2e-6, 2e-6, doubled.shape)


def test_repair_makes_a_messy_ball_whole():
    """Cubes of the surface come nearer to those of the ball it was, and its inside, which had none, is right."""
    pytest.importorskip("pymeshlab")
    messy, true = messy_ball(np.random.default_rng(0)), ball()
    before = messy.copy()
    repaired = repair_triangles(messy)
    np.testing.assert_array_equal(messy, before)
    assert repaired.before == topology(messy)
    assert repaired.before.boundary_edges > 1000
    assert repaired.after.closed
    assert repaired.after.faces == pytest.approx(len(true), abs=4)
    gains = []
    for seed in range(20):
        rng = np.random.default_rng([2, seed])
        center = rng.normal(size=3)
        frame = CubeFrame(0.5 * center / np.linalg.norm(center), 0.2, random_rotations(rng, 1)[0])
        truth, was, now = (voxelize_triangles(frame.to_local(t)) for t in (true, messy, repaired.triangles))
        gains.append(iou(now, truth) - iou(was, truth))
        with pytest.raises(ValueError, match="must be closed"):
            fill_solid(messy, frame, was)
        assert iou(fill_solid(repaired.triangles, frame, now), fill_solid(true, frame, truth)) > 0.99
    assert min(gains) >= -0.01
    assert np.mean(gains) > 0.01


@pytest.mark.skipif(not HOSTILE.exists(), reason="no data folder beside the project")
@pytest.mark.shared_data
@pytest.mark.parametrize("name", ["open_cube.obj", "mixed_winding.obj", "duplicate_faces.obj"])
def test_repair_changes_named_meshes_for_the_better(name):
    """After repair their cubes are those of ``cube_ok.obj``, which they are broken copies of, surface and inside."""
    pytest.importorskip("pymeshlab")
    sound, broken = (read_mesh_file(HOSTILE / n).triangles for n in ("cube_ok.obj", name))
    repaired = repair_triangles(broken)
    assert repaired.after == topology(sound) != repaired.before
    gained = 0
    for seed in range(10):
        rng = np.random.default_rng(seed)
        frame = CubeFrame(rng.uniform(-0.5, 0.5, 3), rng.uniform(0.5, 1.5), random_rotations(rng, 1)[0])
        truth, was, now = (voxelize_triangles(frame.to_local(t)) for t in (sound, broken, repaired.triangles))
        np.testing.assert_array_equal(now, truth)
        np.testing.assert_array_equal(fill_solid(repaired.triangles, frame, now), fill_solid(sound, frame, truth))
        gained += int((was != truth).sum())
        if not repaired.before.closed:
            with pytest.raises(ValueError, match="must be closed"):
                fill_solid(broken, frame, was)
    assert (gained > 1000) == (name == "open_cube.obj")


def test_remeshing_evens_the_triangles():
    pytest.importorskip("pymeshlab")
    repaired = repair_triangles(BOX * 7 + 100, options=RepairOptions(remesh_edge=0.1))
    edges = np.linalg.norm(repaired.triangles - np.roll(repaired.triangles, 1, axis=1), axis=2).ravel()
    assert repaired.after.closed
    assert 0.4 < np.median(edges) / 7 / 0.1 < 1.4
    assert edges.max() < 7 * 0.2
    np.testing.assert_allclose(repaired.triangles.min(axis=(0, 1)), 96.5, atol=1e-3)
    np.testing.assert_allclose(np.ptp(repaired.triangles.reshape(-1, 3), axis=0), 7, atol=1e-3)


def test_holes_stay_when_they_are_to_stay():
    pytest.importorskip("pymeshlab")
    assert repair_triangles(BOX[1:], options=RepairOptions(largest_hole=0)).after.boundary_edges == 3
    assert repair_triangles(BOX[1:], options=RepairOptions(largest_hole=3)).after.closed
    assert repair_triangles(BOX[2:], options=RepairOptions(largest_hole=3)).after.boundary_edges == 4


def test_sheets_that_meet_keep_their_surface():
    """Three sheets along one edge: cut apart there, none is lost."""
    pytest.importorskip("pymeshlab")
    fan = [[[0, 0, 0], [0, 0, 1], [np.cos(a), np.sin(a), 0.5]] for a in (0.0, 2.0, 4.0)]
    repaired = repair_triangles(np.array(fan), options=RepairOptions(largest_hole=0))
    assert repaired.before.nonmanifold_edges == 1
    assert repaired.after.faces == 3


@pytest.mark.parametrize(
    "bad", [{"merge_distance": -1}, {"largest_hole": -1}, {"remesh_edge": 0.0001}, {"remesh_rounds": 0}]
)
def test_options_have_ranges(bad):
    with pytest.raises(ValueError, match=f"RepairOptions: {next(iter(bad))} is outside its range"):
        RepairOptions(**bad)


def test_nothing_to_repair_is_an_error():
    pytest.importorskip("pymeshlab")
    for triangles in (np.zeros((0, 3, 3)), np.ones((2, 3, 3))):
        with pytest.raises(ValueError, match=r"longest side must be finite and > 0, got 0\.0"):
            repair_triangles(triangles)
    with pytest.raises(ValueError, match="nothing sound is left"):
        repair_triangles(np.array([[[0.0, 0, 0], [1, 0, 0], [1, 0, 0]]]))
