"""Cells of a regular grid that line segments pass through. Lengths are in cells: the grid is ``[0, shape]``."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

LINES_AT_ONCE = 2048  # what they cross fits in a core's cache
CELLS_AT_ONCE = 1 << 22  # counted together, as each count goes once over the whole block
THREADS = 2
LEAST_IN_THREADS = 8192  # lines


@dataclass(frozen=True)
class Block:
    """The part ``low <= cell < low + shape`` of a grid: arrays over it say nothing of the rest, which is empty.

    Attributes:
        low: ``(3,)`` its lowest cell.
        shape: its number of cells along each axis.
        grid_shape: that of the grid.

    Example:
        >>> block = Block.around(np.array([[5.5, 1.0, 0.2], [6.5, 1.0, 0.2]]), (9, 9, 9), reach=1)
        >>> block.low.tolist(), block.shape
        ([4, 0, 0], (4, 3, 2))
    """

    low: IntArray
    shape: tuple[int, ...]
    grid_shape: tuple[int, ...]

    @classmethod
    def around(cls, places: FloatArray, grid_shape: tuple[int, ...], *, reach: int) -> Block:
        """Smallest block with all cells within ``reach`` cells of ``places (N, 3)``, as far as the grid goes."""
        size = np.array(grid_shape)
        if not len(places):
            return cls(np.zeros(3, dtype=np.int64), (1, 1, 1), grid_shape)
        low = np.clip(np.floor(places.min(axis=0)) - reach, 0, size - 1).astype(np.int64)
        high = np.clip(np.floor(places.max(axis=0)) + reach + 1, low + 1, size).astype(np.int64)
        return cls(low, tuple(int(side) for side in high - low), grid_shape)

    def whole(self, values: NDArray[Any]) -> NDArray[Any]:
        """``values`` of the block as an array over the grid, 0 elsewhere."""
        return self.moved(values, Block(np.zeros(3, dtype=np.int64), self.grid_shape, self.grid_shape))

    def moved(self, values: NDArray[Any], to: Block) -> NDArray[Any]:
        """``values`` of the block as an array over another of the same grid, 0 where only that one has cells."""
        low = np.maximum(self.low, to.low)
        high = np.maximum(np.minimum(self.low + np.array(self.shape), to.low + np.array(to.shape)), low)
        result = np.zeros(to.shape, dtype=values.dtype)
        result[_slices(low - to.low, high - to.low)] = values[_slices(low - self.low, high - self.low)]
        return result


def _slices(low: IntArray, high: IntArray) -> tuple[slice, ...]:
    return tuple(slice(begin, end) for begin, end in zip(low.tolist(), high.tolist()))


def segment_shares(
    starts: FloatArray, ends: FloatArray, shape: tuple[int, ...]
) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """Where segments ``(L, 3)`` enter and leave the grid, as shares of their length, and which of them meet it."""
    along = ends - starts
    with np.errstate(divide="ignore", invalid="ignore"):
        low, high = -starts / along, (np.array(shape, dtype=float) - starts) / along
    parallel, within = along == 0, (starts >= 0) & (starts <= np.array(shape))
    enter = np.where(parallel, np.where(within, -np.inf, np.inf), np.minimum(low, high)).max(axis=1)
    leave = np.where(parallel, np.where(within, np.inf, -np.inf), np.maximum(low, high)).min(axis=1)
    enter, leave = np.maximum(enter, 0.0), np.minimum(leave, 1.0)
    meets: NDArray[np.bool_] = enter < leave
    return enter, leave, meets


def clip_segments(
    starts: FloatArray, ends: FloatArray, shape: tuple[int, ...]
) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """The parts of segments ``(L, 3)`` within the grid, and which segments have one."""
    enter, leave, meets = segment_shares(starts, ends, shape)
    along = ends[meets] - starts[meets]
    first, last = (starts[meets] + share[meets, None] * along for share in (enter, leave))
    return first, last, meets


class GridTraversal:
    """Segments ``(L, 3)`` within a block of a grid. A segment of no length passes through the cell that it is in."""

    def __init__(self, block: Block, starts: FloatArray, ends: FloatArray) -> None:
        self.block, self.starts, self.ends = block, starts, ends

    def count(self, chosen: NDArray[np.bool_]) -> IntArray:
        """How many of the chosen segments ``(L,)`` pass through each cell of the block."""
        size = int(np.prod(self.block.shape))

        def counted(lines: IntArray) -> IntArray:
            total, held, number = np.zeros(size, dtype=np.int64), list[IntArray](), 0
            for _, cells, _ in self._crossed(lines):
                held.append(cells)
                number += len(cells)
                if number > max(CELLS_AT_ONCE, size // 2):
                    total += np.bincount(np.concatenate(held), minlength=size)
                    held, number = [], 0
            if number > size // 8:
                total += np.bincount(np.concatenate(held), minlength=size)
            elif number:  # does not go over the whole block, but holds other threads up
                np.add.at(total, np.concatenate(held), 1)
            return total

        parts = _in_threads(counted, np.flatnonzero(chosen))
        for part in parts[1:]:
            parts[0] += part
        return parts[0].reshape(self.block.shape)

    def hit(self, marked: NDArray[np.bool_], *, short_of: float) -> NDArray[np.bool_]:
        """Which segments ``(L,)`` pass through a marked cell farther than ``short_of`` cells from their end.

        Args:
            marked: over the cells of the block.
        """
        along = self.ends - self.starts
        length = np.linalg.norm(along, axis=1)
        share = np.maximum(1.0 - short_of / np.maximum(length, 1e-300), 0.0)
        long = share > 0
        result = np.zeros(len(along), dtype=bool)
        part = GridTraversal(self.block, self.starts[long], (self.starts + share[:, None] * along)[long])
        result[long] = part._hit(marked)
        return result

    def _hit(self, marked: NDArray[np.bool_]) -> NDArray[np.bool_]:
        flat, result = marked.ravel(), np.zeros(len(self.starts), dtype=bool)

        def mark(part: IntArray) -> None:
            for lines, cells, until in self._crossed(part):
                result[lines[np.searchsorted(until, np.flatnonzero(flat[cells]), side="right")]] = True

        _in_threads(mark, np.arange(len(self.starts)))
        return result

    def _crossed(self, lines: IntArray) -> Iterator[tuple[IntArray, IntArray, IntArray]]:
        """The cells that segments pass through, each cell once, some lines and one direction of faces at a time.

        A segment enters a cell through one face. So the cells are the one it starts in and, for every grid plane that
        it crosses, the one behind that plane (Amanatides and Woo 1987, without the order along the segment). Through an
        edge of cells, to rounding, it may pass through either of two cells, or neither of them is found.

        Yields:
            Lines ``(l,)``, flat indices of cells of the block ``(c,)``, line by line, and ``(l,)`` where in these the
            cells of each line end.
        """
        low, most = self.block.low, self.block.low + np.array(self.block.shape) - 1
        stride = [self.block.shape[1] * self.block.shape[2], self.block.shape[2], 1]
        corner = int(low @ stride)
        for begin in range(0, len(lines), LINES_AT_ONCE):
            some = lines[begin : begin + LINES_AT_ONCE]
            start, end = np.ascontiguousarray(self.starts[some].T), np.ascontiguousarray(self.ends[some].T)
            first, last = (np.clip(np.floor(each), low[:, None], most[:, None]) for each in (start, end))
            yield some, (stride @ first).astype(np.int64) - corner, np.arange(1, len(some) + 1)
            for axis in range(3):
                cells, until = _entered(axis, start, end - start, first, last, most, stride)
                cells -= corner
                yield some, cells, until


def _entered(
    axis: int,
    start: FloatArray,
    along: FloatArray,
    first: FloatArray,
    last: FloatArray,
    most: IntArray,
    stride: list[int],
) -> tuple[IntArray, IntArray]:
    """Flat cells behind the planes across ``axis`` that lines ``(3, l)`` cross, and where those of each line end.

    All that is per line is repeated, which is far quicker than to gather it.
    """
    steps = np.abs(last[axis] - first[axis]).astype(np.int64)
    until, up = np.cumsum(steps), last[axis] > first[axis]
    sign = np.where(up, 1.0, -1.0)
    entered = np.arange(until[-1], dtype=np.float64)  # whole numbers: exact
    entered *= np.repeat(sign, steps)
    entered += np.repeat(first[axis] + sign * (1 - (until - steps)), steps)
    share = entered + np.repeat(np.where(up, 0.0, 1.0), steps)  # the plane
    share -= np.repeat(start[axis], steps)
    share /= np.repeat(along[axis], steps)
    cells = entered.astype(np.int64)
    cells *= stride[axis]
    for other in {0, 1, 2} - {axis}:
        place = np.repeat(along[other], steps)
        place *= share
        place += np.repeat(start[other], steps)
        cell = place.astype(np.int64)  # >= 0: truncated is floored
        np.minimum(cell, most[other], out=cell)
        cell *= stride[other]
        cells += cell
    return cells, until


def _in_threads(call: Callable[[IntArray], Any], lines: IntArray) -> list[Any]:
    """Call with interleaved parts of ``lines``, a thread each; numpy's loops run side by side."""
    if len(lines) < LEAST_IN_THREADS:
        return [call(lines)]
    with ThreadPoolExecutor(THREADS) as pool:
        return list(pool.map(call, [lines[index::THREADS] for index in range(THREADS)]))
