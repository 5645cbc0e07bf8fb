"""A field on a grid: what ``clean`` looks at. Empty space is told from a few samples. numpy only."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.lattice import cells_within, lattice_axes
from ..core.occupancy import EMPTY, OccupancyRule, check_density, warn_if_constant
from .components import dilate
from .queries import Query
from .sliding_window import grow

Mask = NDArray[np.bool_]
Axes = list[NDArray[np.float64]]


@dataclass(frozen=True)
class Survey:
    """The field on a grid, all ``(X, Y, Z)``: signed opacity, occupied cells, cells to judge, cells not to touch.

    ``asked`` positions it took; ``dropped`` cells had an invalid density.
    """

    signed: NDArray[np.float32]
    occupied: Mask
    judged: Mask
    protected: Mask
    asked: int
    dropped: int

    def extent(self) -> tuple[slice, slice, slice]:
        """The smallest part of the grid outside which nothing is judged; one cell where nothing is at all."""
        spans = []
        for axis in range(3):
            held = np.flatnonzero(self.judged.any(axis=tuple({0, 1, 2} - {axis})))
            spans.append(slice(int(held[0]), int(held[-1]) + 1) if len(held) else slice(0, 1))
        return spans[0], spans[1], spans[2]


@dataclass
class _Asker:
    """A field that is asked in many parts: checks what it says, keeps count."""

    query: Query
    drop_invalid: bool
    asked: int = 0
    dropped: int = 0
    lowest: float = math.inf
    highest: float = -math.inf

    def __call__(self, places: NDArray[Any], *, probing: bool = False) -> NDArray[np.float64]:
        """Densities; an invalid one is a cell without matter, or a place worth asking about."""
        values = self.query(places)
        self.asked += len(values)
        if self.drop_invalid:
            invalid = ~(np.isfinite(values) & (values >= 0))
            self.dropped += 0 if probing else int(invalid.sum())
            values = np.where(invalid, math.inf if probing else 0.0, values)
        else:
            check_density(values, places, caller="clean")
        self.lowest = min(self.lowest, values.min(initial=math.inf))
        self.highest = max(self.highest, values.max(initial=-math.inf))
        return values


def survey_field(
    query: Query,
    aabb: NDArray[np.float64],
    pitch: float,
    shape: tuple[int, int, int],
    *,
    rule: OccupancyRule,
    faint: float,
    opaque_pitch: float,
    soft: bool,
    keep_boxes: tuple[Any, ...],
    probe: int,
    drop_invalid: bool,
    rows: int,
) -> Survey:
    """Ask the field where there may be something, slab by slab (along x), keeping a float32 and three bits a cell.

    Args:
        query: of :func:`unghost.cleaning.queries.make_query`.
        aabb: ``(2, 3)`` scene units; cells whose centre is outside count as empty.
        pitch: of the cells.
        shape: of the grid.
        rule: what occupied means.
        faint: share of its threshold from which a cell is judged.
        opaque_pitch: side of a cell of the field's own.
        soft: opacities rather than bits.
        keep_boxes: ``(2, 3)`` boxes of protected cells.
        probe: cells along the side of the blocks of which the middle is asked first, see :func:`_worth_asking`.
        drop_invalid: take NaN, infinite and negative densities as zero.
        rows: about as many cells as are held at once.
    """
    faint_rule = dataclasses.replace(rule, threshold=rule.threshold * faint)
    asker = _Asker(query, drop_invalid)
    axes = lattice_axes(aabb, pitch, shape)
    signed = np.full(shape, EMPTY, dtype=np.float32)
    occupied, judged, protected = np.zeros(shape, bool), np.zeros(shape, bool), np.zeros(shape, bool)
    wanted = cells_within(axes, aabb)
    if probe > 1:
        wanted &= _worth_asking(asker, aabb, axes, probe, float(faint_rule.density_threshold(opaque_pitch)))
    step = max(1, rows // (shape[1] * shape[2]))
    for start in range(0, shape[0], step):
        part = slice(start, start + step)
        cells = np.nonzero(wanted[part])
        values = asker(np.stack([axis[index] for axis, index in zip([axes[0][part], *axes[1:]], cells)], axis=-1))
        signed[part][cells] = rule.encode(values, opaque_pitch, soft=soft)
        occupied[part][cells] = rule.occupied(values, opaque_pitch)
        judged[part][cells] = faint_rule.occupied(values, opaque_pitch)
    for box in keep_boxes:
        protected |= cells_within(axes, np.asarray(box))
    warn_if_constant(asker.lowest, asker.highest, asker.asked, caller="clean")
    return Survey(signed, occupied, judged | occupied, protected, asker.asked, asker.dropped)


def _worth_asking(asker: _Asker, aabb: NDArray[np.float64], axes: Axes, probe: int, limit: float) -> Mask:
    """Cells in blocks of ``probe^3`` whose middle holds something, and in the blocks around those.

    Something is a ``probe^3``-th of the density from which a cell is judged: as much as the middle of a block of eight
    gets of one such cell by trilinear interpolation. What is thinner than that, and alone, may be missed: it stays.
    """
    middles = [
        np.clip(axis[::probe] + (probe - 1) / 2 * (axis[1] - axis[0] if len(axis) > 1 else 0.0), low, high)
        for axis, low, high in zip(axes, aabb[0], aabb[1])
    ]
    held = np.zeros(tuple(map(len, middles)), dtype=bool)
    for index, x in enumerate(middles[0]):
        places = np.stack(np.meshgrid([x], *middles[1:], indexing="ij"), axis=-1)
        held[index] = (asker(places.reshape(-1, 3), probing=True) > limit / probe**3).reshape(held.shape[1:])
    return grow(dilate(held), probe, tuple(map(len, axes)))
