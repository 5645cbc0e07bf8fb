"""Sight lines: the segments between cameras and the sparse points that they observed, which are measured free space."""

from __future__ import annotations

import dataclasses
import functools
import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .aabb import as_aabb
from .cameras import Cameras
from .errors import InvalidArgument
from .grid_traversal import Block, GridTraversal, clip_segments, segment_shares
from .interpolate import corner_weights, interpolate_grid, lower_nodes
from .lattice import lattice_origin
from .sparse_points import SparsePoints

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

MARGIN_CELLS = 2.0  # a surface is spread over some of the field's own cells
MARGIN_SIGMAS = 2.0  # of the point's uncertainty along the ray
REACH = 2  # cells, of a point's support
SURFACE_REACH = 3  # cells around a point that count as its surface where lines and points contradict each other
MOST_CELLS = 1 << 28
MOST_REACH = float(1 << 20)  # times the box; farther away a contracted field has less than a cell
SHELL_CELLS = 2  # cells beyond the box are so many times as coarse, for their distance, as those in it


@dataclass(frozen=True)
class SightLines:
    """Line and point counts on a grid of cubic cells, built by :meth:`build`.

    Attributes:
        starts, ends: ``(L, 3)`` of the segments, scene units: from the camera to the point less its margin, as far as
            they lie in the box (of a shell: in the box and beyond the next smaller one).
        targets: ``(L, 3)`` the points that were observed, scene units; some may lie outside the box.
        uncertainty: ``(L,)`` of these points along their rays, scene units; 0 where unknown.
        crossing_count: ``(X, Y, Z)`` int32, how many segments pass through each cell.
        support_sum: ``(X, Y, Z)`` float32 at the cells' centres, how many points lie near, each with a tent-shaped
            weight that is 1 at the point and 0 from ``REACH`` cells on, along each axis.
        aabb: ``(2, 3)`` box of the grid, scene units.
        pitch: side of its cells, scene units.
        crossed, crossed_block: ``crossing_count`` of the part of the grid that holds all lines; memory and time go with
            what it holds, not with the box.
        supported, supported_block: the same of ``support_sum`` and the points.
        shells: the same for boxes that are twice as wide each, without what the next smaller one holds; empty unless
            ``reach`` > 1.
        far_starts, far_targets, far_uncertainty: the cameras of ``(F, 3)``, the points at the end of ``(F, 3)``, and
            their uncertainty ``(F,)``, for lines that end in the shells.
        report: counts of ``observations`` and, of these, ``too_near`` (nothing is left before the margin, or the rays
            do not determine the point), ``outside`` (the segment does not meet the box) and ``outvoted``.

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
    uncertainty: FloatArray
    crossed: NDArray[np.int32]
    crossed_block: Block
    supported: NDArray[np.float32]
    supported_block: Block
    aabb: FloatArray
    pitch: float
    shells: tuple[SightLines, ...] = ()
    far_starts: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    far_targets: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    far_uncertainty: FloatArray = field(default_factory=lambda: np.zeros(0))
    report: dict[str, int] = field(default_factory=dict)

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
        reach: float = 1.0,
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
            reach: how many times the box lines, look-ups and samples go out to, in [1, 2^20]. What lies beyond the box
                is kept in shells, each twice as wide as the one before with cells twice as wide, as those of a
                contracted field (mip-NeRF 360) grow; margins grow likewise. What lies in the box stays as it is; what
                is outvoted there is left out of the shells, too.

        Raises:
            InvalidArgument: a pitch, margin or reach out of range, too many cells.
        """
        box = as_aabb(aabb, caller="SightLines")
        if not 0 < pitch < np.inf:
            raise InvalidArgument(f"SightLines: pitch must be finite and > 0, got {pitch}")
        if not (margin_cells >= 0 and margin_sigmas >= 0):
            raise InvalidArgument(f"SightLines: margins must be >= 0, got {margin_cells} and {margin_sigmas}")
        if not 1 <= reach <= MOST_REACH:
            raise InvalidArgument(f"SightLines: reach must be in [1, {MOST_REACH:.0f}], got {reach}")
        cell = pitch if field_pitch is None else field_pitch
        votes = _Votes(np.ones(len(points), dtype=bool), np.ones(len(points.point), dtype=bool), robust)
        margin = np.full(len(points), margin_cells * cell)
        segments = _segments(points, cameras, margin, margin_sigmas)
        result = cls._traced(points, segments, votes, box=box, pitch=pitch, inner=None)
        if reach == 1:
            return result
        margin = margin * contracted_growth(points.xyz, box, margin_cells * cell)
        segments, shells, inner = _segments(points, cameras, margin, margin_sigmas), list[SightLines](), box
        for level in range(1, math.ceil(math.log2(reach)) + 1):
            outer = _grown(box, min(2.0**level, reach))
            coarse = SHELL_CELLS * pitch * 2.0**level
            shells.append(cls._traced(points, segments, votes, box=outer, pitch=coarse, inner=inner))
            inner = outer
        ends = segments[2][votes.kept[segments[2]]]
        targets = points.xyz[points.point[ends]]
        far = votes.right[points.point[ends]] & _within(targets, inner) & ~_within(targets, box)
        origins = cameras.origins[points.camera[ends]]
        return dataclasses.replace(
            result,
            shells=tuple(shells),
            far_starts=origins[far],
            far_targets=targets[far],
            far_uncertainty=_known_uncertainty(points)[points.point[ends]][far],
        )

    @classmethod
    def _traced(
        cls,
        points: SparsePoints,
        segments: tuple[FloatArray, FloatArray, NDArray[np.int64]],
        votes: _Votes,
        *,
        box: FloatArray,
        pitch: float,
        inner: FloatArray | None,
    ) -> SightLines:
        """One box, without what lies in ``inner``; the votes of its cells are added to ``votes``."""
        shape = _grid_shape(box, pitch)
        origin = lattice_origin(box, pitch, shape)
        alive = votes.kept[segments[2]]
        starts, ends, observation = segments[0][alive], segments[1][alive], segments[2][alive]
        starts, ends = (starts - origin) / pitch, (ends - origin) / pitch
        if inner is None:
            starts, ends, meets = clip_segments(starts, ends, shape)
            which = np.flatnonzero(meets)
        else:
            starts, ends, which = _shell_pieces(starts, ends, (box - origin) / pitch, (inner - origin) / pitch)
        report = {
            "observations": len(points.point),
            "too_near": len(points.point) - len(segments[2]),
            "outside": len(segments[2]) - _number_of(observation[which], len(points.point)),
        }
        observation = observation[which]
        owner, places = points.point[observation], (points.xyz - origin) / pitch
        here = np.ones(len(points), dtype=bool) if inner is None else ~_within(points.xyz, inner)
        block = Block.around(np.concatenate([starts, ends]), shape, reach=1)
        around = Block.around(places[_near(places, shape, SURFACE_REACH)], shape, reach=SURFACE_REACH + 1)
        grid, kept = GridTraversal(block, starts, ends), np.ones(len(starts), dtype=bool)
        count, right = grid.count(kept), votes.right
        if votes.robust:
            views = points.views().astype(float) * right
            near = _tents(places, around, weights=views, reach=SURFACE_REACH)
            right &= ~(here & _outnumbered(places, block.moved(count, around), near, around))
            count -= grid.count(~right[owner])
            surface = _tents(places[right], around, weights=views[right], reach=SURFACE_REACH)
            surface = np.greater(surface, np.maximum(block.moved(count, around), 1))
            kept = right[owner] & ~grid.hit(around.moved(surface, block), short_of=SURFACE_REACH)
            votes.kept[observation[~kept]] = False
            kept = votes.kept[observation]
            count -= grid.count(right[owner] & ~kept)
        report["outvoted"] = _number_of(observation[~kept], len(points.point))
        support = _tents(places[right & here], around)
        starts, ends = (origin + each[kept] * pitch for each in (starts, ends))
        targets, uncertainty = points.xyz[owner[kept]], _known_uncertainty(points)[owner[kept]]
        crossed = count.astype(np.int32)
        return cls(
            starts, ends, targets, uncertainty, crossed, block, support, around, box, float(pitch), report=report
        )

    def __len__(self) -> int:
        """Number of segments, those of the shells too."""
        return len(self.starts) + sum(len(shell.starts) for shell in self.shells)

    @functools.cached_property
    def crossing_count(self) -> NDArray[np.int32]:
        """``(X, Y, Z)`` int32, how many segments pass through each cell."""
        return self.crossed_block.whole(self.crossed)

    @functools.cached_property
    def support_sum(self) -> NDArray[np.float32]:
        """``(X, Y, Z)`` float32 at the cells' centres, how many points lie near."""
        return self.supported_block.whole(self.supported)

    def crossings(self, positions: NDArray[Any]) -> NDArray[np.float32]:
        """Sight lines through the neighbourhood of ``positions (..., 3)``, relative to a typical crossed cell.

        Returns:
            ``(...)`` float32 >= 0: the interpolated count, divided by the mean count over the cells that any line
            crosses, so that it hardly depends on how many photos and points there are. 0 outside the box, or beyond
            ``reach`` times it; between the two, relative to a typical cell of the same shell.
        """
        return self._look_up("_crossings", positions)

    def support(self, positions: NDArray[Any]) -> NDArray[np.float32]:
        """Sparse points near ``positions (..., 3)``, relative to a typical cell that has some; as :meth:`crossings`."""
        return self._look_up("_support", positions)

    def sample(self, rng: np.random.Generator, count: int, *, samples: int = 12) -> tuple[FloatArray, FloatArray]:
        """Draw points on random sight lines, stratified along each.

        Args:
            rng: draws lines with replacement, and a place in each of ``samples`` equal parts of each line. Each shell's
                part of a line is a line of its own, so that places are not all drawn far away.
            count: number of lines.
            samples: points a line.

        Returns:
            positions ``(count, samples, 3)`` and segment lengths ``(count,)``, scene units.

        Raises:
            InvalidArgument: there is no line.
        """
        if not len(self):
            raise InvalidArgument("SightLines.sample: there is no sight line: points without observations, or too near")
        starts, along, lengths = self._segments
        which = rng.integers(len(self), size=count)
        share = (np.arange(samples) + rng.random((count, samples))) / samples
        return starts[which][:, None] + share[..., None] * along[which][:, None], lengths[which]

    def sample_ends(
        self, rng: np.random.Generator, count: int, *, reach: float, samples: int = 8
    ) -> tuple[FloatArray, float | FloatArray]:
        """Draw points about the observed points of random sight lines, along the lines, stratified.

        Args:
            rng: draws lines with replacement among those whose point lies in the box or in a shell, and whose
                uncertainty is at most ``reach``: of any other it is not known that matter is within reach.
            count: number of lines; none come back if there is no such line.
            reach: how far before and behind the point, scene units. Beyond the box it grows as the cells of a
                contracted field do.
            samples: points a line.

        Returns:
            positions ``(count, samples, 3)`` and the length that they cover: ``2 * reach``, with shells ``(count,)``.
        """
        targets, directions, uncertainty = self._ends
        most = reach * contracted_growth(targets, self.aabb, reach) if self.shells else reach
        certain = np.flatnonzero(uncertainty <= most)
        if not len(certain):
            return np.zeros((0, samples, 3)), 2 * reach
        which = certain[rng.integers(len(certain), size=count)]
        offset = reach * (2 * (np.arange(samples) + rng.random((count, samples))) / samples - 1)
        covered: float | FloatArray = 2 * reach
        if self.shells:
            growth = contracted_growth(targets[which], self.aabb, reach)
            offset, covered = offset * growth[:, None], 2 * reach * growth
        return targets[which][:, None] + offset[..., None] * directions[which][:, None], covered

    @functools.cached_property
    def _segments(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Starts, offsets ``(L, 3)`` and lengths ``(L,)`` of all segments."""
        levels = (self, *self.shells)
        starts = np.concatenate([level.starts for level in levels])
        along = np.concatenate([level.ends for level in levels]) - starts
        return starts, along, np.linalg.norm(along, axis=1)

    @functools.cached_property
    def _ends(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Points that lines lead to, in the box and then beyond it, and the lines' directions ``(N, 3)``."""
        here = _within(self.targets, self.aabb)
        targets = np.concatenate([self.targets[here], self.far_targets])
        along = targets - np.concatenate([self.starts[here], self.far_starts])
        uncertainty = np.concatenate([self.uncertainty[here], self.far_uncertainty])
        return targets, along / np.linalg.norm(along, axis=1, keepdims=True), uncertainty

    @functools.cached_property
    def _crossings(self) -> tuple[Block, NDArray[np.float32], Any]:
        """Values over a block, and what to divide by."""
        present = self.crossed[self.crossed > 0]
        return self.crossed_block, self.crossed.astype(np.float32), present.mean() if len(present) else None

    @functools.cached_property
    def _support(self) -> tuple[Block, NDArray[np.float32], Any]:
        """As :meth:`_crossings`."""
        present = self.supported[self.supported > 0]
        return self.supported_block, self.supported, present.mean() if len(present) else None

    def _look_up(self, name: str, positions: NDArray[Any]) -> NDArray[np.float32]:
        places = np.asarray(positions, dtype=np.float64)
        flat = places.reshape(-1, 3)
        result, rest, inner = np.zeros(len(flat), dtype=np.float32), np.arange(len(flat)), None
        for level in (self, *self.shells):
            places_here = flat if inner is None else flat[rest]
            inside = _within(places_here, level.aabb)
            level._interpolate(name, places_here, inside, rest, result)
            rest, inner = rest[~inside], level.aabb
        return result.reshape(places.shape[:-1])

    def _interpolate(
        self, name: str, places: FloatArray, inside: BoolArray, index: NDArray[np.int64], result: NDArray[np.float32]
    ) -> None:
        """Write the values at ``places[inside]`` to ``result[index[inside]]``; what no block holds stays 0."""
        block, values, typical = getattr(self, name)
        if typical is None:
            return
        origin = lattice_origin(self.aabb, self.pitch, block.grid_shape)
        low, high = (origin + (block.low + ends) * self.pitch for ends in (0, np.array(block.shape)))
        slack = 0.5 * self.pitch  # the block's outermost cells are 0 unless the grid ends there
        near = np.flatnonzero(inside & ((places >= low - slack) & (places <= high + slack)).all(axis=1))
        local = ((places[near] - origin) / self.pitch - 0.5).astype(np.float32)
        found = interpolate_grid(values, local - block.low.astype(np.float32)) / typical
        result[index[near]] = found.astype(np.float32)


@dataclass(frozen=True)
class _Votes:
    """Which points ``(P,)`` and observations ``(M,)`` are not outvoted so far, and whether they are voted on."""

    right: BoolArray
    kept: BoolArray
    robust: bool


def contracted_growth(positions: FloatArray, aabb: FloatArray, length: float) -> FloatArray:
    """How much farther a step of ``length`` in contracted coordinates goes at ``positions (..., 3)`` than in the box.

    The coordinates are those of mip-NeRF 360 with the maximum norm (eq. 10), in which the box is ``[-1, 1]^3``: a step
    inwards from the norm ``n`` > 1 ends where ``2 - 1 / n`` is smaller by the step. In the box, 1.

    Example:
        >>> box = np.array([[-1.0] * 3, [1.0] * 3])
        >>> places = np.array([[0.9, 0.0, 0.0], [4.0, 0.0, 0.0], [1e6, 0.0, 0.0]])
        >>> contracted_growth(places, box, 0.25).round().tolist()
        [1.0, 8.0, 3999984.0]
    """
    half = (aabb[1] - aabb[0]) / 2
    norm = np.maximum(np.abs((positions - (aabb[0] + half)) / half).max(axis=-1), 1.0)
    step = length / float(half.max())
    inwards = 2.0 - 1.0 / norm - step
    reached = np.where(inwards > 1.0, 1.0 / (2.0 - np.maximum(inwards, 1.0)), inwards)
    growth: FloatArray = np.where(norm > 1.0, (norm - reached) / step, 1.0) if step > 0 else np.ones(norm.shape)
    return growth


def _number_of(index: NDArray[np.int64], count: int) -> int:
    """How many different ones of ``count`` there are in ``index``."""
    present = np.zeros(count, dtype=bool)
    present[index] = True
    return int(present.sum())


def _grown(box: FloatArray, factor: float) -> FloatArray:
    """The box ``factor`` times as wide about its centre."""
    middle, half = (box[0] + box[1]) / 2, (box[1] - box[0]) / 2
    return np.stack([middle - half * factor, middle + half * factor])


def _within(places: FloatArray, box: FloatArray) -> BoolArray:
    """Which ``places (N, 3)`` lie in the closed box."""
    inside: BoolArray = np.logical_and.reduce((places >= box[0]) & (places <= box[1]), axis=1)
    return inside


def _grid_shape(box: FloatArray, pitch: float) -> tuple[int, ...]:
    """Cells along each axis of a grid that covers the box; refuses too many."""
    sides = np.ceil((box[1] - box[0]) / pitch - 1e-6)
    if sides.prod() > MOST_CELLS:
        raise InvalidArgument(f"SightLines: pitch {pitch} makes {sides.prod():.3g} cells, at most {MOST_CELLS}")
    return tuple(int(side) for side in np.maximum(sides, 1))


def _known_uncertainty(points: SparsePoints) -> FloatArray:
    """``(P,)``: 0 where it is unknown, inf where the rays do not determine it."""
    return np.nan_to_num(points.uncertainty, nan=0.0, posinf=np.inf)


def _segments(
    points: SparsePoints, cameras: Cameras, margin: FloatArray, sigmas: float
) -> tuple[FloatArray, FloatArray, NDArray[np.int64]]:
    """Starts and ends ``(L, 3)`` of the segments that are longer than their margins, and their observations."""
    origins, targets = cameras.origins[points.camera], points.xyz[points.point]
    offset = targets - origins
    distance = np.linalg.norm(offset, axis=1)
    uncertainty = _known_uncertainty(points)[points.point]
    with np.errstate(invalid="ignore"):
        keep = distance - margin[points.point] - (sigmas * uncertainty if sigmas else 0.0)
        share = np.divide(keep, distance, out=np.zeros_like(distance), where=distance > 0)
    long: BoolArray = np.isfinite(share) & (share > 0)
    return origins[long], origins[long] + share[long, None] * offset[long], np.flatnonzero(long)


def _shell_pieces(
    starts: FloatArray, ends: FloatArray, outer: FloatArray, inner: FloatArray
) -> tuple[FloatArray, FloatArray, NDArray[np.int64]]:
    """The parts of segments ``(L, 3)`` in ``outer`` and not in ``inner``, at most two each, and whose they are."""

    def cut_by(box: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        side = box[1] - box[0]
        return segment_shares((starts - box[0]) / side, (ends - box[0]) / side, (1, 1, 1))

    first, last, meets = cut_by(outer)
    enter, leave, cut = cut_by(inner)
    enter, leave = (np.clip(np.where(cut, share, last), first, last) for share in (enter, leave))
    before, behind = meets & (enter > first), meets & (last > leave)
    which = np.concatenate([np.flatnonzero(before), np.flatnonzero(behind)])
    begin = np.concatenate([first[before], leave[behind]])
    end = np.concatenate([enter[before], last[behind]])
    along = ends[which] - starts[which]
    return starts[which] + begin[:, None] * along, starts[which] + end[:, None] * along, which


def _near(places: FloatArray, shape: tuple[int, ...], reach: int) -> BoolArray:
    """Which places (in cells) lie in the grid or less than ``reach`` cells beside it."""
    near: BoolArray = np.logical_and.reduce((places > -reach) & (places < np.array(shape) + reach), axis=1)
    return near


def _outnumbered(places: FloatArray, count: NDArray[np.int64], near: NDArray[np.float32], block: Block) -> BoolArray:
    """Which points (in cells) lie in a cell that more lines cross than observations end near."""
    cells = np.floor(places)
    inside: BoolArray = np.logical_and.reduce((cells >= 0) & (cells < np.array(block.grid_shape)), axis=1)
    index = tuple(np.where(inside[:, None], cells - block.low, 0).astype(np.int64).T)
    outnumbered: BoolArray = inside & (count[index] > near[index])
    return outnumbered


def _tents(
    places: FloatArray, block: Block, *, weights: FloatArray | None = None, reach: int = REACH
) -> NDArray[np.float32]:
    """Sum of weighted tents ``prod max(0, 1 - |cell centre - point| / reach)`` over points; places in cells.

    Over the cells of the block, which holds all cells near a point.
    """
    shape = block.grid_shape
    near = _near(places, shape, reach)
    local = (places[near] + reach + 0.5).T
    nodes, shares = lower_nodes(list(local), [length + 2 * reach + 2 for length in shape])
    padded = tuple(length + 2 * reach + 2 for length in block.shape)
    x, y, z = (node.astype(np.int64) - low for node, low in zip(nodes, block.low))
    corners = [(i * padded[1] + j) * padded[2] + k for i in (0, 1) for j in (0, 1) for k in (0, 1)]
    index = ((x * padded[1] + y) * padded[2] + z)[:, None] + np.array(corners)
    amounts = np.stack(corner_weights(shares), axis=-1)
    amounts = amounts if weights is None else amounts * weights[near, None]
    flat = np.bincount(index.ravel(), weights=amounts.ravel(), minlength=int(np.prod(padded)))
    total: FloatArray = flat.astype(np.float64).reshape(padded)
    taps = 1.0 - np.abs(np.arange(1 - reach, reach)) / reach  # tents of one cell to tents of `reach` cells, exactly
    for axis in range(3):
        total = _convolved(total, taps, axis)
    inner = tuple(slice(reach + 1, reach + 1 + length) for length in block.shape)
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
