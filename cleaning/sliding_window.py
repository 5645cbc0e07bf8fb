"""A denoiser's opinion of a whole voxel grid: overlapping windows, averaged. numpy only."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ..core.channels import stack_channels
from ..core.manifest import Denoiser
from ..core.occupancy import EMPTY
from .denoiser_calls import BATCH, run_denoiser
from .grid_channels import GridContext

FloatGrid = NDArray[np.float32]
Mask = NDArray[np.bool_]
Progress = Callable[[int, int], None]
Scalar = TypeVar("Scalar", bound=np.generic)


def window_weight(resolution: int) -> FloatGrid:
    """``(R, R, R)`` weight of a window's voxels: a raised cosine, heaviest in the middle, nowhere zero.

    Example:
        >>> weight = window_weight(4)
        >>> weight.shape, bool(weight[1, 1, 1] > weight[0, 0, 0] > 0)
        ((4, 4, 4), True)
    """
    axis = np.sin(np.pi * (np.arange(resolution) + 0.5) / resolution) ** 2 + 0.05
    return (axis[:, None, None] * axis[:, None] * axis).astype(np.float32)


def window_starts(length: int, resolution: int, stride: int) -> NDArray[np.int64]:
    """First indices of windows along an axis of ``length`` cells; they reach out, so that all are covered alike.

    Example:
        >>> window_starts(64, 32, 16).tolist()
        [-16, 0, 16, 32, 48]
    """
    last = -(-(length + resolution - 2 * stride) // stride)
    return np.arange(max(last, 0) + 1) * stride - (resolution - stride)


def shrink(signed: FloatGrid, factor: int) -> FloatGrid:
    """Largest value of each block of ``factor^3`` cells; what sticks out is padded with empty.

    Example:
        >>> signed = np.full((4, 4, 4), -1.0, np.float32)
        >>> signed[0, 0, 0] = 1.0
        >>> shrink(signed, 2)[0, 0].tolist()
        [1.0, -1.0]
    """
    if factor == 1:
        return signed
    pad = [(0, -length % factor) for length in signed.shape]
    padded = np.pad(signed, pad, constant_values=EMPTY)
    x, y, z = (length // factor for length in padded.shape)
    result: FloatGrid = padded.reshape(x, factor, y, factor, z, factor).max(axis=(1, 3, 5))
    return result


def grow(values: NDArray[Scalar], factor: int, shape: tuple[int, ...]) -> NDArray[Scalar]:
    """Repeat each cell ``factor`` times along each axis and cut to ``shape``.

    Example:
        >>> grow(np.array([[[1, 2]]]), 2, (1, 1, 3)).tolist()
        [[[1, 1, 2]]]
    """
    for axis in range(3):
        values = np.repeat(values, factor, axis=axis)
    return values[: shape[0], : shape[1], : shape[2]]


def vote(
    signed: FloatGrid,
    wanted: Mask,
    *,
    denoiser: Denoiser,
    timestep: int,
    edge_fraction: float,
    overlap: float = 0.5,
    skip_empty: bool = True,
    progress: Progress | None = None,
    context: GridContext | None = None,
) -> tuple[FloatGrid, int]:
    """Weighted mean of ``x0_pred`` over all windows that hold a cell.

    Args:
        signed: ``(X, Y, Z)`` signed opacity; what lies beyond counts as empty.
        wanted: ``(X, Y, Z)`` where an answer is needed; windows without such a cell are not sent (their
            answer could not matter), unless ``skip_empty`` is False.
        denoiser: of any channels.
        timestep: in [0, 1000).
        edge_fraction: of a window.
        overlap: of neighbouring windows along an axis, in [0, 1).
        skip_empty: see ``wanted``.
        progress: called with (windows done, windows in all).
        context: supplies optional channels; without it they are unknown.

    Returns:
        ``(X, Y, Z)`` float32 in [-1, 1], ``EMPTY`` where no window was sent; and how many were sent.
    """
    resolution = denoiser.manifest.resolution
    stride = max(1, round(resolution * (1.0 - overlap)))
    starts = [window_starts(length, resolution, stride) for length in signed.shape]
    pad = [(-int(s[0]), int(s[-1]) + resolution - length) for s, length in zip(starts, signed.shape)]
    padded = np.pad(signed, pad, constant_values=EMPTY)
    needed = np.pad(wanted, pad)
    corners = [
        corner
        for corner in itertools.product(*[(s - s[0]).tolist() for s in starts])
        if not skip_empty or needed[_box(corner, resolution)].any()
    ]
    total = np.zeros(padded.shape, dtype=np.float32)
    weights = np.zeros(padded.shape, dtype=np.float32)
    weight = window_weight(resolution)
    for start in range(0, len(corners), BATCH):
        batch = corners[start : start + BATCH]
        signed_windows = np.stack([padded[_box(corner, resolution)] for corner in batch])
        channels = signed_windows[:, None]
        if len(denoiser.manifest.channels) > 1:
            places = [tuple(at - before for at, (before, _) in zip(corner, pad)) for corner in batch]
            known = {} if context is None else context.known(places)
            channels = stack_channels(denoiser.manifest.channels, signed_windows, known)
        fractions = np.full(len(batch), edge_fraction)
        predictions = run_denoiser(denoiser, channels, timestep, fractions, caller="clean")
        for corner, prediction in zip(batch, predictions):
            total[_box(corner, resolution)] += weight * prediction[0]
            weights[_box(corner, resolution)] += weight
        if progress is not None:
            progress(start + len(batch), len(corners))
    mean = np.full(padded.shape, EMPTY, dtype=np.float32)
    np.divide(total, weights, out=mean, where=weights > 0)
    inner = tuple(slice(before, before + length) for (before, _), length in zip(pad, signed.shape))
    return mean[inner], len(corners)


def _box(corner: tuple[int, ...], resolution: int) -> tuple[slice, ...]:
    return tuple(slice(start, start + resolution) for start in corner)
