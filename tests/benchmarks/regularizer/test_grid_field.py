"""The field that benchmarks of the regularizer train, and the holes that they tear."""

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("tyro")

import torch

from benchmarks.regularizer.filling import RULE, torn
from benchmarks.regularizer.grid_field import GridField
from unghost.fields.adapters.grids import cell_centers
from unghost.scenes.labelled_room.room import AABB, SHAPE, build_room


@pytest.fixture(scope="module")
def room():
    return build_room(20)


@pytest.mark.slow
def test_it_holds_what_it_was_given_at_the_centres_and_can_grow_anywhere(room):
    field = GridField(room.true_density, room.pitch)
    cells = field.cells().detach().numpy()
    assert cells.shape == SHAPE
    np.testing.assert_allclose(cells, np.maximum(room.true_density, 1e-3 / room.pitch), rtol=1e-3)
    chosen = np.random.default_rng(0).integers(0, SHAPE, size=(500, 3))
    places = torch.from_numpy(cell_centers(AABB, SHAPE)[tuple(chosen.T)])
    asked = field(places)
    np.testing.assert_allclose(asked.detach().numpy()[:, 0], cells[tuple(chosen.T)], rtol=0.02, atol=0.02 / room.pitch)
    asked.sum().backward()
    assert (field.table.grad[:, 0] > 0).sum() >= 400  # where there is nothing, too


@pytest.mark.slow
def test_holes_are_part_of_the_solid_and_leave_most_of_it(room):
    again, solid, missing = torn(20)
    np.testing.assert_array_equal(again.true_density, room.true_density)
    assert not (solid & ~room.surface(RULE)).any()
    assert (room.distance[solid] < 0).all()
    assert 0.002 < (missing & solid).sum() / solid.sum() < 0.2
