"""Calling a denoiser: numpy or torch, arrays or tensors, checked on the way in and out."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import is_tensor, to_numpy
from ..core.errors import InvalidArgument, InvalidType
from ..core.manifest import Denoiser

BATCH = 40  # cubes handed to a denoiser at once


def check_denoiser(denoiser: Denoiser, *, caller: str) -> Denoiser:
    """Refuse what is no denoiser.

    Example:
        >>> from unghost.baselines.filters import Classical
        >>> check_denoiser(Classical("input"), caller="clean").manifest.channels
        ('signed_opacity',)
    """
    if not callable(denoiser) or not hasattr(denoiser, "manifest"):
        raise InvalidType(f"{caller}: denoiser must be callable and have a manifest, got {type(denoiser).__name__}")
    if getattr(denoiser, "kind", None) not in ("numpy", "torch"):
        raise InvalidArgument(
            f"{caller}: denoiser.kind must be 'numpy' or 'torch', got {getattr(denoiser, 'kind', None)!r}"
        )
    return denoiser


def run_denoiser(
    denoiser: Denoiser, channels: Any, timestep: int, edge_fraction: NDArray[np.floating], *, caller: str
) -> Any:
    """Denoise in batches, without gradient.

    Args:
        denoiser: see :class:`Denoiser`.
        channels: ``(N, C, R, R, R)`` float32 in [-1, 1], array or tensor.
        timestep: in [0, 1000).
        edge_fraction: ``(N,)``.
        caller: for errors.

    Returns:
        ``x0_pred (N, 1, R, R, R)`` float32, the kind of ``channels``.

    Raises:
        ValueError: a prediction of another shape, or one that is not finite.

    Example:
        >>> import numpy as np
        >>> from unghost.baselines.filters import Classical
        >>> channels = np.full((2, 1, 32, 32, 32), -1.0, np.float32)
        >>> run_denoiser(Classical("input"), channels, 300, np.full(2, 0.1), caller="example").shape
        (2, 1, 32, 32, 32)
    """
    if len(channels) == 0:
        return channels[:, :1]
    fractions = np.asarray(edge_fraction, dtype=np.float32)
    pieces = []
    for start in range(0, len(channels), BATCH):
        part, fraction = channels[start : start + BATCH], fractions[start : start + BATCH]
        pieces.append(_run_one(denoiser, part, timestep, fraction))
        expected = (len(part), 1, *part.shape[2:])
        if tuple(pieces[-1].shape) != expected:
            raise InvalidArgument(
                f"{caller}: denoiser {denoiser.manifest.name!r} must return shape {expected}, "
                f"got {tuple(pieces[-1].shape)}"
            )
    if is_tensor(channels):
        torch = sys.modules["torch"]
        result = torch.cat([torch.as_tensor(piece) for piece in pieces]).to(channels.device, torch.float32)
        finite = bool(torch.isfinite(result).all())
    else:
        result = np.concatenate([to_numpy(piece) for piece in pieces]).astype(np.float32, copy=False)
        finite = bool(np.isfinite(result).all())
    if not finite:
        raise InvalidArgument(f"{caller}: denoiser {denoiser.manifest.name!r} returned values that are not finite")
    return result


def _run_one(denoiser: Denoiser, channels: Any, timestep: int, edge_fraction: NDArray[np.float32]) -> Any:
    """One batch, converted to the denoiser's kind; the prediction stays of that kind."""
    timesteps = np.full(len(channels), timestep, dtype=np.int64)
    if denoiser.kind == "numpy":
        array = np.ascontiguousarray(to_numpy(channels), dtype=np.float32)
        return denoiser(array, timesteps, edge_fraction)
    import torch

    with torch.no_grad():
        tensor = channels if is_tensor(channels) else torch.from_numpy(np.ascontiguousarray(channels))
        moved = [torch.from_numpy(array).to(tensor.device) for array in (timesteps, edge_fraction)]
        return denoiser(tensor, *moved)
