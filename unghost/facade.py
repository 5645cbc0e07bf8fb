"""The calls that choose a model: the classes and functions below them require their denoiser."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from .cleaning import pipeline, splats
from .cleaning.keep_mask import KeepMask
from .cleaning.splats import CleanedSplats
from .denoisers import load_denoiser


def clean(density_fn: Callable[..., Any], aabb: Any, *, denoiser: Any = None, **options: Any) -> KeepMask:
    """Decide which parts of a trained density field to keep. No gradient, no training, no torch needed.

    Args:
        density_fn: ``positions (..., 3) -> density (..., 1) or (...)``, numpy or torch, >= 0 per scene unit.
        aabb: ``(2, 3)`` smallest and largest corner, scene units; nothing outside it is changed.
        denoiser: from :func:`unghost.load_denoiser`; None loads the shipped one through onnxruntime.
        **options: those of :func:`unghost.cleaning.clean`, ``field_pitch`` foremost; ``cameras`` for a
            denoiser that asks how many of them see a place.

    Returns:
        A :class:`KeepMask`: ``mask.apply(density_fn)`` is the cleaned field, ``mask.save("keep.npz")``
        the undo, ``mask.summary()`` what was removed.

    Raises:
        ValueError: densities that are NaN, infinite, negative or of the wrong shape; an impossible box.

    Example:
        >>> mask = clean(lambda p: (abs(p) < 0.5).all(-1) * 50.0, [[-1, -1, -1], [1, 1, 1]], resolution=16)
        >>> mask.cells.shape
        (16, 16, 16)
    """
    return pipeline.clean(density_fn, aabb, denoiser=load_denoiser() if denoiser is None else denoiser, **options)


def clean_splats(gaussians: Any, *, denoiser: Any = None, **options: Any) -> CleanedSplats:
    """:func:`unghost.cleaning.clean_splats` with the shipped denoiser unless another is given."""
    return splats.clean_splats(gaussians, denoiser=load_denoiser() if denoiser is None else denoiser, **options)


def clean_ply(source: Path, target: Path | None, *, denoiser: Any = None, **options: Any) -> CleanedSplats:
    """:func:`unghost.cleaning.clean_ply` with the shipped denoiser unless another is given."""
    return splats.clean_ply(source, target, denoiser=load_denoiser() if denoiser is None else denoiser, **options)
