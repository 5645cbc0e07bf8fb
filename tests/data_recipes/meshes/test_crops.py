import dataclasses
from pathlib import Path

import numpy as np
import pytest

from unghost.core.frames import CubeFrame, random_rotations
from unghost.data_recipes.meshes.crops import choose_frame, cut_cubes, sample_mesh_cubes
from unghost.data_recipes.meshes.files import load_mesh
from unghost.data_recipes.meshes.library import Mesh, select_meshes
from unghost.data_recipes.meshes.voxels import voxelize_triangles, voxelize_triangles_slowly
from unghost.data_recipes.recipe import load_recipe

RECIPE = load_recipe("meshes")
SHARED = Path(__file__).resolve().parents[3].parent / "shared" / "data"
SPHERE_RADIUS = 0.5


@pytest.fixture(scope="module")
def ball():
    """A mesh of 1280 faces whose corners lie on a sphere of diameter 1."""
    trimesh = pytest.importorskip("trimesh")
    shape = trimesh.creation.icosphere(subdivisions=3)
    return Mesh.from_triangles(np.asarray(shape.triangles))


def generators(count):
    return [np.random.default_rng([5, index]) for index in range(count)]


def test_sample_of_a_batch_equals_sample_alone(ball):
    occupancy, frames = sample_mesh_cubes(generators(20), ball, RECIPE)
    for index, rng in enumerate(generators(20)):
        alone, (frame,) = sample_mesh_cubes([rng], ball, RECIPE)
        np.testing.assert_array_equal(alone[0], occupancy[index])
        np.testing.assert_array_equal(frame.center, frames[index].center)
        assert frame.edge_length == frames[index].edge_length


def test_no_dilation_is_the_voxels_of_all_triangles(ball):
    recipe = dataclasses.replace(RECIPE, max_dilation=0)
    occupancy, frames = sample_mesh_cubes(generators(12), ball, recipe)
    for cube, frame in zip(occupancy, frames):
        np.testing.assert_array_equal(cube, voxelize_triangles(frame.to_local(ball.triangles)))


def test_no_cubes_and_another_resolution(ball):
    assert cut_cubes(ball, []).shape == (0, 32, 32, 32)
    frame = CubeFrame(np.array([0.5, 0, 0]), 0.2)
    coarse, fine = cut_cubes(ball, [frame], resolution=8)[0], cut_cubes(ball, [frame], resolution=32)[0]
    assert (fine.reshape(8, 4, 8, 4, 8, 4).any(axis=(1, 3, 5)) <= coarse).all()  # a voxel holds its parts


def test_frames_lie_on_near_and_away_in_the_shares_of_the_recipe(ball):
    recipe = dataclasses.replace(RECIPE, on_share=0.5, near_share=0.3, empty_share=0.1, center_jitter=0.0)
    frames = [choose_frame(rng, ball, recipe) for rng in generators(1500)]
    off = np.array([abs(np.linalg.norm(f.center) - SPHERE_RADIUS) / f.edge_length for f in frames])
    beside = np.array([np.linalg.norm(f.center) for f in frames]) > 1.1
    flat = 0.01 / np.array([f.edge_length for f in frames])  # faces lie up to 0.01 under the sphere
    assert beside.mean() == pytest.approx(0.1, abs=0.03)
    assert (~beside & (off <= flat)).mean() >= 0.9 * 0.5 - 0.04
    assert (~beside & (off > 0.5 + flat)).mean() <= 0.9 * 0.2 + 0.04
    assert (~beside & (off > 0.3)).mean() >= 0.9 * 0.2 - 0.04
    assert not cut_cubes(ball, [f for f, b in zip(frames, beside) if b]).any()


def test_edges_are_log_uniform_and_rotations_uniform(ball):
    frames = [choose_frame(rng, ball, RECIPE) for rng in generators(1500)]
    logs = np.log([f.edge_length for f in frames])
    low, high = np.log(RECIPE.edge_fraction)
    np.testing.assert_allclose(
        (np.quantile(logs, [0, 0.25, 0.5, 0.75, 1]) - low) / (high - low), [0, 0.25, 0.5, 0.75, 1], atol=0.04
    )
    axes = np.stack([f.rotation for f in frames])
    np.testing.assert_allclose(axes.mean(axis=0), 0, atol=0.05)
    np.testing.assert_allclose((axes**2).mean(axis=0), 1 / 3, atol=0.03)
    assert (np.linalg.det(axes) > 0.99).all()


def test_truly_empty_and_near_empty_cubes_are_there(ball):
    occupancy, _ = sample_mesh_cubes(generators(400), ball, RECIPE)
    counts = occupancy.sum(axis=(1, 2, 3))
    assert (counts == 0).mean() >= RECIPE.empty_share * 0.4
    assert ((counts > 0) & (counts < 400)).any()
    assert (counts == 32**3).sum() == 0


@pytest.mark.slow
@pytest.mark.shared_data
@pytest.mark.skipif(not SHARED.exists(), reason="no data folder beside the project")
def test_a_thousand_cubes_of_real_meshes_agree_with_the_oracle():
    """Every voxel of every cube, 32^3, against all 13 axes by the book; a few of the cubes hold many triangles."""
    pytest.importorskip("trimesh")
    entries = select_meshes(dataclasses.replace(RECIPE, split="val"), SHARED / "meshes")
    rng = np.random.default_rng(0)
    recipe = dataclasses.replace(RECIPE, edge_fraction=(0.01, 0.1), empty_share=0.0)
    done = occupied = busy = 0
    for entry in entries[:: max(1, len(entries) // 20)]:
        mesh, kept = load_mesh(entry.path), 0
        for _ in range(400):
            frame = choose_frame(rng, mesh, recipe)
            reach = np.full(3, frame.edge_length * np.sqrt(3) / 2)
            near = mesh.tree.touching(frame.center[None] - reach, frame.center[None] + reach)[1]
            if len(near) > (60 if kept == 0 else 4):
                continue  # the oracle takes milliseconds a triangle
            expected = voxelize_triangles_slowly(frame.to_local(mesh.triangles[near]))
            np.testing.assert_array_equal(cut_cubes(mesh, [frame])[0], expected)
            kept, occupied, busy = kept + 1, occupied + bool(expected.any()), busy + (len(near) > 4)
            if kept == 55:
                break
        done += kept
    assert done >= 1000
    assert occupied > 0.6 * done
    assert busy >= 3


def test_rotated_cubes_miss_no_triangle():
    rng = np.random.default_rng(2)
    mesh = Mesh.from_triangles(rng.uniform(-1, 1, size=(3000, 1, 3)) + rng.normal(size=(3000, 3, 3)) * 0.02)
    frames = [CubeFrame(rng.uniform(-0.5, 0.5, size=3), 0.1, rotation) for rotation in random_rotations(rng, 25)]
    for cube, frame in zip(cut_cubes(mesh, frames), frames):
        np.testing.assert_array_equal(cube, voxelize_triangles(frame.to_local(mesh.triangles)))
