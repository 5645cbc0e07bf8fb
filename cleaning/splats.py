"""3D Gaussian splats, cleaned: a field is made of them, ``clean`` judges the field, every Gaussian gets a score."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InvalidArgument
from ..core.manifest import Denoiser
from ..splats.density import SplatField
from ..splats.ply import Gaussians, read_splat_ply, write_splat_ply
from .keep_mask import KeepMask
from .pipeline import clean

SHARE = 0.98  # of the Gaussians' opacity, which the core of the scene holds along each axis
REACH = 2.0  # times the core's sides: floaters hover about it, the far background is left as it is
CELLS = (48, 256)  # fewest and most along the longest side, unless a resolution is asked for
CELLS_ACROSS = 2.0  # standard deviations of a typical splat, along its longest axis, that make a cell
KEPT_FROM = 0.5  # a Gaussian stays if at least this share of it does


@dataclass(frozen=True)
class CleanedSplats:
    """What became of ``N`` Gaussians.

    Attributes:
        keep_score: ``(N,)`` float32 in [0, 1]: which share of each lies in cells that are kept.
        keep: ``(N,)`` bool.
        mask: the cells, its preview (``mask.summary()``) and undo.
        field: the density that was judged.

    Example: see :func:`unghost.clean_splats`; ``cleaned.keep.mean()`` is the share that stays, and
    ``cleaned.mask.summary()`` says what goes.
    """

    keep_score: NDArray[np.float32]
    keep: NDArray[np.bool_]
    mask: KeepMask
    field: SplatField


def keep_scores(gaussians: Gaussians, mask: KeepMask) -> NDArray[np.float32]:
    """Share of each Gaussian that is kept: of its middle and the six points a standard deviation out, ``(N,)``."""
    arms = gaussians.rotations * gaussians.extents[:, None, :]  # columns: its own axes, a standard deviation long
    total = mask.keep(gaussians.means).astype(np.float32)
    for axis in range(3):
        for sign in (-1.0, 1.0):
            total += mask.keep(gaussians.means + sign * arms[:, :, axis])
    scores: NDArray[np.float32] = (total / 7.0).astype(np.float32)
    return scores


def box_of(gaussians: Gaussians, *, reach: float = REACH) -> NDArray[np.float64]:
    """Where to clean ``(2, 3)``: ``reach`` times the box that holds 98 % of the opacity, and no more than there is.

    Example:
        >>> means = np.random.default_rng(0).uniform(-1, 1, (200, 3)) * [1, 1, 0.02]
        >>> quaternions = np.tile([1.0, 0.0, 0.0, 0.0], (200, 1))
        >>> gaussians = Gaussians.create(means, np.full((200, 3), 0.1), quaternions, np.full(200, 4.0))
        >>> box_of(gaussians).shape
        (2, 3)
    """
    core, everything = gaussians.aabb(share=SHARE), gaussians.aabb(share=1.0)
    middle, half = core.mean(axis=0), (core[1] - core[0]) / 2
    box: NDArray[np.float64] = np.clip(middle + reach * np.array([-1.0, 1.0])[:, None] * half, *everything)
    return box


def pitch_of(gaussians: Gaussians, aabb: NDArray[np.float64], resolution: int | None) -> float:
    """Side of a cell: by the resolution, or of a typical splat's own size (the median, opaque ones counting more).

    Example:
        >>> means = np.random.default_rng(0).uniform(-1, 1, (200, 3)) * [1, 1, 0.02]
        >>> quaternions = np.tile([1.0, 0.0, 0.0, 0.0], (200, 1))
        >>> gaussians = Gaussians.create(means, np.full((200, 3), 0.1), quaternions, np.full(200, 4.0))
        >>> round(pitch_of(gaussians, np.array([[-1.0] * 3, [1.0] * 3]), 50), 3)
        0.04
    """
    longest = float((aabb[1] - aabb[0]).max())
    if resolution is not None:
        return longest / resolution
    sizes, weight = gaussians.extents.max(axis=1), gaussians.opacity()
    order = np.argsort(sizes)
    total = np.cumsum(weight[order])
    typical = float(sizes[order[np.searchsorted(total, total[-1] / 2)]])
    return float(np.clip(CELLS_ACROSS * typical, longest / CELLS[1], longest / CELLS[0]))


def clean_splats(
    gaussians: Gaussians,
    *,
    denoiser: Denoiser,
    resolution: int | None = None,
    reach: float = REACH,
    mask: KeepMask | None = None,
    **options: Any,
) -> CleanedSplats:
    """Decide which Gaussians to keep.

    Args:
        gaussians: of :meth:`unghost.splats.ply.SplatPly.gaussians`.
        denoiser: from :func:`unghost.load_denoiser`.
        resolution: cells along the box's longest side, >= 8: how fine the judgement is. None: by the splats' sizes.
        reach: of :func:`box_of`, >= 1; what is beyond stays.
        mask: of an earlier cleaning, to repeat it; None to judge.
        **options: of :func:`unghost.cleaning.clean`: ``strength``, ``keep_boxes``, ``cameras``, ``progress``, …

    Example:
        >>> from unghost.baselines.filters import Classical
        >>> means = np.random.default_rng(0).uniform(-1, 1, (200, 3)) * [1, 1, 0.02]
        >>> quaternions = np.tile([1.0, 0.0, 0.0, 0.0], (200, 1))
        >>> gaussians = Gaussians.create(means, np.full((200, 3), 0.1), quaternions, np.full(200, 4.0))
        >>> cleaned = clean_splats(gaussians, denoiser=Classical("input"), resolution=32)
        >>> cleaned.keep.shape, bool(cleaned.keep.all())
        ((200,), True)
    """
    if resolution is not None and resolution < 8:
        raise InvalidArgument(f"clean_splats: resolution must be >= 8, got {resolution}")
    if not 1.0 <= reach < np.inf:
        raise InvalidArgument(f"clean_splats: reach must be finite and >= 1, got {reach}")
    aabb = box_of(gaussians, reach=reach)
    pitch = pitch_of(gaussians, aabb, resolution) if mask is None else mask.pitch
    field = SplatField(gaussians, pitch=pitch)
    mask = mask or clean(field.density_fn, aabb, denoiser=denoiser, field_pitch=pitch, **options)
    scores = keep_scores(gaussians, mask)
    return CleanedSplats(scores, scores >= KEPT_FROM, mask, field)


def clean_ply(source: Path, target: Path | None, *, scores_only: bool = False, **options: Any) -> CleanedSplats:
    """Clean a 3DGS ``.ply``: the kept rows, byte for byte, and their ``keep_score`` as one more property.

    Args:
        source: the file; it is not changed.
        target: another; None to write nothing.
        scores_only: write all rows, to decide later.
        **options: of :func:`clean_splats`.

    Raises:
        ValueError: not a 3DGS .ply, one cut short, values that are not finite; ``target`` is ``source``.
    """
    splats = read_splat_ply(source)
    if target is not None and target.exists() and target.samefile(source):
        raise InvalidArgument(f"clean: {target} is the file to clean; write to another")
    found = clean_splats(splats.gaussians(), **options)
    if target is not None:
        write_splat_ply(target, splats, keep=found.keep | scores_only, keep_score=found.keep_score)
    return found
