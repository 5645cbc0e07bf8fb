from fractions import Fraction
from itertools import product

import numpy as np
import pytest

from unghost.core import grid_traversal
from unghost.core.grid_traversal import Block, GridTraversal, clip_segments

SHAPE = (7, 5, 4)
WHOLE = Block(np.zeros(3, dtype=np.int64), SHAPE, SHAPE)


def exact_cells(start, end, shape=SHAPE):
    """Cells that a segment passes through over a positive length, in exact rational arithmetic."""
    start, end = [Fraction(float(v)) for v in start], [Fraction(float(v)) for v in end]
    found = set()
    for cell in product(*map(range, shape)):
        enter, leave = Fraction(0), Fraction(1)
        for low, begin, finish in zip(cell, start, end):
            along = finish - begin
            if along == 0:
                leave = leave if low <= begin < low + 1 else Fraction(-1)
            else:
                first, last = sorted(((low - begin) / along, (low + 1 - begin) / along))
                enter, leave = max(enter, first), min(leave, last)
        if leave > enter:
            found.add(cell)
    return found


def cells_of(start, end, block=WHOLE):
    grid = GridTraversal(block, np.atleast_2d(start).astype(float), np.atleast_2d(end).astype(float))
    count = block.whole(grid.count(np.ones(len(grid.starts), dtype=bool)))
    assert count.max() == 1
    return set(zip(*(axis.tolist() for axis in np.nonzero(count))))


def segments(count, seed=0):
    return np.random.default_rng(seed).uniform(0, SHAPE, (2, count, 3))


def test_cells_are_those_of_exact_arithmetic():
    for start, end in zip(*segments(60)):
        assert cells_of(start, end) == exact_cells(start, end) == cells_of(end, start)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("digits", [1, 9, 15])
def test_segments_almost_along_an_axis(axis, digits):
    start = np.array([0.5, 0.5, 0.5])
    end = start + 10.0**-digits
    end[axis] = SHAPE[axis] - 0.25
    assert cells_of(start, end) == exact_cells(start, end)
    end = start.copy()
    end[axis] = SHAPE[axis] - 0.25
    assert cells_of(start, end) == exact_cells(start, end)
    assert len(cells_of(start, end)) == SHAPE[axis]


def test_a_segment_of_no_length_is_in_one_cell():
    assert cells_of([2.5, 1.5, 0.5], [2.5, 1.5, 0.5]) == {(2, 1, 0)}
    assert cells_of(SHAPE, SHAPE) == {(6, 4, 3)}  # on the grid's farthest corner


def test_parts_do_not_matter(monkeypatch):
    starts, ends = segments(3000)
    chosen = np.random.default_rng(1).random(3000) < 0.7
    whole = GridTraversal(WHOLE, starts, ends)
    count, marked = whole.count(chosen), np.random.default_rng(2).random(SHAPE) < 0.02
    hit = whole.hit(marked, short_of=0.5)
    assert 0 < hit.sum() < len(hit)
    for name, value in (("LINES_AT_ONCE", 7), ("CELLS_AT_ONCE", 100), ("LEAST_IN_THREADS", 10)):
        monkeypatch.setattr(grid_traversal, name, value)
        np.testing.assert_array_equal(whole.count(chosen), count)
        np.testing.assert_array_equal(whole.hit(marked, short_of=0.5), hit)


def test_a_block_holds_all_that_the_grid_does():
    starts, ends = (2 + each / 4 for each in segments(50))
    wide = (40, 30, 20)
    block = Block.around(np.concatenate([starts, ends]), wide, reach=1)
    assert np.prod(block.shape) < 0.01 * np.prod(wide)
    all_lines = np.ones(50, dtype=bool)
    grid = Block(np.zeros(3, dtype=np.int64), wide, wide)
    expected = GridTraversal(grid, starts, ends).count(all_lines)
    np.testing.assert_array_equal(block.whole(GridTraversal(block, starts, ends).count(all_lines)), expected)


def test_a_block_moves_to_another():
    grid = (6, 5, 4)
    one, other = Block(np.array([1, 0, 2]), (3, 2, 2), grid), Block(np.array([2, 1, 0]), (4, 4, 3), grid)
    values = np.arange(1, 13).reshape(3, 2, 2)
    whole = one.whole(values)
    assert whole.shape == grid
    assert whole.sum() == values.sum()
    assert whole[3, 1, 2] == values[2, 1, 0]
    np.testing.assert_array_equal(one.moved(values, other), whole[2:6, 1:5, 0:3])
    apart = Block(np.array([5, 4, 0]), (1, 1, 1), grid)
    assert one.moved(values, apart).tolist() == [[[0]]]


def test_hit_line_by_line():
    starts, ends = segments(60, seed=3)
    marked = np.random.default_rng(4).random(SHAPE) < 0.05
    length = np.linalg.norm(ends - starts, axis=1)
    short = starts + np.maximum(1 - 1.0 / length, 0)[:, None] * (ends - starts)
    expected = [
        far > 1.0 and any(marked[cell] for cell in exact_cells(start, end))
        for start, end, far in zip(starts, short, length)
    ]
    assert 0 < sum(expected) < 60
    assert GridTraversal(WHOLE, starts, ends).hit(marked, short_of=1.0).tolist() == expected


def test_clipping_by_hand():
    starts = np.array([[-7.0, 2.5, 2.0], [1.0, 1.0, 1.0], [-1.0, 9.0, 1.0], [3.0, 5.5, 1.0], [1e9, 2.0, 2.0]])
    ends = np.array([[14.0, 2.5, 2.0], [2.0, 2.0, 2.0], [8.0, 9.0, 1.0], [4.0, 5.5, 1.0], [-1e9, 2.0, 2.0]])
    first, last, meets = clip_segments(starts, ends, SHAPE)
    assert meets.tolist() == [True, True, False, False, True]
    np.testing.assert_allclose(first, [[0, 2.5, 2], [1, 1, 1], [7, 2, 2]], atol=1e-6)
    np.testing.assert_allclose(last, [[7, 2.5, 2], [2, 2, 2], [0, 2, 2]], atol=1e-6)
