"""Where a step's cubes lie, turned ones included."""

import numpy as np
import pytest
import torch

from unghost.core.frames import cube_lattices
from unghost.regularizer.cubes import draw_cubes
from unghost.regularizer.proposals import ImportanceGrid
from unghost.regularizer.settings import RegularizerSettings

BOX = np.array([[-1.0, 0.0, 2.0], [1.0, 4.0, 3.0]])


def drawn(rotate, *, edges=(0.01, 0.1), count=60):
    grid = ImportanceGrid(BOX, resolution=4)
    settings = RegularizerSettings(cubes=count, edge_range=edges, rotate=rotate, strategy="uniform")
    return draw_cubes(
        grid, np.random.default_rng(7), settings, field_pitch=None, resolution=8, device=torch.device("cpu")
    )


def test_turned_cubes_are_the_others_turned_about_their_middles():
    upright, turned = drawn(False), drawn(True)
    assert upright.rotations is None
    np.testing.assert_array_equal(upright.edges, turned.edges)
    np.testing.assert_allclose(
        turned.rotations @ turned.rotations.swapaxes(1, 2), np.tile(np.eye(3), (60, 1, 1)), atol=1e-9
    )
    assert len(np.unique(turned.rotations.round(6), axis=0)) == 60
    for cubes in (upright, turned):
        expected = cube_lattices(cubes.centers, cubes.edges, cubes.rotations, resolution=8)
        np.testing.assert_allclose(cubes.positions.numpy(), expected, atol=1e-5)


@pytest.mark.parametrize("rotate", [False, True])
def test_a_cube_that_fits_lies_in_the_box_and_a_larger_one_is_centred(rotate):
    assert bool(drawn(rotate).inside.all())
    large = drawn(rotate, edges=(0.5, 0.5), count=5)  # edge 2: the box is 1 high
    np.testing.assert_allclose(large.centers[:, 2], 2.5)
    assert 0 < float(large.inside.float().mean()) < 1


def test_some_frames():
    for rotate in (False, True):
        cubes = drawn(rotate, count=3)
        centers, edges, rotations = cubes.frames(torch.tensor([True, False, True]))
        np.testing.assert_array_equal(centers, cubes.centers[[0, 2]])
        np.testing.assert_array_equal(edges, cubes.edges[[0, 2]])
        assert (rotations is None) == (not rotate)
        assert rotations is None or np.array_equal(rotations, cubes.rotations[[0, 2]])
