import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from unghost.regularizer.proposals import ImportanceGrid, sample_edges

BOX = np.array([[-1.0, 0.0, 2.0], [1.0, 4.0, 3.0]])


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**31), count=st.integers(0, 300))
def test_observe_equals_a_loop_duplicates_included(seed, count):
    rng = np.random.default_rng(seed)
    grid = ImportanceGrid(BOX, resolution=4, decay=0.75)
    expected, seen = np.zeros((4, 4, 4)), np.zeros((4, 4, 4), bool)
    for _ in range(2):
        positions = BOX[0] + rng.random((count, 3)) * (BOX[1] - BOX[0])
        values = rng.random(count) * 2
        cells = {}
        for position, value in zip(positions, values):
            cell = tuple(int(c) for c in (position - BOX[0]) / (BOX[1] - BOX[0]) * 4)
            cells.setdefault(cell, []).append(min(value, 1.0))
        for cell, found in cells.items():
            mean = sum(found) / len(found)
            expected[cell] = 0.75 * expected[cell] + 0.25 * mean if seen[cell] else mean
            seen[cell] = True
        grid.observe(positions, values)
    np.testing.assert_allclose(grid.values, expected, atol=1e-12)
    assert (grid.observed == seen).all()


def test_points_outside_are_dropped_and_counted_and_the_border_belongs():
    grid = ImportanceGrid(BOX, resolution=2)
    assert grid.observe([[9.0, 1, 2.5], [1.0, 4.0, 3.0], [np.nan, 1, 2.5]], [1.0, 0.5, 1.0]) == 2
    assert grid.dropped == 2
    assert grid.values[1, 1, 1] == 0.5
    assert grid.values.sum() == 0.5


def test_deleted_matter_fades():
    grid = ImportanceGrid(BOX, resolution=1, decay=0.5)
    place = [BOX.mean(axis=0)]
    for value, expected in ((1.0, 1.0), (0.0, 0.5), (0.0, 0.25)):
        grid.observe(place, [value])
        assert grid.values[0, 0, 0] == expected


def test_importance_follows_the_values():
    grid = ImportanceGrid(BOX, resolution=2)
    cells = grid.cell_points(np.random.default_rng(0))
    values = np.zeros(8)
    values[[1, 6]] = 0.25, 0.75
    grid.observe(cells, values)
    centers = grid.sample(np.random.default_rng(1), 8000, strategy="importance")
    index = ((centers - BOX[0]) / (BOX[1] - BOX[0]) * 2).astype(int) @ [4, 2, 1]
    share = np.bincount(index, minlength=8) / 8000
    np.testing.assert_allclose(share, [0, 0.25, 0, 0, 0, 0, 0.75, 0], atol=0.02)
    mixed = grid.sample(np.random.default_rng(1), 8000, uniform_share=0.4)
    index = ((mixed - BOX[0]) / (BOX[1] - BOX[0]) * 2).astype(int) @ [4, 2, 1]
    np.testing.assert_allclose(np.bincount(index, minlength=8)[[0, 6]] / 8000, [0.05, 0.6 * 0.75 + 0.05], atol=0.02)


def test_an_empty_grid_and_uniform_cover_the_box():
    grid = ImportanceGrid(BOX)
    for strategy in ("mixed", "importance", "uniform"):
        centers = grid.sample(np.random.default_rng(0), 4000, strategy=strategy)
        assert ((centers >= BOX[0]) & (centers <= BOX[1])).all()
        np.testing.assert_allclose(centers.mean(axis=0), BOX.mean(axis=0), atol=0.06)
    assert grid.sample(np.random.default_rng(0), 0).shape == (0, 3)


def test_sampling_is_repeatable_and_leaves_the_grid_alone():
    grid = ImportanceGrid(BOX)
    grid.observe(grid.cell_points(np.random.default_rng(0)), np.full(8000, 0.5))
    before = grid.values.copy()
    first, second = (grid.sample(np.random.default_rng(7), 10) for _ in range(2))
    assert (first == second).all()
    assert (grid.values == before).all()


def test_edges():
    rng = np.random.default_rng(0)
    paper = sample_edges(rng, 5000, aabb=BOX)
    assert paper.min() >= 0.04
    assert paper.max() <= 0.4  # the extent is 4
    assert np.median(paper) == pytest.approx(4 * np.sqrt(0.01 * 0.1), rel=0.05)
    field = sample_edges(rng, 5000, aabb=BOX, field_pitch=0.1)
    assert field.min() >= 32 * 0.05
    assert field.max() <= 32 * 0.125
    own = sample_edges(rng, 10, aabb=BOX, edge_range=(0.2, 0.2), field_pitch=0.1)
    np.testing.assert_allclose(own, 0.8)
    per_cube = sample_edges(rng, 2, aabb=BOX, field_pitch=np.array([0.1, 10.0]))
    assert per_cube[0] <= 4
    assert per_cube[1] >= 160


def test_errors():
    grid = ImportanceGrid(BOX)
    with pytest.raises(ValueError, match=r"min < max on every axis, y fails"):
        ImportanceGrid([[0, 1, 0], [1, 0, 1]])
    with pytest.raises(ValueError, match="must match"):
        grid.observe(np.zeros((4, 3)), np.zeros(3))
    with pytest.raises(ValueError, match=r"1 of 2 that are not; first nan"):
        grid.observe(np.zeros((2, 3)), [1.0, np.nan])
    with pytest.raises(ValueError, match="strategy must be one of"):
        grid.sample(np.random.default_rng(0), 1, strategy="greedy")
    with pytest.raises(ValueError, match="edge_range must satisfy"):
        sample_edges(np.random.default_rng(0), 1, aabb=BOX, edge_range=(0.2, 0.1))
    with pytest.raises(ValueError, match="decay"):
        ImportanceGrid(BOX, decay=1.0)
