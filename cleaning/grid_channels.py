"""The optional channels of a denoiser, for windows of a grid that was asked already. numpy only."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from ..core.aabb import contains
from ..core.cameras import Cameras
from ..core.channels import (
    CROSSINGS,
    POOLED,
    SUPPORT,
    SURROUNDINGS,
    TRANSMITTANCE,
    VIEW_COUNT,
    encode_share,
    encode_surroundings,
    encode_view_count,
    evidence_share,
    pool_surroundings,
)
from ..core.frames import RESOLUTION, cube_lattices
from ..core.occupancy import EMPTY
from ..core.shards.storage import SURROUNDINGS_RESOLUTION, TRANSMITTANCE_RESOLUTION
from ..core.sight_lines import SightLines
from ..core.sparse_points import SparsePoints
from ..core.visibility.transmittance import DensityFn, TransmittanceMaps
from ..core.visibility.view_counts import count_views, pinholes

FloatGrid = NDArray[np.float32]
FloatArray = NDArray[np.float64]
Corner = tuple[int, ...]

POINTS = POOLED * SURROUNDINGS_RESOLUTION  # along an axis of the surroundings: every third cell of the grid
STRIDE = 3


def viewing_cameras(cameras: Cameras | None, names: Sequence[str]) -> Cameras | None:
    """The cameras to count views with (their borders straightened), or None if nobody asks or there are none.

    Example:
        >>> cameras = Cameras.create(np.eye(3, 4)[None], np.array([8.0, 8.0, 4.0, 3.0]), 8, 6)
        >>> viewing_cameras(cameras, ("signed_opacity",)) is None
        True
        >>> len(viewing_cameras(cameras, ("signed_opacity", "view_count")))
        1
    """
    if cameras is None or len(cameras) == 0 or VIEW_COUNT not in names:
        return None
    return pinholes(cameras)


def view_channel(
    cameras: Cameras, centers: FloatArray, edges: FloatArray, rotations: FloatArray | None = None
) -> FloatGrid:
    """The channel ``view_count`` of cubes ``(N, 3)``, ``(N,)``, ``(N, 3, 3)`` or axis-aligned: ``(N, 32, 32, 32)``.

    Example:
        >>> cameras = Cameras.create(np.eye(3, 4)[None], np.array([8.0, 8.0, 4.0, 3.0]), 8, 6)
        >>> counts = view_channel(cameras, np.array([[0.0, 0.0, -3.0], [0.0, 0.0, 3.0]]), np.full(2, 0.5))
        >>> counts.shape, counts.max(axis=(1, 2, 3)).tolist()  # in view, behind the camera
        ((2, 32, 32, 32), [-0.3125, -0.5])
    """
    turned = np.broadcast_to(np.eye(3), (len(centers), 3, 3)) if rotations is None else rotations
    return encode_view_count(count_views(cameras, centers, edges, turned))


def light_maps(
    names: Sequence[str], cameras: Cameras | None, density_fn: DensityFn, *, aabb: NDArray[np.float64], pitch: float
) -> TransmittanceMaps | None:
    """Rays from the cameras through the field in its box, or None if nobody asks or there are no cameras.

    Args:
        names: the denoiser's channels.
        cameras: of the training photos.
        density_fn: ``(M, 3)`` to ``(M,)``, asked inside the box alone; what is NaN, infinite or negative lets light by.
        aabb: ``(2, 3)``.
        pitch: side of the field's cells.

    Example:
        >>> cameras = Cameras.create(np.eye(3, 4)[None], np.array([8.0, 8.0, 4.0, 3.0]), 8, 6)
        >>> aabb = np.array([[-1.0, -1.0, -4.0], [1.0, 1.0, -2.0]])
        >>> names = ("signed_opacity", "transmittance")
        >>> maps = light_maps(names, cameras, lambda p: np.ones(len(p)), aabb=aabb, pitch=0.1)
        >>> maps.through.shape
        (1, 6, 8, 97)
    """
    if cameras is None or len(cameras) == 0 or TRANSMITTANCE not in names:
        return None

    def inside(positions: NDArray[np.float32]) -> NDArray[np.float64]:
        within = contains(aabb, positions)
        values = np.asarray(density_fn(positions[within]), dtype=np.float64).reshape(-1)
        density = np.zeros(len(positions))
        density[within] = np.where(np.isfinite(values) & (values >= 0), values, 0.0)
        return density

    return TransmittanceMaps.build(inside, cameras, aabb=aabb, field_pitch=pitch)


def light_channel(
    maps: TransmittanceMaps, centers: FloatArray, edges: FloatArray, rotations: FloatArray | None = None
) -> FloatGrid:
    """The channel ``transmittance`` of cubes ``(N, 3)``, ``(N,)``, ``(N, 3, 3)`` or axis-aligned:
    ``(N, 16, 16, 16)``.

    Example:
        >>> cameras = Cameras.create(np.eye(3, 4)[None], np.array([8.0, 8.0, 4.0, 3.0]), 8, 6)
        >>> aabb = np.array([[-1.0, -1.0, -4.0], [1.0, 1.0, -2.0]])
        >>> maps = light_maps(("transmittance",), cameras, lambda p: np.ones(len(p)), aabb=aabb, pitch=0.1)
        >>> light = light_channel(maps, np.array([[0.0, 0.0, -3.0]]), np.full(1, 0.5))
        >>> light.shape
        (1, 16, 16, 16)
    """
    lattice = cube_lattices(centers, edges, rotations, resolution=TRANSMITTANCE_RESOLUTION)
    return encode_share(maps.best_view(lattice))


def evidence_lines(
    names: Sequence[str],
    points: SparsePoints | None,
    cameras: Cameras | None,
    *,
    aabb: NDArray[np.float64],
    pitch: float,
) -> SightLines | None:
    """Sight lines on a grid of the field's own pitch, or None if the denoiser does not use them or there are no points.

    Args:
        names: the denoiser's channels.
        points: of the training photos, in the frame of ``cameras``.
        cameras: of the training photos.
        aabb: ``(2, 3)``.
        pitch: side of the field's cells.

    Example:
        >>> from unghost.core.cameras import look_at
        >>> poses = look_at(np.array([[2.0, 0.0, 0.0], [0.0, 2.0, 0.0]]), np.zeros((2, 3)))
        >>> cameras = Cameras.create(poses, np.array([100.0, 100.0, 50.0, 50.0]), width=100, height=100)
        >>> points = SparsePoints.create(np.zeros((1, 3)), point=[0, 0], camera=[0, 1], cameras=cameras)
        >>> box = np.array([[-1.0] * 3, [1.0] * 3])
        >>> evidence_lines(("signed_opacity",), points, cameras, aabb=box, pitch=0.1) is None
        True
        >>> len(evidence_lines(("signed_opacity", "support"), points, cameras, aabb=box, pitch=0.1))
        2
    """
    if points is None or cameras is None or not len(points) or not {SUPPORT, CROSSINGS} & set(names):
        return None
    return SightLines.build(points, cameras, aabb=aabb, pitch=pitch)


def evidence_channels(
    lines: SightLines, centers: FloatArray, edges: FloatArray, rotations: FloatArray | None = None
) -> dict[str, FloatGrid]:
    """The channels ``support`` and, if any camera observed a point, ``crossings`` of cubes: ``(N, 32, 32, 32)`` each.

    Args:
        lines: on a grid of the field's own pitch.
        centers, edges, rotations: ``(N, 3)``, ``(N,)``, ``(N, 3, 3)`` or None for axis-aligned cubes.
    """
    lattice = cube_lattices(centers, edges, rotations)
    channels = {SUPPORT: encode_share(evidence_share(lines.support(lattice)))}
    if len(lines):
        channels[CROSSINGS] = encode_share(evidence_share(lines.crossings(lattice)))
    return channels


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
        maps: of :func:`light_maps`; None for transmittances that are unknown.
        lines: of :func:`evidence_lines`; None for support and crossings that are unknown.
    """

    def __init__(
        self,
        names: Sequence[str],
        signed: FloatGrid,
        *,
        origin: NDArray[np.float64],
        pitch: float,
        cameras: Cameras | None = None,
        maps: TransmittanceMaps | None = None,
        lines: SightLines | None = None,
    ) -> None:
        self.names, self.signed, self.origin, self.pitch = tuple(names), signed, origin, pitch
        self.cameras = viewing_cameras(cameras, names)
        self.maps = maps if TRANSMITTANCE in names else None
        self.lines = lines
        self._tiles: dict[Corner, FloatGrid] = {}
        self._light_tiles: dict[Corner, FloatGrid] = {}
        self._evidence_tiles: dict[Corner, dict[str, FloatGrid]] = {}

    def known(self, corners: Sequence[Corner]) -> dict[str, FloatGrid]:
        """The channels that can be told, of windows whose first cells are ``corners`` (these may lie outside)."""
        told: dict[str, FloatGrid] = {}
        if SURROUNDINGS in self.names:
            points = np.stack([self._about(corner) for corner in corners])
            told[SURROUNDINGS] = encode_surroundings(pool_surroundings(points))
        if self.cameras is not None:
            told[VIEW_COUNT] = np.stack([_cut(corner, RESOLUTION, self._views) for corner in corners])
        if self.maps is not None:
            told[TRANSMITTANCE] = np.stack([self._window_light(corner) for corner in corners])
        if self.lines is not None:
            names = (SUPPORT, CROSSINGS) if len(self.lines) else (SUPPORT,)
            for name in names:
                tiles = functools.partial(self._evidence, name)
                told[name] = np.stack([_cut(corner, RESOLUTION, tiles) for corner in corners])
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

    def _frame(self, corner: Corner) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Centre ``(1, 3)`` and edge ``(1,)`` of the 32 cells from ``corner`` on."""
        return (self.origin + (np.array(corner) + RESOLUTION / 2) * self.pitch)[None], np.array(
            [RESOLUTION * self.pitch]
        )

    def _views(self, tile: Corner) -> FloatGrid:
        """The view counts of cells ``32 tile`` to ``32 (tile + 1)``, counted when first needed."""
        if tile not in self._tiles:
            assert self.cameras is not None
            self._tiles[tile] = view_channel(self.cameras, *self._frame(_times(tile, RESOLUTION)))[0]
        return self._tiles[tile]

    def _evidence(self, name: str, tile: Corner) -> FloatGrid:
        """Support or crossings of those cells."""
        if tile not in self._evidence_tiles:
            assert self.lines is not None
            channels = evidence_channels(self.lines, *self._frame(_times(tile, RESOLUTION)))
            self._evidence_tiles[tile] = {key: values[0] for key, values in channels.items()}
        return self._evidence_tiles[tile][name]

    def _light(self, tile: Corner) -> FloatGrid:
        """The transmittances of those cells, in blocks of two."""
        if tile not in self._light_tiles:
            assert self.maps is not None
            self._light_tiles[tile] = light_channel(self.maps, *self._frame(_times(tile, RESOLUTION)))[0]
        return self._light_tiles[tile]

    def _window_light(self, corner: Corner) -> FloatGrid:
        """The transmittances of a window; one that begins in the middle of a block is looked up by itself."""
        assert self.maps is not None
        blocks = RESOLUTION // TRANSMITTANCE_RESOLUTION
        if any(start % blocks for start in corner):
            return light_channel(self.maps, *self._frame(corner))[0]
        return _cut(tuple(start // blocks for start in corner), TRANSMITTANCE_RESOLUTION, self._light)


def _times(tile: Corner, side: int) -> Corner:
    return tuple(side * place for place in tile)


def _cut(corner: Corner, side: int, tiles: Callable[[Corner], FloatGrid]) -> FloatGrid:
    """The ``side^3`` values from ``corner`` on, cut out of up to eight tiles of as many."""
    first = [start // side for start in corner]
    ends = [-(-(start + side) // side) for start in corner]
    block = np.empty([side * (end - begin) for begin, end in zip(first, ends)], dtype=np.float32)
    for tile in itertools.product(*(range(begin, end) for begin, end in zip(first, ends))):
        place = tuple(slice((t - b) * side, (t - b + 1) * side) for t, b in zip(tile, first))
        block[place] = tiles(tile)
    starts = [start - side * begin for start, begin in zip(corner, first)]
    return block[tuple(slice(start, start + side) for start in starts)]
