r"""The density grid of an instant-ngp snapshot (``.msgpack``, ``.ingp``) as a density field. numpy only.

Beside its hash grid, instant-ngp keeps ``128^3`` cells in up to 8 cascades, each twice as large as the one before:

    cascade k is the cube [0.5 - 2^(k-1), 0.5 + 2^(k-1)]^3 of instant-ngp's coordinates
    a cell holds density * sqrt(3) / 1024: the optical depth of the shortest step of a ray
    cells of a cascade lie in Morton order (x in the lowest bit), float16, one cascade after the other
    a negative cell is one that no training camera sees

The grid is the field's own memory of where it is dense (the fading maximum of probes), not the network itself: good
for finding ghosts, coarser than the picture. What is decided on it applies to the network all the same.
"""

from __future__ import annotations

import gzip
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core.errors import InvalidArgument, InvalidFile, MissingFile
from .msgpack_stream import MsgpackError, read_msgpack

CELLS = 128
MOST_CASCADES = 8
SHORTEST_STEP = 3.0**0.5 / 1024.0
MOST_BYTES = 1 << 32  # of a snapshot, unpacked: what is skipped costs time
GRID_KEY = ("snapshot", "density_grid_binary")


def morton_index(resolution: int = CELLS) -> NDArray[np.int64]:
    """Place in Morton order of every cell ``[x, y, z]``, ``(R, R, R)``; ``resolution`` is a power of two.

    Example:
        >>> morton_index(2).ravel().tolist()  # of the cells 000, 001, .., 111 of xyz
        [0, 4, 2, 6, 1, 5, 3, 7]
    """
    if resolution < 1 or resolution & (resolution - 1):
        raise InvalidArgument(f"morton_index: resolution must be a power of two, got {resolution}")
    axis = np.arange(resolution, dtype=np.int64)
    spread = np.zeros_like(axis)
    for bit in range(resolution.bit_length()):
        spread |= ((axis >> bit) & 1) << (3 * bit)
    return spread[:, None, None] | spread[None, :, None] << 1 | spread[None, None, :] << 2


@dataclass(frozen=True)
class InstantNgpGrid:
    """A snapshot's density grid.

    Attributes:
        density: ``(cascades, 128, 128, 128)`` float32, index order ``[x, y, z]``, per unit of instant-ngp's
            coordinates, >= 0; 0 where no camera looks.
        unseen: the same shape, bool: cells that no training camera sees.
        aabb: ``(2, 3)``, the snapshot's own box in instant-ngp's coordinates, within the largest cascade;
            outside, the density is 0.
        scale, offset: what the photos' ``transforms.json`` was multiplied by and then moved by ``(3,)``.
        cycled: whether instant-ngp also turned the axes round (always but for Mitsuba's scenes).
    """

    density: NDArray[np.float32]
    unseen: NDArray[np.bool_]
    aabb: NDArray[np.float64]
    scale: float
    offset: NDArray[np.float64]
    cycled: bool

    @property
    def field_pitch(self) -> float:
        """Side of the finest cells, instant-ngp's units."""
        return 1.0 / CELLS

    def density_fn(self, positions: ArrayLike) -> NDArray[np.float32]:
        """Density ``(..., 1)`` at ``positions (..., 3)`` in instant-ngp's coordinates: of the cell a position lies in.

        The finest cascade that holds a position answers, as in instant-ngp. 0 outside ``aabb``, or if not finite.
        """
        points = np.asarray(positions, dtype=np.float64)
        if points.shape[-1:] != (3,):
            raise InvalidArgument(f"InstantNgpGrid.density_fn: positions must have shape (..., 3), got {points.shape}")
        flat = points.reshape(-1, 3)
        inside = ((flat >= self.aabb[0]) & (flat <= self.aabb[1])).all(axis=1)
        local = np.where(inside[:, None], flat, 0.5) - 0.5
        reach = np.abs(local).max(axis=1)
        _, exponent = np.frexp(2.0 * reach)  # 2 * reach < 2^exponent
        level = np.clip(exponent, 0, len(self.density) - 1)
        cell = np.floor((local / 2.0 ** level[:, None] + 0.5) * CELLS).astype(np.int64).clip(0, CELLS - 1)
        density = self.density[level, cell[:, 0], cell[:, 1], cell[:, 2]]
        return np.where(inside, density, np.float32(0.0)).reshape(*points.shape[:-1], 1)

    def cascade(self, level: int = 0) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        """Density ``(128, 128, 128)`` and box ``(2, 3)`` of one cascade: what an ``.npz`` grid holds."""
        half = 2.0 ** (level - 1)
        return self.density[level], np.array([[0.5 - half] * 3, [0.5 + half] * 3])

    def to_ngp(self, positions: ArrayLike) -> NDArray[np.float64]:
        """``(..., 3)`` in the coordinates of ``transforms.json`` to instant-ngp's.

        A density per unit of ``transforms.json`` is the grid's times ``scale``.
        """
        moved = np.asarray(positions, dtype=np.float64) * self.scale + self.offset
        return moved[..., [1, 2, 0]] if self.cycled else moved


class _Limited:
    """A stream that refuses to give more than so many bytes: a few packed kilobytes may unpack without end."""

    def __init__(self, stream: BinaryIO, most: int) -> None:
        self.stream, self.left = stream, most

    def read(self, count: int = -1) -> bytes:
        self.left -= count
        if count < 0 or self.left < 0:
            raise MsgpackError(f"more than {MOST_BYTES} bytes unpacked")
        return self.stream.read(count)


def _wanted(path: tuple[str, ...], count: int) -> bool:
    if path != GRID_KEY:
        return False
    cascade = 2 * CELLS**3
    if count == 0 or count % cascade or count > MOST_CASCADES * cascade:
        raise MsgpackError(
            f"a density grid of {count} bytes: must be 1 to {MOST_CASCADES} cascades of {cascade} (0: never trained)"
        )
    return True


def load_instant_ngp(path: str | Path) -> InstantNgpGrid:
    """Read the density grid of a snapshot; network and optimiser are skipped, whatever their size.

    Args:
        path: a ``.msgpack``, or packed (gzip), which is what ``.ingp`` means.

    Raises:
        FileNotFoundError: no such file.
        ValueError: another kind of file or of snapshot, one cut short or beyond the limits, a grid that is not
            128^3 cells in 1 to 8 cascades, or one with NaN or infinite cells.

    Example:
        >>> grid = load_instant_ngp("fox.ingp")  # doctest: +SKIP
        >>> mask = clean(grid.density_fn, grid.aabb, field_pitch=grid.field_pitch)  # doctest: +SKIP
    """
    source = Path(path)
    if not source.is_file():
        raise MissingFile(f"load_instant_ngp: no file {source}")
    try:
        with source.open("rb") as raw:
            packed = raw.read(2) == b"\x1f\x8b"
            raw.seek(0)
            stream = gzip.GzipFile(fileobj=raw) if packed else raw
            content = read_msgpack(cast(BinaryIO, _Limited(cast(BinaryIO, stream), MOST_BYTES)), wanted=_wanted)
        return _grid(content)
    except (MsgpackError, EOFError, OSError, zlib.error) as error:
        raise InvalidFile(
            f"load_instant_ngp: {source} is not a snapshot of instant-ngp, or is cut short: {error}"
        ) from None


def _grid(content: Any) -> InstantNgpGrid:
    snapshot = content.get("snapshot") if isinstance(content, dict) else None
    if not isinstance(snapshot, dict) or not isinstance(snapshot.get(GRID_KEY[1]), bytes):
        raise MsgpackError("it holds no snapshot with a density_grid_binary (a snapshot of a NeRF has one)")
    if snapshot.get("density_grid_size") != CELLS:
        raise MsgpackError(f"density_grid_size must be {CELLS}, got {snapshot.get('density_grid_size')!r:.60}")
    stored = np.frombuffer(snapshot[GRID_KEY[1]], dtype="<f2").reshape(-1, CELLS**3)
    if not np.isfinite(stored).all():
        raise MsgpackError(f"{int((~np.isfinite(stored)).sum())} cells of the density grid are NaN or infinite")
    order = morton_index()
    depth = np.stack([cascade[order].astype(np.float32) for cascade in stored])
    unseen = depth < 0
    density = np.where(unseen, np.float32(0.0), depth / np.float32(SHORTEST_STEP))
    half = 2.0 ** (len(stored) - 1) / 2.0
    box = np.array([[0.5 - half] * 3, [0.5 + half] * 3])
    if "aabb" in snapshot:
        given = np.array([_vector(snapshot, "aabb", end) for end in ("min", "max")])
        box = np.stack([np.maximum(given[0], box[0]), np.minimum(given[1], box[1])])
        if not (box[0] < box[1]).all():
            raise MsgpackError(f"aabb must have min < max within its cascades, got {given.tolist()}")
    nerf = snapshot.get("nerf")
    dataset = nerf.get("dataset") if isinstance(nerf, dict) else None
    dataset = dataset if isinstance(dataset, dict) else {}
    scale = dataset.get("scale", 0.33)
    if isinstance(scale, bool) or not isinstance(scale, int | float) or not 0 < scale < np.inf:
        raise MsgpackError(f"the dataset's scale must be finite and > 0, got {scale!r:.60}")
    offset = _vector(dataset, "offset") if "offset" in dataset else np.full(3, 0.5)
    return InstantNgpGrid(density, unseen, box, float(scale), offset, not dataset.get("from_mitsuba", False))


def _vector(content: dict[str, Any], *keys: str) -> NDArray[np.float64]:
    """Three finite numbers at a path of keys."""
    value: Any = content
    for key in keys:
        value = value.get(key) if isinstance(value, dict) else None
    numbers = value if isinstance(value, list) else []
    if len(numbers) != 3 or not all(isinstance(n, int | float) and np.isfinite(n) for n in numbers):
        raise MsgpackError(f"{'.'.join(keys)} must be three finite numbers, got {value!r:.60}")
    return np.array(numbers, dtype=np.float64)
