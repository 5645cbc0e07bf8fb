import dataclasses
import subprocess
import sys
from collections import Counter

import numpy as np
import pytest

from unghost.core.frames import CubeFrame
from unghost.core.shards.packing import pack_frame
from unghost.data_recipes.meshes.crops import cut_cubes
from unghost.data_recipes.meshes.repair import fill_solid
from unghost.data_recipes.recipe import load_recipe
from unghost.data_recipes.solids import csg
from unghost.data_recipes.solids.csg import (
    ClosedMesh,
    CsgSettings,
    csg_cubes_at,
    random_solid,
    sample_csg_cubes,
    solid_triangles,
)

RECIPE = dataclasses.replace(load_recipe("meshes"), cubes_per_mesh=3, solid_share=0.3)
manifold3d = pytest.importorskip("manifold3d")
pytest.importorskip("scipy")


def generators(indices):
    return [np.random.default_rng([4, index]) for index in indices]


@pytest.mark.parametrize("seed", range(15))
def test_random_trees_are_watertight_and_of_some_volume(seed):
    solid = random_solid(np.random.default_rng(seed))
    triangles = solid_triangles(solid)
    corners, index = np.unique(triangles.reshape(-1, 3), axis=0, return_inverse=True)
    faces = index.reshape(-1, 3)
    edges = Counter(tuple(edge) for face in faces.tolist() for edge in zip(face, np.roll(face, -1).tolist()))
    assert all(edges[a, b] == edges[b, a] for a, b in edges if a != b)  # every edge is walked both ways
    enclosed = np.einsum("fi,fi->f", triangles[:, 0], np.cross(triangles[:, 1], triangles[:, 2])).sum() / 6
    assert enclosed == pytest.approx(solid.volume(), rel=1e-6)
    assert enclosed > 1e-8
    assert len(corners) >= 4


def test_same_generator_same_solid():
    first, again = (solid_triangles(random_solid(np.random.default_rng(7))) for _ in range(2))
    np.testing.assert_array_equal(first, again)
    assert len(first) != len(solid_triangles(random_solid(np.random.default_rng(8))))


@pytest.mark.parametrize("leaf", csg._LEAVES)
def test_leaves_are_about_one_unit_and_not_empty(leaf):
    for seed in range(12):
        made = leaf(manifold3d, np.random.default_rng(seed), 16)
        low, high = np.reshape(made.bounding_box(), (2, 3))
        assert made.volume() > 0
        assert np.abs(low + high).max() <= 0.5  # about the origin
        assert 0.05 <= (high - low).max() <= 1.3


def test_a_block_less_a_ball_is_filled_where_it_should_be():
    ball = manifold3d.Manifold.sphere(0.4, 64).translate([0.5, 0.5, 0.5])
    closed = ClosedMesh.from_solid(manifold3d.Manifold.cube([1, 1, 1], True) - ball)
    frame = CubeFrame(np.zeros(3), 1.2)
    surface = cut_cubes(closed.mesh, [frame])[0]
    filled = fill_solid(closed.triangles, frame, surface)
    lattice = frame.lattice()
    inside = (np.abs(lattice).max(axis=-1) < 0.5) & (np.linalg.norm(lattice - 0.5, axis=-1) > 0.4)
    np.testing.assert_array_equal(filled, surface | inside)
    assert 6 * 26**2 * 0.8 < surface.sum() < 0.5 * inside.sum()


def test_samples_of_a_batch_equal_samples_alone_and_share_trees_in_runs():
    indices = list(range(8))
    batch = csg_cubes_at(generators(indices), RECIPE, indices, seed=2)
    assert [group for _, _, group in batch] == [0, 0, 0, 1, 1, 1, 2, 2]
    for index in indices:
        ((alone, frame, group),) = csg_cubes_at(generators([index]), RECIPE, [index], seed=2)
        np.testing.assert_array_equal(alone, batch[index][0])
        np.testing.assert_array_equal(pack_frame(frame), pack_frame(batch[index][1]))
        assert group == batch[index][2]


def test_solid_share_fills_and_never_takes_away():
    closed = ClosedMesh.from_solid(random_solid(np.random.default_rng(3)))
    recipe = dataclasses.replace(RECIPE, max_dilation=0, edge_fraction=(0.1, 0.2))
    thin, _ = sample_csg_cubes(generators(range(12)), closed, dataclasses.replace(recipe, solid_share=0.0))
    full, _ = sample_csg_cubes(generators(range(12)), closed, dataclasses.replace(recipe, solid_share=1.0))
    assert (full >= thin).all()
    assert full.sum() > 1.5 * thin.sum()


def test_filling_never_fails_on_trees_with_slivers():
    recipe = dataclasses.replace(RECIPE, solid_share=1.0)
    for seed in range(20, 32):
        closed = ClosedMesh.from_solid(random_solid(np.random.default_rng(seed)))
        sample_csg_cubes(generators([seed]), closed, recipe)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"leaves": (0, 3)}, r"leaves must be \(low, high\) with 1 <= low <= high"),
        ({"extent": (0.5, 0.1)}, "extent must be"),
        ({"segments": (2, 8)}, "segments must be"),
        ({"cut_share": 0.9, "hull_share": 0.2}, "shares must be >= 0 and add to at most 1"),
        ({"common_share": -0.1}, "shares must be >= 0"),
    ],
)
def test_bad_settings_are_named(settings, message):
    with pytest.raises(ValueError, match=f"CsgSettings: {message}"):
        CsgSettings(**settings)


def test_missing_manifold3d_names_the_extra():
    code = (
        "import sys; sys.modules['manifold3d'] = None\n"
        "import numpy as np\nfrom unghost.data_recipes.solids.csg import random_solid\n"
        "random_solid(np.random.default_rng(0))"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert "MissingExtra: csg: boolean solids need manifold3d: pip install unghost[recipes]" in run.stderr
