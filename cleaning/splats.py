"""3D Gaussian splats, cleaned: a field is made of them, ``clean`` judges the field, every Gaussian gets a score."""

from __future__ import annotations

import dataclasses
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.aabb import as_aabb, contains
from ..core.errors import InvalidArgument
from ..core.manifest import Denoiser
from ..splats.density import SplatField
from ..splats.ply import KEEP_SCORE, Gaussians, read_splat_ply, write_splat_ply
from .keep_mask import KeepMask
from .pipeline import CleanSettings, clean

SHARE = 0.98  # of the Gaussians' opacity, which the core of the scene holds along each axis
REACH = 2.0  # times the core's sides: floaters hover about it, the far background is left as it is
CELLS = (48, 256)  # fewest and most along the longest side, unless a resolution is asked for
CELLS_ACROSS = 2.0  # standard deviations of a typical splat, along its longest axis, that make a cell
DENSE = 0.25  # of the opacity, in the densest cells: what a scene is about
FEWEST = 20  # cells that this should span
KEPT_FROM = 0.5  # a Gaussian stays if at least this share of it does


@dataclass(frozen=True)
class CleanedSplats:
    """What became of ``N`` Gaussians.

    Attributes:
        keep_score: ``(N,)`` float32 in [0, 1]: which share of each lies in cells that are kept.
        keep: ``(N,)`` bool.
        mask: the cells, its preview (``mask.summary()``, with ``invalid_splats``) and undo.
        field: the density that was judged.
        valid: ``(N,)`` bool: those that could be judged. Others (NaN, a rotation of length 0) score 1, or 0 with
            ``drop_invalid``.

    Example: see :func:`unghost.clean_splats`; ``cleaned.keep.mean()`` is the share that stays, and
    ``cleaned.mask.summary()`` says what goes.
    """

    keep_score: NDArray[np.float32]
    keep: NDArray[np.bool_]
    mask: KeepMask
    field: SplatField
    valid: NDArray[np.bool_]


def keep_scores(gaussians: Gaussians, mask: KeepMask) -> NDArray[np.float32]:
    """Share of each Gaussian that is kept: of its middle and the six points a standard deviation out, ``(N,)``.

    1 where a Gaussian is not valid: it cannot be judged.
    """
    arms = gaussians.rotations * gaussians.extents[:, None, :]  # columns: its own axes, a standard deviation long
    total = mask.keep(gaussians.means).astype(np.float32)
    for axis in range(3):
        for sign in (-1.0, 1.0):
            total += mask.keep(gaussians.means + sign * arms[:, :, axis])
    scores: NDArray[np.float32] = (total / 7.0).astype(np.float32)
    scores[~gaussians.valid] = 1.0
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

    Gaussians that are not valid do not count.
    """
    gaussians = gaussians.only(gaussians.valid)
    longest = float((aabb[1] - aabb[0]).max())
    if resolution is not None:
        return longest / resolution
    sizes, weight = gaussians.extents.max(axis=1), gaussians.opacity()
    order = np.argsort(sizes)
    total = np.cumsum(weight[order])
    typical = float(sizes[order[np.searchsorted(total, total[-1] / 2)]])
    return float(np.clip(CELLS_ACROSS * typical, longest / CELLS[1], longest / CELLS[0]))


def judged_box(gaussians: Gaussians, box: ArrayLike) -> tuple[NDArray[np.float64], Gaussians]:
    """The part of ``box (2, 3)`` that holds anything, and the valid Gaussians whose middle lies in it.

    Raises:
        ValueError: an impossible box, or one without Gaussians.

    Example:
        >>> gaussians = Gaussians.create([[0, 0, 0], [9, 0, 0]], np.ones((2, 3)), [[1, 0, 0, 0]] * 2, np.zeros(2))
        >>> aabb, inside = judged_box(gaussians, [[-5, -5, -5], [5, 5, 5]])
        >>> aabb.tolist(), len(inside)
        ([[-1.0, -1.0, -1.0], [5.0, 1.0, 1.0]], 1)
    """
    asked = as_aabb(box, caller="clean_splats: box")
    everything = gaussians.aabb(share=1.0)
    inside = gaussians.only(gaussians.valid & contains(asked, gaussians.means))
    if not len(inside):
        raise InvalidArgument(
            f"clean_splats: box must hold Gaussians, got {asked.tolist()}; all lie in {everything.round(3).tolist()}"
        )
    aabb = np.clip(asked, *everything)
    return (aabb if (aabb[0] < aabb[1]).all() else asked), inside


def warn_if_small(gaussians: Gaussians, aabb: NDArray[np.float64], pitch: float) -> None:
    """Warn where what the scene is about spans fewer than 20 cells and a quarter of the box.

    What it is about: the densest cells, which hold a quarter of the opacity; their span is that of 90 % of it.
    """
    inside = gaussians.valid & contains(aabb, gaussians.means)
    weight = gaussians.opacity()[inside]
    if not weight.sum() > 0:
        return
    shape = np.ceil((aabb[1] - aabb[0]) / pitch).astype(np.int64) + 1
    places = np.floor((gaussians.means[inside] - aabb[0]) / pitch).astype(np.int64)
    numbers, of = np.unique(np.ravel_multi_index(tuple(places.T), tuple(shape)), return_inverse=True)
    cells, total = np.stack(np.unravel_index(numbers, tuple(shape)), axis=1), np.bincount(of, weight)
    order = np.argsort(-total, kind="stable")
    dense = order[: int(np.searchsorted(np.cumsum(total[order]), DENSE * total.sum())) + 1]
    ends = np.empty((2, 3))
    for axis in range(3):
        along = dense[np.argsort(cells[dense, axis], kind="stable")]
        shares = np.cumsum(total[along]) / total[along].sum()
        ends[:, axis] = cells[along[np.searchsorted(shares, [0.05, 0.95])], axis]
    span = float((ends[1] - ends[0]).max()) + 1.0
    if span >= min(FEWEST, float((aabb[1] - aabb[0]).max()) / pitch / 4):
        return
    around = aabb[0] + pitch * np.array([ends[0] - span, ends[1] + 1 + span])  # as much again on each side
    corners = " ".join(f"{value:.4g}" for value in np.clip(around, *aabb).ravel())
    warnings.warn(
        f"clean_splats: the densest part of the scene spans {span:.0f} cells of side {pitch:.3g}, fewer than {FEWEST}: "
        f"its details may be removed. Judge it alone: box (--box), say {corners}",
        stacklevel=3,
    )


def clean_splats(
    gaussians: Gaussians,
    *,
    denoiser: Denoiser,
    resolution: int | None = None,
    reach: float = REACH,
    box: ArrayLike | None = None,
    mask: KeepMask | None = None,
    settings: CleanSettings | None = None,
    **options: Any,
) -> CleanedSplats:
    """Decide which Gaussians to keep.

    Args:
        gaussians: of :meth:`unghost.splats.ply.SplatPly.gaussians`.
        denoiser: from :func:`unghost.load_denoiser`.
        resolution: cells along the box's longest side, >= 8: how fine the judgement is. None: by the splats' sizes.
        reach: of :func:`box_of`, >= 1; what is beyond stays.
        box: ``(2, 3)`` scene units: only what lies in it is judged, all else stays. None: ``reach`` times the core.
        mask: of an earlier cleaning, to repeat it; None to judge.
        settings: see :class:`unghost.cleaning.pipeline.CleanSettings`. With ``drop_invalid``, Gaussians that cannot
            be judged are removed; else they stay.
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
    if mask is not None and box is not None:
        raise InvalidArgument("clean_splats: mask repeats a cleaning in its own box; leave out box")
    if mask is None:
        judged = CleanSettings() if settings is None else settings
        aabb, inside = (box_of(gaussians, reach=reach), gaussians) if box is None else judged_box(gaussians, box)
        pitch = pitch_of(inside, aabb, resolution)
        warn_if_small(gaussians, aabb, pitch)
        field = SplatField(gaussians, pitch=pitch)
        mask = clean(field.density_fn, aabb, denoiser=denoiser, field_pitch=pitch, settings=judged, **options)
    else:
        field = SplatField(gaussians, pitch=mask.pitch)
    drop = bool(mask.details.get("settings", {}).get("drop_invalid", False))
    scores, valid = keep_scores(gaussians, mask), gaussians.valid
    scores[~valid] = 0.0 if drop else 1.0
    counted = dataclasses.replace(mask, details={**mask.details, "invalid_splats": int((~valid).sum())})
    return CleanedSplats(scores, scores >= KEPT_FROM, counted, field, valid)


def clean_ply(
    source: Path, target: Path | None, *, scores_only: bool = False, keep_score: bool = False, **options: Any
) -> CleanedSplats:
    """Clean a 3DGS or 2DGS ``.ply``: write the rows that are kept, byte for byte.

    Args:
        source: the file; it is not changed.
        target: another; None to write nothing.
        scores_only: write all rows with their ``keep_score``, to decide later.
        keep_score: add the property ``keep_score`` to the rows that are kept (strict readers want the standard
            properties alone). One that the source has is renewed in any case.
        **options: of :func:`clean_splats`.

    Raises:
        ValueError: not a .ply of Gaussians, one cut short; ``target`` is ``source``.
    """
    splats = read_splat_ply(source)
    if target is not None and target.exists() and target.samefile(source):
        raise InvalidArgument(f"clean: {target} is the file to clean; write to another")
    found = clean_splats(splats.gaussians(), **options)
    if target is not None:
        scored = scores_only or keep_score or KEEP_SCORE in (splats.rows.dtype.names or ())
        write_splat_ply(target, splats, keep=found.keep | scores_only, keep_score=found.keep_score if scored else None)
    return found
