"""Where to look: a coarse grid of how much matter there is, and cubes drawn from it. numpy only."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.aabb import as_aabb, scene_extent
from ..core.arrays import to_numpy
from ..core.errors import InvalidArgument
from ..core.frames import RESOLUTION

FloatArray = NDArray[np.float64]
Strategy = Literal["mixed", "importance", "uniform"]

GRID_RESOLUTION = 20  # the paper
PAPER_EDGE_FRACTIONS = (0.01, 0.1)  # the paper: 1-10 % of the scene
FIELD_CELL_RANGE = (0.5, 1.25)  # voxel pitch in field cells: finer cubes show ramps, not surfaces


class ImportanceGrid:
    """An exponential moving average of matter per cell, from which cube centres are drawn.

    Values lie in [0, 1]: opacities, accumulation weights, or densities clamped to 1 (as in the paper, so
    that a few huge ones do not dominate). A cell takes the mean of all that fell into it, duplicates
    included, then is averaged with its past; its first observation is taken as it is.

    Args:
        aabb: ``(2, 3)``, scene units.
        resolution: cells along each axis.
        decay: weight of a cell's past, in [0, 1).

    Attributes:
        values: ``(G, G, G)`` float64, index order x, y, z.
        observed: ``(G, G, G)`` bool: cells that ever received a value.
        dropped: how many observations lay outside the box and were dropped.
    """

    def __init__(self, aabb: ArrayLike, *, resolution: int = GRID_RESOLUTION, decay: float = 0.9) -> None:
        if resolution < 1:
            raise InvalidArgument(f"ImportanceGrid: resolution must be >= 1, got {resolution}")
        if not 0.0 <= decay < 1.0:
            raise InvalidArgument(f"ImportanceGrid: decay must lie in [0, 1), got {decay}")
        self.aabb = as_aabb(aabb, caller="ImportanceGrid")
        self.resolution, self.decay = int(resolution), float(decay)
        self.values = np.zeros((resolution,) * 3)
        self.observed = np.zeros((resolution,) * 3, dtype=bool)
        self.dropped = 0

    @property
    def cell(self) -> FloatArray:
        """``(3,)`` sides of a cell, scene units."""
        return (self.aabb[1] - self.aabb[0]) / self.resolution

    def cell_points(self, rng: np.random.Generator, per_cell: int = 1) -> FloatArray:
        """``(G^3 * per_cell, 3)`` random points, ``per_cell`` in every cell: what to ask a field to fill the grid."""
        index = np.stack(np.unravel_index(np.arange(self.values.size), self.values.shape), axis=-1)
        index = np.repeat(index, per_cell, axis=0)
        points: FloatArray = self.aabb[0] + (index + rng.random(index.shape)) * self.cell
        return points

    def observe(self, positions: Any, values: Any) -> int:
        """Update the cells that hold ``positions``.

        Args:
            positions: ``(..., 3)`` array or tensor, scene units. Those outside the box are dropped and counted.
            values: ``(...)`` or ``(..., 1)``, finite, >= 0; clamped to 1.

        Returns:
            How many were dropped.

        Raises:
            ValueError: shapes that do not match; NaN, infinite or negative values.
        """
        points = np.asarray(to_numpy(positions), dtype=np.float64)
        amounts = np.asarray(to_numpy(values), dtype=np.float64)
        if (
            points.ndim == 0
            or points.shape[-1] != 3
            or amounts.shape not in (points.shape[:-1], (*points.shape[:-1], 1))
        ):
            raise InvalidArgument(
                f"ImportanceGrid.observe: positions (..., 3) and values (...) must match, "
                f"got {points.shape} and {amounts.shape}"
            )
        points, amounts = points.reshape(-1, 3), amounts.reshape(-1)
        bad = ~(np.isfinite(amounts) & (amounts >= 0))
        if bad.any():
            raise InvalidArgument(
                f"ImportanceGrid.observe: values must be finite and >= 0, got {int(bad.sum())} of {bad.size} "
                f"that are not; first {amounts[bad][0]}"
            )
        inside = ((points >= self.aabb[0]) & (points <= self.aabb[1])).all(axis=-1)
        dropped = int(inside.size - inside.sum())
        self.dropped += dropped
        index = np.minimum(((points[inside] - self.aabb[0]) / self.cell).astype(np.int64), self.resolution - 1)
        flat = np.ravel_multi_index(tuple(index.T), self.values.shape)
        counts = np.bincount(flat, minlength=self.values.size).reshape(self.values.shape)
        sums = np.bincount(flat, weights=np.minimum(amounts[inside], 1.0), minlength=self.values.size)
        mean = sums.reshape(self.values.shape) / np.maximum(counts, 1)
        blended = np.where(self.observed, self.decay * self.values + (1.0 - self.decay) * mean, mean)
        self.values = np.where(counts > 0, blended, self.values)
        self.observed = self.observed | (counts > 0)
        return dropped

    def sample(
        self, rng: np.random.Generator, count: int, *, strategy: Strategy = "mixed", uniform_share: float = 0.25
    ) -> FloatArray:
        """Draw cube centres.

        Args:
            rng: generator.
            count: how many, >= 0.
            strategy: ``"importance"`` (cells in proportion to their value, uniform within), ``"uniform"``
                over the box, or ``"mixed"``: ``uniform_share`` of them uniform, so that what the grid
                has missed is found too. A grid that holds nothing gives uniform centres.
            uniform_share: of the mixed strategy, in [0, 1].

        Returns:
            ``(count, 3)``, scene units, inside the box.
        """
        shares = {"mixed": uniform_share, "importance": 0.0, "uniform": 1.0}
        if strategy not in shares:
            raise InvalidArgument(f"ImportanceGrid.sample: strategy must be one of {sorted(shares)}, got {strategy!r}")
        if not 0.0 <= uniform_share <= 1.0:
            raise InvalidArgument(f"ImportanceGrid.sample: uniform_share must lie in [0, 1], got {uniform_share}")
        total = self.values.sum()
        uniform = self.aabb[0] + rng.random((count, 3)) * (self.aabb[1] - self.aabb[0])
        if total <= 0.0:
            return uniform
        cumulative = np.cumsum(self.values.reshape(-1)) / total
        flat = np.minimum(np.searchsorted(cumulative, rng.random(count), side="right"), self.values.size - 1)
        index = np.stack(np.unravel_index(flat, self.values.shape), axis=-1)
        important = self.aabb[0] + (index + rng.random((count, 3))) * self.cell
        choose_uniform = rng.random(count) < shares[strategy]
        return np.where(choose_uniform[:, None], uniform, np.clip(important, self.aabb[0], self.aabb[1]))


def sample_edges(
    rng: np.random.Generator,
    count: int,
    *,
    aabb: ArrayLike,
    edge_range: tuple[float, float] | None = None,
    field_pitch: NDArray[Any] | float | None = None,
    resolution: int = RESOLUTION,
) -> FloatArray:
    """Draw cube edge lengths, log-uniform.

    Args:
        rng: generator.
        count: how many.
        aabb: ``(2, 3)``, scene units.
        edge_range: lowest and highest edge as fractions of the scene extent. None: the paper's .01-.1, or, if
            ``field_pitch`` is known, edges whose voxels measure .5-1.25 of the field's cells.
        field_pitch: side of the field's own cells, scene units, a number or ``(count,)``.
        resolution: voxels along an edge.

    Returns:
        ``(count,)``, scene units.
    """
    if field_pitch is not None and edge_range is None:
        unit: NDArray[Any] | float = resolution * np.asarray(field_pitch, dtype=np.float64)
        low, high = FIELD_CELL_RANGE
    else:
        unit = scene_extent(aabb)
        low, high = PAPER_EDGE_FRACTIONS if edge_range is None else edge_range
    if not (0.0 < low <= high and np.isfinite(high)):
        raise InvalidArgument(f"sample_edges: edge_range must satisfy 0 < low <= high, got {(low, high)}")
    edges: FloatArray = np.exp(rng.uniform(np.log(low), np.log(high), count)) * unit
    return edges
