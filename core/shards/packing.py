"""How shards store values: opacities and shares of light as 8 bits, labels as 2, frames as 13 numbers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..errors import InvalidArgument
from ..frames import RESOLUTION, CubeFrame
from ..occupancy import IGNORE_LABEL

VOXELS = RESOLUTION**3
FRAME_NUMBERS = 13


def pack_labels(labels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """``(N, R, R, R)`` labels 0, 1, 2 to ``(N, R^3 / 4)`` bytes; the first voxel is in the lowest two bits.

    Args:
        labels: N may be 0; R must be even.
    """
    if labels.ndim != 4 or np.prod(labels.shape[1:]) % 4:
        raise InvalidArgument(f"pack_labels: labels must have shape (N, R, R, R) with an even R, got {labels.shape}")
    if labels.size and not 0 <= labels.min() <= labels.max() <= IGNORE_LABEL:
        raise InvalidArgument(f"pack_labels: labels must be 0, 1 or 2, got {labels.min()} to {labels.max()}")
    quads = labels.astype(np.uint8).reshape(len(labels), int(np.prod(labels.shape[1:])) // 4, 4)
    return (quads * np.array([1, 4, 16, 64], dtype=np.uint8)).sum(axis=-1, dtype=np.uint8)


def unpack_labels(packed: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Inverse of :func:`pack_labels`: ``(N, 8192)`` bytes to ``(N, 32, 32, 32)``; N may be 0."""
    if packed.ndim != 2 or packed.shape[1] != VOXELS // 4:
        raise InvalidArgument(f"unpack_labels: packed must have shape (N, {VOXELS // 4}), got {packed.shape}")
    quads = np.stack([packed & 3, packed >> 2 & 3, packed >> 4 & 3, packed >> 6], axis=-1)
    return quads.reshape(len(packed), RESOLUTION, RESOLUTION, RESOLUTION)


def quantize_signed(signed: NDArray[np.floating]) -> NDArray[np.uint8]:
    """[-1, 1] to 0..255, rounded; -1 and +1 are exact."""
    return np.rint((signed + 1.0) * 127.5).astype(np.uint8)


def dequantize_signed(stored: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Inverse of :func:`quantize_signed`, to within 1/255."""
    return stored.astype(np.float32) / np.float32(127.5) - np.float32(1.0)


def quantize_share(share: NDArray[np.floating]) -> NDArray[np.uint8]:
    """[0, 1] to uint8; values beyond are clipped."""
    levels: NDArray[np.uint8] = np.rint(np.clip(share, 0.0, 1.0) * 255.0).astype(np.uint8)
    return levels


def dequantize_share(stored: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Inverse of :func:`quantize_share`, to float32 in [0, 1]."""
    share: NDArray[np.float32] = np.asarray(stored, dtype=np.float32) / np.float32(255.0)
    return share


def pack_frame(frame: CubeFrame | None) -> NDArray[np.float64]:
    """A cube as the ``(13,)`` numbers of ``frames``: centre, edge length, rotation row by row; NaN for no frame."""
    if frame is None:
        return np.full(FRAME_NUMBERS, np.nan)
    return np.concatenate([frame.center, [frame.edge_length], frame.rotation.ravel()])


def unpack_frame(numbers: NDArray[np.float64]) -> CubeFrame | None:
    """Inverse of :func:`pack_frame`."""
    if np.isnan(numbers).all():
        return None
    return CubeFrame(np.array(numbers[:3]), float(numbers[3]), np.array(numbers[4:]).reshape(3, 3))
