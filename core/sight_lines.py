"""Sight lines: the segments between cameras and the sparse points that they observed, which are measured free space."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .aabb import as_aabb
from .cameras import Cameras
from .errors import InvalidArgument
from .grid_traversal import GridTraversal, clip_segments
from .interpolate import interpolate_grid, trilinear_corners
from .lattice import lattice_origin
from .sparse_points import SparsePoints

FloatArray = NDArray[np.float64]

MARGIN_CELLS = 2.0  # a surface is spread over some of the field's own cells
MARGIN_SIGMAS = 2.0  # of the point's uncertainty along the ray
REACH = 2  # cells, of a point's support
SURFACE_REACH = 3  # cells around a point that count as its surface where lines and points contradict each other
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
        starts, ends, meets = clip_segments((starts - origin) / pitch, (ends - origin) / pitch, shape)
        owner, grid = owner[meets], GridTraversal(shape, starts, ends)
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
