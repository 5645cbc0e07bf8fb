"""The optional channels of a denoiser, for windows of a grid that was asked already. numpy only."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..core.cameras import Cameras
from ..core.channels import (
    POOLED,
    SURROUNDINGS,
    VIEW_COUNT,
    encode_surroundings,
    encode_view_count,
    pool_surroundings,
)
from ..core.cube_views import count_views, pinholes
from ..core.frames import RESOLUTION
from ..core.occupancy import EMPTY
from ..core.shards import SURROUNDINGS_RESOLUTION

FloatGrid = NDArray[np.float32]
Corner = tuple[int, ...]

POINTS = POOLED * SURROUNDINGS_RESOLUTION  # along an axis of the surroundings: every third cell of the grid
STRIDE = 3


def viewing_cameras(cameras: Cameras | None, names: Sequence[str]) -> Cameras | None:
    """The cameras to count views with (their borders straightened), or None if nobody asks or there are none."""
    if cameras is None or len(cameras) == 0 or VIEW_COUNT not in names:
        return None
    return pinholes(cameras)


def view_channel(cameras: Cameras, centers: NDArray[np.float64], edges: NDArray[np.float64]) -> FloatGrid:
    """The channel ``view_count`` of axis-aligned cubes ``(N, 3)``, ``(N,)``: ``(N, 32, 32, 32)``."""
    upright = np.broadcast_to(np.eye(3), (len(centers), 3, 3))
    return encode_view_count(count_views(cameras, centers, edges, upright))


class GridContext:
    """What a denoiser may be told about windows of a grid beyond their cells.

    The surroundings' points (:func:`unghost.core.channels.surroundings_lattice`) of a window of 32 cells are centres
    of every third cell, so that the grid holds their values and nothing is asked again. Views are counted in tiles of
    32 cells, each once, however many windows overlap there.

    Args:
        names: the denoiser's channels; what is not among them costs nothing.
        signed: ``(X, Y, Z)`` signed opacity; what lies beyond counts as empty.
        origin: ``(3,)`` corner of the grid, scene units.
        pitch: side of its cells.
        cameras: of the training photos; None for view counts that are unknown.
    """

    def __init__(
        self,
        names: Sequence[str],
        signed: FloatGrid,
        *,
        origin: NDArray[np.float64],
        pitch: float,
        cameras: Cameras | None = None,
    ) -> None:
        self.names, self.signed, self.origin, self.pitch = tuple(names), signed, origin, pitch
        self.cameras = viewing_cameras(cameras, names)
        self._tiles: dict[Corner, FloatGrid] = {}

    def known(self, corners: Sequence[Corner]) -> dict[str, FloatGrid]:
        """The channels that can be told, of windows whose first cells are ``corners`` (these may lie outside)."""
        told: dict[str, FloatGrid] = {}
        if SURROUNDINGS in self.names:
            points = np.stack([self._about(corner) for corner in corners])
            told[SURROUNDINGS] = encode_surroundings(pool_surroundings(points))
        if self.cameras is not None:
            told[VIEW_COUNT] = np.stack([self._views(corner) for corner in corners])
        return told

    def _about(self, corner: Corner) -> FloatGrid:
        """Signed opacity at the surroundings' points of a window, ``(32, 32, 32)``."""
        taken, inside = [], []
        for start, length in zip(corner, self.signed.shape):
            cells = start - RESOLUTION + STRIDE // 2 + STRIDE * np.arange(POINTS)
            taken.append(np.clip(cells, 0, length - 1))
            inside.append((cells >= 0) & (cells < length))
        x, y, z = inside
        within = x[:, None, None] & y[:, None] & z
        return np.where(within, self.signed[np.ix_(*taken)], np.float32(EMPTY)).astype(np.float32, copy=False)

    def _views(self, corner: Corner) -> FloatGrid:
        """The view counts of a window, cut out of up to eight tiles."""
        first = [start // RESOLUTION for start in corner]
        ends = [-(-(start + RESOLUTION) // RESOLUTION) for start in corner]
        block = np.empty([RESOLUTION * (end - begin) for begin, end in zip(first, ends)], dtype=np.float32)
        for tile in itertools.product(*(range(begin, end) for begin, end in zip(first, ends))):
            place = tuple(slice((t - b) * RESOLUTION, (t - b + 1) * RESOLUTION) for t, b in zip(tile, first))
            block[place] = self._tile(tile)
        starts = [start - RESOLUTION * begin for start, begin in zip(corner, first)]
        return block[tuple(slice(start, start + RESOLUTION) for start in starts)]

    def _tile(self, tile: Corner) -> FloatGrid:
        """The view counts of cells ``32 tile`` to ``32 (tile + 1)``, counted when first needed."""
        if tile not in self._tiles:
            assert self.cameras is not None
            edge = RESOLUTION * self.pitch
            center = self.origin + (np.array(tile) + 0.5) * edge
            self._tiles[tile] = view_channel(self.cameras, center[None], np.array([edge]))[0]
        return self._tiles[tile]
