"""Soft inputs: clean and corrupted bits as the opacity that a smooth density grid would show.

Real fields do not err in blobs. Their density is smooth, true surfaces are spread over a few of the field's
cells, and most ghosts are half transparent. Everything here is separable, so a blur, a coarser grid and its
trilinear interpolation are one ``(R, R)`` matrix an axis.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.errors import InvalidArgument
from ...core.occupancy import opacity_from_density, signed_from_occupancy, signed_from_opacity
from ..solids.draws import log_uniform

ALIKE = 1 / 3  # of the soft cubes: ghosts as sharp and as opaque as the surface
Grid = NDArray[np.float32]
Matrix = NDArray[np.float32]


@lru_cache(maxsize=4096)
def _upsampling(cells: int, resolution: int) -> Matrix:
    """``(R, cells)``: linear interpolation from nodes that span the cube, end to end."""
    place = np.linspace(0.0, cells - 1.0, resolution)
    left = np.minimum(place.astype(int), max(cells - 2, 0))
    matrix = np.zeros((resolution, cells), dtype=np.float32)
    rows = np.arange(resolution)
    matrix[rows, left] = 1.0 - (place - left)
    matrix[rows, np.minimum(left + 1, cells - 1)] += place - left
    return matrix


def _separable(matrices: tuple[Matrix, Matrix, Matrix], grid: Grid) -> Grid:
    """Apply one ``(R, C)`` matrix to each axis of ``(C, C, C)``."""
    result = grid
    for matrix in matrices:
        rows = matrix @ result.reshape(result.shape[0], -1)
        result = rows.reshape(-1, *result.shape[1:]).transpose(1, 2, 0)
    return np.ascontiguousarray(result)


def coarse_noise(rng: np.random.Generator, cells: int, resolution: int) -> Grid:
    """Standard normal noise on ``cells^3`` nodes, trilinearly upsampled to ``(R, R, R)``.

    Example:
        >>> coarse_noise(np.random.default_rng(0), 4, 32).shape
        (32, 32, 32)
    """
    matrix = _upsampling(min(cells, resolution), resolution)
    return _separable((matrix,) * 3, rng.standard_normal((matrix.shape[1],) * 3, dtype=np.float32))


def _blurring(width: float, resolution: int) -> Matrix:
    """Gaussian blur of standard deviation ``width`` voxels; rows add to 1, so the border is not darkened."""
    index = np.arange(resolution)
    weights = np.exp(-0.5 * ((index[:, None] - index[None]) / max(width, 1e-3)) ** 2)
    matrix: Matrix = (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32)
    return matrix


def _regridding(cell: float, start: float, resolution: int) -> Matrix:
    """Average onto nodes ``cell`` voxels apart and interpolate back: what a coarser trilinear grid can hold."""
    nodes = np.arange(start - cell, resolution + cell, cell)
    hats = np.maximum(0.0, 1.0 - np.abs(np.arange(resolution)[:, None] - nodes[None]) / cell)
    hats = hats[:, hats.sum(axis=0) > 1e-6]
    back = hats / hats.sum(axis=1, keepdims=True)
    onto = hats / hats.sum(axis=0, keepdims=True)
    matrix: Matrix = (back @ onto.T).astype(np.float32)
    return matrix


def _smoothers(rng: np.random.Generator, width: float, resolution: int) -> tuple[Matrix, Matrix, Matrix]:
    """A blur of about ``width`` voxels: Gaussian, or a coarser grid placed at random."""
    if width < 0.45 or rng.random() < 0.5:
        matrix = _blurring(width, resolution)
        return matrix, matrix, matrix
    cell = 1.7 * width
    first, second, third = (_regridding(cell, float(rng.uniform(0, cell)), resolution) for _ in range(3))
    return first, second, third


def _optical_depth(opacity: float) -> float:
    return float(-np.log1p(-min(opacity, 0.9999)))


def _spread(rng: np.random.Generator, mask: NDArray[np.bool_], width: float, peak: float) -> Grid:
    """Optical depth of a mask smoothed by ``width`` voxels, scaled so that its median opacity is ``peak``."""
    resolution = mask.shape[0]
    depth = _separable(_smoothers(rng, width, resolution), mask.astype(np.float32))
    typical = float(np.median(depth[mask]))
    return depth * np.float32(_optical_depth(peak) / max(typical, 1e-3))


def _fog(rng: np.random.Generator, severity: float, resolution: int) -> Grid:
    """Low-frequency fog: patches whose opacity per voxel reaches 0.08 to 0.95 (log-uniform), times severity."""
    noise = coarse_noise(rng, int(rng.integers(2, 7)), resolution)
    noise += np.float32(0.3) * coarse_noise(rng, int(rng.integers(5, 12)), resolution)
    patches = np.maximum(noise - np.float32(rng.uniform(-1.5, 1.0)), 0.0)
    strongest = _optical_depth(float(np.exp(rng.uniform(np.log(0.08), np.log(0.95)))) * severity)
    fog: Grid = patches * np.float32(strongest / max(float(patches.max()), 1e-6))
    return fog


def soften(
    rng: np.random.Generator, clean: NDArray[np.bool_], corrupted: NDArray[np.bool_], severity: float
) -> NDArray[np.float32]:
    """Signed opacity of a smooth field whose bits would be about ``corrupted``.

    What ``clean`` and ``corrupted`` share is a true surface: blurred by 0.3 to 1.5 voxels, of opacity 0.3 to
    0.99. What ``corrupted`` adds is ghost: in a third of the cubes blurred and opaque as the surface is (or would
    be), so that neither gives it away, else blurred by 0.3 to 2.5 voxels and of opacity 0.05 to 0.97; its density
    varies smoothly in space. Fog volumes are added, the density is multiplied by smooth noise, and all of it passes
    through ``1 - exp(-density * voxel)``. Blur, fog and noise fade in with severity; at 0 the result is
    ``corrupted`` as bits.

    Args:
        clean: ``(R, R, R)`` bool, the true surface.
        corrupted: ``(R, R, R)`` bool.
        severity: [0, 1].

    Returns:
        ``(R, R, R)`` float32 in [-1, 1].

    Example:
        >>> rng = np.random.default_rng(0)
        >>> clean = np.zeros((32, 32, 32), dtype=bool)
        >>> clean[:, :, 10:13] = True  # a slab
        >>> signed = soften(rng, clean, clean, 0.5)
        >>> signed.shape, bool(signed.min() >= -1), bool(signed[clean].mean() > signed[~clean].mean())
        ((32, 32, 32), True, True)
    """
    if clean.shape != corrupted.shape or clean.dtype != np.bool_ or corrupted.dtype != np.bool_:
        raise InvalidArgument(
            f"soften: clean and corrupted must be boolean and of one shape, got {clean.dtype} {clean.shape} "
            f"and {corrupted.dtype} {corrupted.shape}"
        )
    if not 0.0 <= severity <= 1.0:
        raise InvalidArgument(f"soften: severity must lie in [0, 1], got {severity}")
    if severity == 0.0:
        return np.asarray(signed_from_occupancy(corrupted), dtype=np.float32)
    resolution, fade = clean.shape[0], min(1.0, 4.0 * severity)
    surface, ghost = clean & corrupted, corrupted & ~clean
    depth: Any = np.zeros(clean.shape, dtype=np.float32)
    peak, width = 1.0 - fade * log_uniform(rng, 0.01, 0.7), fade * rng.uniform(0.3, 1.5)
    if surface.any():
        depth = depth + _spread(rng, surface, width, peak)
    if ghost.any():
        if rng.random() >= ALIKE:
            peak, width = log_uniform(rng, 0.05, 0.97), fade * rng.uniform(0.3, 2.5)
        ghosts = _spread(rng, ghost, width, peak)
        uneven = np.exp(np.float32(rng.uniform(0, 1.0)) * coarse_noise(rng, int(rng.integers(2, 8)), resolution))
        depth = depth + ghosts * uneven
    if rng.random() < 0.75:
        depth = depth + _fog(rng, severity, resolution)
    strength = np.float32(fade * rng.uniform(0.0, 0.5))
    depth = depth * np.exp(strength * coarse_noise(rng, int(rng.integers(3, 20)), resolution))
    signed: NDArray[np.float32] = signed_from_opacity(opacity_from_density(depth.astype(np.float32), np.float32(1.0)))
    return np.clip(signed, np.float32(-1.0), np.float32(1.0))
