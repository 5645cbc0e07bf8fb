"""Cells of a regular grid that line segments pass through."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

LINES_AT_ONCE = 4096
THREADS = 2


def clip_segments(
    starts: FloatArray, ends: FloatArray, shape: tuple[int, ...]
) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """The parts of segments within the grid ``[0, shape]``, in cells, and which segments have one."""
    along = ends - starts
    with np.errstate(divide="ignore", invalid="ignore"):
        low, high = -starts / along, (np.array(shape, dtype=float) - starts) / along
    parallel, within = along == 0, (starts >= 0) & (starts <= np.array(shape))
    enter = np.where(parallel, np.where(within, -np.inf, np.inf), np.minimum(low, high)).max(axis=1)
    leave = np.where(parallel, np.where(within, np.inf, -np.inf), np.maximum(low, high)).min(axis=1)
    enter, leave = np.maximum(enter, 0.0), np.minimum(leave, 1.0)
    meets: NDArray[np.bool_] = enter < leave
    first, last = (starts[meets] + share[meets, None] * along[meets] for share in (enter, leave))
    return first, last, meets


class GridTraversal:
    """Segments ``(L, 3)`` within a grid of cells, in cells."""

    def __init__(self, shape: tuple[int, ...], starts: FloatArray, ends: FloatArray) -> None:
        self.shape, self.size = shape, int(np.prod(shape))
        self.starts, self.ends = starts, ends

    def count(self, chosen: NDArray[np.bool_]) -> NDArray[np.int64]:
        """How many of the chosen segments ``(L,)`` pass through each cell."""
        lines = np.flatnonzero(chosen)

        def counted(part: NDArray[np.int64]) -> NDArray[np.int64]:
            total = np.zeros(self.size, dtype=np.int64)
            for start in range(0, len(part), LINES_AT_ONCE):
                for _, cells in self._crossed(part[start : start + LINES_AT_ONCE]):
                    total += np.bincount(cells, minlength=self.size)
            return total

        return np.sum(_in_threads(counted, lines), axis=0).reshape(self.shape)

    def hit(self, marked: NDArray[np.bool_], *, short_of: float) -> NDArray[np.bool_]:
        """Which segments ``(L,)`` pass through a marked cell farther than ``short_of`` cells from their end."""
        along = self.ends - self.starts
        length = np.linalg.norm(along, axis=1)
        share = np.maximum(1.0 - short_of / np.maximum(length, 1e-300), 0.0)
        long = share > 0
        result = np.zeros(len(along), dtype=bool)
        part = GridTraversal(self.shape, self.starts[long], (self.starts + share[:, None] * along)[long])
        result[long] = part._hit(marked)
        return result

    def _hit(self, marked: NDArray[np.bool_]) -> NDArray[np.bool_]:
        flat, result = marked.ravel(), np.zeros(len(self.starts), dtype=bool)

        def mark(part: NDArray[np.int64]) -> None:
            for start in range(0, len(part), LINES_AT_ONCE):
                lines = part[start : start + LINES_AT_ONCE]
                for line, cells in self._crossed(lines):
                    result[lines[line[flat[cells]]]] = True

        _in_threads(mark, np.arange(len(self.starts)))
        return result

    def _crossed(self, lines: NDArray[np.int64]) -> list[tuple[NDArray[np.int64], NDArray[np.int64]]]:
        """Positions in ``lines`` and flat indices of the cells that those segments pass through, each cell once.

        A segment enters a cell through one face. So the cells are the one it starts in and, for every grid plane that
        it crosses, the one behind that plane (Amanatides and Woo 1987, without the order along the segment).
        """
        start, end = self.starts[lines], self.ends[lines]
        along, top = end - start, np.array(self.shape) - 1
        stride = np.array([self.shape[1] * self.shape[2], self.shape[2], 1])
        first = np.clip(np.floor(start).astype(np.int64), 0, top)
        last = np.clip(np.floor(end).astype(np.int64), 0, top)
        found = [(np.arange(len(lines)), first @ stride)]
        for axis in range(3):
            steps = np.abs(last[:, axis] - first[:, axis])
            line = np.repeat(np.arange(len(lines)), steps)
            number = np.arange(len(line)) - np.repeat(np.cumsum(steps) - steps, steps)
            up = last[:, axis] > first[:, axis]
            entered = first[line, axis] + np.where(up, 1, -1)[line] * (number + 1)
            share = (entered + np.where(up, 0, 1)[line] - start[line, axis]) / along[line, axis]
            cells = entered * stride[axis]
            for other in {0, 1, 2} - {axis}:
                place = (start[line, other] + share * along[line, other]).astype(np.int64)  # >= 0: truncated is floored
                cells += np.clip(place, 0, top[other]) * stride[other]
            found.append((line, cells))
        return found


def _in_threads(call: Callable[[NDArray[np.int64]], Any], lines: NDArray[np.int64]) -> list[Any]:
    """Call with interleaved parts of ``lines``, a thread each; numpy's loops run side by side."""
    parts = [lines[index::THREADS] for index in range(THREADS)]
    if len(lines) < 2 * LINES_AT_ONCE:
        return [call(lines)]
    with ThreadPoolExecutor(THREADS) as pool:
        return list(pool.map(call, parts))
