"""Sight lines: the segments between cameras and the sparse points that they observed, which are measured free space."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .aabb import as_aabb
from .cameras import Cameras
from .errors import InvalidArgument
from .interpolate import interpolate_grid, trilinear_corners
from .lattice import lattice_origin
from .sparse_points import SparsePoints

FloatArray = NDArray[np.float64]

MARGIN_CELLS = 2.0  # a surface is spread over some of the field's own cells
MARGIN_SIGMAS = 2.0  # of the point's uncertainty along the ray
REACH = 2  # cells, of a point's support
SURFACE_REACH = 3  # cells around a point that count as its surface where lines and points contradict each other
LINES_AT_ONCE = 4096
THREADS = 2
MOST_CELLS = 1 << 28


@dataclass(frozen=True)
class SightLines:
    """Line and point counts on a grid of cubic cells, built by :meth:`build`.

    Attributes:
        starts, ends: ``(L, 3)`` of the segments, scene units: from the camera to the point less its margin, as far as
            they lie in the box.
        targets: ``(L, 3)`` the points that were observed, scene units; some may lie outside the box.
        crossing_count: ``(X, Y, Z)`` int32, how many segments pass through each cell.
        support_sum: ``(X, Y, Z)`` float32 at the cells' centres, how many points lie near, each with a tent-shaped
            weight that is 1 at the point and 0 from ``REACH`` cells on, along each axis.
        aabb: ``(2, 3)`` box of the grid, scene units.
        pitch: side of its cells, scene units.

    Example:
        >>> from unghost.core.cameras import look_at
        >>> poses = look_at(np.array([[2.0, 0.0, 0.0], [0.0, 2.0, 0.0]]), np.zeros((2, 3)))
        >>> cameras = Cameras.create(poses, np.array([100.0, 100.0, 50.0, 50.0]), width=100, height=100)
        >>> points = SparsePoints.create(np.zeros((1, 3)), point=[0, 0], camera=[0, 1], cameras=cameras)
        >>> lines = SightLines.build(points, cameras, aabb=[[-1.0] * 3, [1.0] * 3], pitch=0.1)
        >>> places = np.array([[0.55, 0.0, 0.0], [-0.55, 0.0, 0.0], [0.0, 0.0, 0.0]])  # before, behind, at the point
        >>> (lines.crossings(places) > 0).tolist(), (lines.support(places) > 0).tolist()
        ([True, False, False], [False, False, True])
    """

    starts: FloatArray
    ends: FloatArray
    targets: FloatArray
    crossing_count: NDArray[np.int32]
    support_sum: NDArray[np.float32]
    aabb: FloatArray
    pitch: float

    @classmethod
    def build(
        cls,
        points: SparsePoints,
        cameras: Cameras,
        *,
        aabb: ArrayLike,
        pitch: float,
        field_pitch: float | None = None,
        margin_cells: float = MARGIN_CELLS,
        margin_sigmas: float = MARGIN_SIGMAS,
        robust: bool = True,
    ) -> SightLines:
        """Trace every observation through the grid.

        Args:
            points: in the frame of ``cameras``, whose indices its observations use.
            cameras: that observed them.
            aabb: ``(2, 3)`` box to cover, scene units; lines from and to places beyond it count where they pass inside.
            pitch: side of the cells of the grid, scene units.
            field_pitch: side of the field's own cells, scene units; None for ``pitch``.
            margin_cells: a segment ends this many of the field's cells before its point,
            margin_sigmas: and this many times the point's uncertainty before that. Points whose rays do not determine
                them give no line.
            robust: drop wrong points and lines by majority. A point in a cell that more lines cross than observations
                end near is dropped with its lines; then so is a line through a cell near which more observations end
                than lines cross. Without it, one wrong point in twelve lets lines pass through most surfaces.

        Raises:
            InvalidArgument: a pitch or margin out of range, too many cells.
        """
        box = as_aabb(aabb, caller="SightLines")
        if not 0 < pitch < np.inf:
            raise InvalidArgument(f"SightLines: pitch must be finite and > 0, got {pitch}")
        if not (margin_cells >= 0 and margin_sigmas >= 0):
            raise InvalidArgument(f"SightLines: margins must be >= 0, got {margin_cells} and {margin_sigmas}")
        sides = np.ceil((box[1] - box[0]) / pitch - 1e-6)
        if sides.prod() > MOST_CELLS:
            raise InvalidArgument(f"SightLines: pitch {pitch} makes {sides.prod():.3g} cells, at most {MOST_CELLS}")
        shape = tuple(int(side) for side in np.maximum(sides, 1))
        origin = lattice_origin(box, pitch, shape)
        margin = margin_cells * (pitch if field_pitch is None else field_pitch)
        starts, ends, owner = _segments(points, cameras, margin, margin_sigmas)
        starts, ends, meets = _clipped((starts - origin) / pitch, (ends - origin) / pitch, shape)
        owner, grid = owner[meets], _Grid(shape, starts, ends)
        places, right, kept = (
            (points.xyz - origin) / pitch,
            np.ones(len(points), dtype=bool),
            np.ones(len(starts), bool),
        )
        count = grid.count(kept)
        if robust:
            views = points.views().astype(float)
            right = ~_outnumbered(places, count, _tents(places, shape, weights=views, reach=SURFACE_REACH))
            count -= grid.count(~right[owner])
            surface = _tents(places[right], shape, weights=views[right], reach=SURFACE_REACH)
            kept = right[owner] & ~grid.hit(np.greater(surface, np.maximum(count, 1)), short_of=SURFACE_REACH)
            count -= grid.count(right[owner] & ~kept)
        support = _tents(places[right], shape)
        starts, ends = (origin + each[kept] * pitch for each in (starts, ends))
        targets = points.xyz[owner[kept]]
        return cls(starts, ends, targets, count.astype(np.int32), support, box, float(pitch))

    def __len__(self) -> int:
        return len(self.starts)

    def crossings(self, positions: NDArray[Any]) -> NDArray[np.float32]:
        """Sight lines through the neighbourhood of ``positions (..., 3)``, relative to a typical crossed cell.

        Returns:
            ``(...)`` float32 >= 0: the interpolated count, divided by the mean count over the cells that any line
            crosses, so that it hardly depends on how many photos and points there are. 0 outside the box.
        """
        return self._look_up(self.crossing_count, positions)

    def support(self, positions: NDArray[Any]) -> NDArray[np.float32]:
        """Sparse points near ``positions (..., 3)``, relative to a typical cell that has some; as :meth:`crossings`."""
        return self._look_up(self.support_sum, positions)

    def sample(self, rng: np.random.Generator, count: int, *, samples: int = 12) -> tuple[FloatArray, FloatArray]:
        """Draw points on random sight lines, stratified along each.

        Args:
            rng: draws lines with replacement, and a place in each of ``samples`` equal parts of each line.
            count: number of lines.
            samples: points a line.

        Returns:
            positions ``(count, samples, 3)`` and segment lengths ``(count,)``, scene units.

        Raises:
            InvalidArgument: there is no line.
        """
        if not len(self):
            raise InvalidArgument("SightLines.sample: there is no sight line: points without observations, or too near")
        which = rng.integers(len(self), size=count)
        along = self.ends[which] - self.starts[which]
        share = (np.arange(samples) + rng.random((count, samples))) / samples
        return self.starts[which][:, None] + share[..., None] * along[:, None], np.linalg.norm(along, axis=1)

    def sample_ends(
        self, rng: np.random.Generator, count: int, *, reach: float, samples: int = 8
    ) -> tuple[FloatArray, float]:
        """Draw points about the observed points of random sight lines, along the lines, stratified.

        Args:
            rng: draws lines with replacement among those whose point lies in the box.
            count: number of lines; fewer come back if no point lies in the box.
            reach: how far before and behind the point, scene units.
            samples: points a line.

        Returns:
            positions ``(count, samples, 3)`` and the length that they cover, ``2 * reach``.
        """
        inside = np.flatnonzero(((self.targets >= self.aabb[0]) & (self.targets <= self.aabb[1])).all(axis=1))
        if not len(inside):
            return np.zeros((0, samples, 3)), 2 * reach
        which = inside[rng.integers(len(inside), size=count)]
        along = self.targets[which] - self.starts[which]
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        offset = reach * (2 * (np.arange(samples) + rng.random((count, samples))) / samples - 1)
        return self.targets[which][:, None] + offset[..., None] * along[:, None], 2 * reach

    def _look_up(self, values: NDArray[Any], positions: NDArray[Any]) -> NDArray[np.float32]:
        places = np.asarray(positions, dtype=np.float64)
        present = values[values > 0]
        if not len(present):
            return np.zeros(places.shape[:-1], dtype=np.float32)
        origin = lattice_origin(self.aabb, self.pitch, values.shape)
        inside = ((places >= self.aabb[0]) & (places <= self.aabb[1])).all(axis=-1)
        local = np.where(inside[..., None], (places - origin) / self.pitch - 0.5, 0.0)
        found = interpolate_grid(values.astype(np.float32), local.astype(np.float32)) / present.mean()
        return np.where(inside, found, 0.0).astype(np.float32)


def _segments(
    points: SparsePoints, cameras: Cameras, margin: float, sigmas: float
) -> tuple[FloatArray, FloatArray, NDArray[np.int64]]:
    """Starts and ends ``(L, 3)`` of the segments that are longer than their margins, and the points they end at."""
    origins, targets = cameras.origins[points.camera], points.xyz[points.point]
    offset = targets - origins
    distance = np.linalg.norm(offset, axis=1)
    uncertainty = np.nan_to_num(points.uncertainty, nan=0.0, posinf=np.inf)[points.point]
    with np.errstate(invalid="ignore"):
        keep = distance - margin - (sigmas * uncertainty if sigmas else 0.0)
        share = np.divide(keep, distance, out=np.zeros_like(distance), where=distance > 0)
    long: NDArray[np.bool_] = np.isfinite(share) & (share > 0)
    return origins[long], origins[long] + share[long, None] * offset[long], points.point[long]


def _outnumbered(places: FloatArray, count: NDArray[np.int64], near: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Which points (in cells) lie in a cell that more lines cross than observations end near."""
    cells = np.floor(places).astype(np.int64)
    inside: NDArray[np.bool_] = np.logical_and.reduce((cells >= 0) & (cells < np.array(count.shape)), axis=1)
    index = tuple(np.where(inside[:, None], cells, 0).T)
    outnumbered: NDArray[np.bool_] = inside & (count[index] > near[index])
    return outnumbered


def _clipped(
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


class _Grid:
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
        result[long] = _Grid(self.shape, self.starts[long], (self.starts + share[:, None] * along)[long])._hit(marked)
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


def _tents(
    places: FloatArray, shape: tuple[int, ...], *, weights: FloatArray | None = None, reach: int = REACH
) -> NDArray[np.float32]:
    """Sum of weighted tents ``prod max(0, 1 - |cell centre - point| / reach)`` over points; places in cells."""
    near = ((places > -reach) & (places < np.array(shape) + reach)).all(axis=1)
    padded = tuple(length + 2 * reach + 2 for length in shape)
    index, shares = trilinear_corners(places[near] + reach + 0.5, padded)
    shares = shares if weights is None else shares * weights[near, None]
    flat = np.bincount(index.ravel(), weights=shares.ravel(), minlength=int(np.prod(padded)))
    total: FloatArray = flat.astype(np.float64).reshape(padded)
    taps = 1.0 - np.abs(np.arange(1 - reach, reach)) / reach  # tents of one cell to tents of `reach` cells, exactly
    for axis in range(3):
        total = _convolved(total, taps, axis)
    inner = tuple(slice(reach + 1, reach + 1 + length) for length in shape)
    return total[inner].astype(np.float32)


def _convolved(values: FloatArray, taps: FloatArray, axis: int) -> FloatArray:
    """Along one axis, with an odd number of symmetric taps, zeros beyond the ends."""
    half = len(taps) // 2
    moved = np.moveaxis(values, axis, 0)
    result = taps[half] * moved
    for step in range(1, half + 1):
        result[step:] += taps[half + step] * moved[:-step]
        result[:-step] += taps[half - step] * moved[step:]
    return np.moveaxis(result, 0, axis)
