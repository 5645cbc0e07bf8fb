"""A density grid as a density field: trilinear interpolation in numpy."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core.aabb import as_aabb
from ...core.errors import InvalidArgument, InvalidFile, MissingFile
from ...core.file_kinds import GRID, file_kind, not_readable
from ...core.interpolate import interpolate_grid
from ...core.io import write_npz
from ...core.lattice import cell_centers as cell_centers
from ...core.lattice import cell_pitch as cell_pitch

DensityFn = Callable[[NDArray[Any]], NDArray[np.float32]]


def grid_density_fn(density: NDArray[Any], aabb: ArrayLike) -> DensityFn:
    """The field that interpolates ``density (X, Y, Z)`` trilinearly between cell centres.

    Beyond the outermost centres the nearest value holds; outside ``aabb`` the density is 0.

    Returns:
        ``positions (..., 3) -> density (..., 1)`` float32, per scene unit.

    Raises:
        ValueError: ``density`` is not three-dimensional, or the box is impossible.

    Example:
        >>> field = grid_density_fn(np.array([[[0.0]], [[4.0]]]), [[0, 0, 0], [2, 1, 1]])
        >>> field(np.array([[1.0, 0.5, 0.5]])).item()
        2.0
    """
    values = np.ascontiguousarray(density, dtype=np.float32)
    if values.ndim != 3 or 0 in values.shape:
        raise InvalidArgument(f"grid_density_fn: density must have shape (X, Y, Z), got {values.shape}")
    box = as_aabb(aabb, caller="grid_density_fn")
    shape = np.array(values.shape)

    def density_fn(positions: NDArray[Any]) -> NDArray[np.float32]:
        points = np.asarray(positions, dtype=np.float64)
        inside = ((points >= box[0]) & (points <= box[1])).all(axis=-1)
        density = interpolate_grid(values, (points - box[0]) / (box[1] - box[0]) * shape - 0.5)
        return np.where(inside, density, np.float32(0.0))[..., None]

    return density_fn


def load_grid(path: str | Path) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Read ``density (X, Y, Z)`` and ``aabb (2, 3)`` from an ``.npz`` file.

    Returns:
        density ``(X, Y, Z)`` float32, and the box.

    Raises:
        FileNotFoundError: no such file.
        ValueError: not an ``.npz`` file, an array missing or of the wrong shape, an impossible box.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save_grid(Path(folder, "room.npz"), np.ones((4, 4, 2)), [[0, 0, 0], [2, 2, 1]])
        ...     density, box = load_grid(Path(folder, "room.npz"))
        >>> density.shape, box.tolist()
        ((4, 4, 2), [[0.0, 0.0, 0.0], [2.0, 2.0, 1.0]])
    """
    source = Path(path)
    try:
        with source.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in ("density", "aabb") if name in archive}
    except FileNotFoundError:
        raise MissingFile(f"load_grid: no file {source}") from None
    except (OSError, ValueError, EOFError, TypeError, AttributeError, zipfile.BadZipFile, zlib.error):
        kind = file_kind(source, caller="load_grid")
        if kind is not GRID:
            raise not_readable(source, kind, caller="load_grid") from None
        raise InvalidFile(f"load_grid: density or aabb in {source} is truncated, or no array of numbers") from None
    missing = sorted({"density", "aabb"} - set(arrays))
    if missing:
        raise InvalidFile(f"load_grid: {source} must hold the arrays density and aabb, lacks {', '.join(missing)}")
    density = arrays["density"]
    if density.ndim == 4 and density.shape[-1] == 1:
        density = density[..., 0]
    if density.ndim != 3 or 0 in density.shape:
        raise InvalidFile(f"load_grid: density in {source} must have shape (X, Y, Z), got {density.shape}")
    return density.astype(np.float32), as_aabb(arrays["aabb"], caller=f"load_grid: {source}")


def save_grid(path: str | Path, density: NDArray[Any], aabb: ArrayLike) -> None:
    """Write what :func:`load_grid` reads; whole or not at all.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save_grid(Path(folder, "room.npz"), np.ones((4, 4, 2)), [[0, 0, 0], [2, 2, 1]])
        ...     density, box = load_grid(Path(folder, "room.npz"))
        >>> density.shape, box.tolist()
        ((4, 4, 2), [[0.0, 0.0, 0.0], [2.0, 2.0, 1.0]])
    """
    write_npz(path, density=density, aabb=as_aabb(aabb, caller="save_grid"))
