"""``unghost.clean`` and ``unghost.clean_splats``: cleaning with the shipped denoiser unless another is given."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from numpy.typing import ArrayLike, NDArray

from ..cleaning import pipeline, splats
from ..cleaning.keep_mask import KeepMask
from ..cleaning.photo_veto import PhotoVeto, Render
from ..cleaning.pipeline import CleanSettings
from ..cleaning.splats import REACH, CleanedSplats
from ..core.cameras import Cameras
from ..core.errors import InvalidArgument
from ..core.manifest import Denoiser
from ..core.sparse_points import SparsePoints
from ..denoisers import load_denoiser
from ..splats.ply import Gaussians
from .choice import choose_denoiser

Progress = Callable[[int, int], None]


def clean(
    density_fn: Callable[[Any], Any],
    aabb: ArrayLike,
    *,
    cameras: Cameras | None = None,
    points: SparsePoints | None = None,
    denoiser: Denoiser | None = None,
    strength: float | None = None,
    budget: float | None = None,
    photos: NDArray[Any] | None = None,
    render: Render | None = None,
    field_pitch: float | None = None,
    resolution: int | None = None,
    keep_boxes: Sequence[ArrayLike] | None = None,
    settings: CleanSettings | None = None,
    progress: Progress | None = None,
) -> KeepMask:
    """Decide which parts of a trained density field to keep. No gradient, no training, no torch needed.

    Args:
        density_fn: ``positions (M, 3) float32 -> density (M, 1) or (M,)``, >= 0 per scene unit; it takes and returns
            numpy arrays or torch tensors (which of the two is found out with one point).
        aabb: ``(2, 3)`` smallest and largest corner, scene units; nothing outside it is changed.
        cameras: of the training photos.
        points: sparse points of the training photos (``load_capture(...).points``), in the frame of ``cameras``, whose
            indices their observations use.
        denoiser: from :func:`unghost.load_denoiser`, run through onnxruntime. None loads the shipped one that fits what
            is known (:func:`unghost.facade.choice.choose_denoiser`); ``summary()["denoiser"]`` names it.
        strength: in [0, 1]: 0 removes nothing, 0.5 (the default) uses the denoiser's own threshold, 1 removes
            everything.
        budget: in (0, 1]: upper limit on the share of the field's optical depth that is removed, most certain cells
            first; None for no limit. ``summary()["depth_removed_share"]`` says how much went.
        photos: ``(N, H, W, 3)`` in [0, 1], of ``cameras``, in their order; with ``render``, they veto removals that
            make them worse (:class:`unghost.cleaning.photo_veto.PhotoVeto`), and justify none.
        render: ``render(density_fn, index) -> rgb (H, W, 3)``: renders photo ``index`` with the field's colours and
            the given density callable.
        field_pitch: side of the field's own cells, scene units; None uses 1/128 of the longest side of ``aabb``.
        resolution: cells of the sampling grid along the longest side; None derives it from ``field_pitch``.
        keep_boxes: ``(2, 3)`` boxes, scene units, in which nothing is removed (thin or transparent things).
        settings: all other settings; the arguments above replace theirs where given.
        progress: called with (windows done, windows in all).

    Returns:
        A :class:`unghost.KeepMask`: ``mask.apply(density_fn)`` is the cleaned field, ``mask.save("keep.npz")`` stores
        the decision, ``mask.summary()`` says what was removed.

    Raises:
        ValueError: an impossible box or setting; densities that are NaN, infinite, negative or of the wrong shape.

    Example:
        >>> import numpy as np
        >>> import unghost
        >>> def density_fn(positions):  # a ball of radius .5, and a small blob in the air
        ...     ball = np.linalg.norm(positions, axis=-1) < 0.5
        ...     blob = np.linalg.norm(positions - 0.8, axis=-1) < 0.1
        ...     return np.where(ball | blob, 80.0, 0.0)
        >>> mask = unghost.clean(density_fn, [[-1, -1, -1], [1, 1, 1]], resolution=48)
        >>> mask.keep(np.array([[0.0, 0.0, 0.49], [0.8, 0.8, 0.8]])).tolist()
        [True, False]
    """
    if (photos is None) != (render is None):
        raise InvalidArgument("clean: photos and render must come together, got one of them")
    veto = None if photos is None or render is None else PhotoVeto(photos, render)
    given = {"strength": strength, "budget": budget, "field_pitch": field_pitch, "resolution": resolution}
    changes: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    if keep_boxes is not None:
        changes["keep_boxes"] = tuple(keep_boxes)
    return pipeline.clean(
        density_fn,
        aabb,
        denoiser=load_denoiser(choose_denoiser(cameras, points)) if denoiser is None else denoiser,
        cameras=cameras,
        points=points,
        veto=veto,
        settings=dataclasses.replace(settings or CleanSettings(), **changes),
        progress=progress,
    )


def clean_splats(
    gaussians: Gaussians,
    *,
    cameras: Cameras | None = None,
    denoiser: Denoiser | None = None,
    strength: float | None = None,
    resolution: int | None = None,
    reach: float = REACH,
    box: ArrayLike | None = None,
    keep_boxes: Sequence[ArrayLike] | None = None,
    mask: KeepMask | None = None,
    settings: CleanSettings | None = None,
    progress: Progress | None = None,
) -> CleanedSplats:
    """Decide which Gaussians of a 3D Gaussian splat scene to keep.

    Args:
        gaussians: ``read_splat_ply(path).gaussians()`` of :mod:`unghost.splats`, or ``Gaussians.create(...)``.
        cameras: of the training photos, for a denoiser that uses view counts (``load_denoiser("views")``); any other
            ignores them, with a warning.
        denoiser: from :func:`unghost.load_denoiser`; None loads the shipped default through onnxruntime.
        strength: in [0, 1]: 0 removes nothing, 0.5 (the default) uses the denoiser's own threshold, 1 removes
            everything.
        resolution: cells along the longest side of the box, >= 8; None derives it from the sizes of the splats.
        reach: the box is this many times the core of the scene (98 % of the opacity), >= 1; what is beyond stays.
        box: ``(2, 3)`` scene units, in place of that: only what lies in it is judged, all else stays. For an object
            that is small beside its surroundings (a statue on a lawn).
        keep_boxes: ``(2, 3)`` boxes, scene units, in which nothing is removed.
        mask: of an earlier cleaning, to apply it again instead of judging.
        settings: all other settings; ``strength`` and ``keep_boxes`` replace theirs where given. Gaussians that cannot
            be judged (NaN, a rotation of length 0) stay, or go with ``drop_invalid``.
        progress: called with (windows done, windows in all).

    Returns:
        ``keep_score (N,)`` in [0, 1], ``keep (N,)`` and ``valid (N,)`` bool (which could be judged), the ``mask`` and
        the density ``field`` that was judged.

    Raises:
        ValueError: a resolution or reach out of range; an impossible setting; a box without Gaussians.

    Example:
        >>> import numpy as np
        >>> import unghost
        >>> from unghost.splats import Gaussians
        >>> rng = np.random.default_rng(0)
        >>> outward = rng.normal(size=(4000, 3))
        >>> ball = 0.5 * outward / np.linalg.norm(outward, axis=1, keepdims=True)
        >>> floaters = rng.normal(0.6, 0.03, (40, 3))
        >>> turned = np.tile([1.0, 0.0, 0.0, 0.0], (4040, 1))
        >>> scene = Gaussians.create(np.r_[ball, floaters], np.full((4040, 3), 0.02), turned, np.full(4040, 3.0))
        >>> cleaned = unghost.clean_splats(scene)
        >>> bool(cleaned.keep[:4000].mean() > 0.99), bool(cleaned.keep[4000:].any())
        (True, False)
    """
    changes: dict[str, Any] = {}
    if strength is not None:
        changes["strength"] = strength
    if keep_boxes is not None:
        changes["keep_boxes"] = tuple(keep_boxes)
    return splats.clean_splats(
        gaussians,
        denoiser=load_denoiser() if denoiser is None else denoiser,
        resolution=resolution,
        reach=reach,
        box=box,
        mask=mask,
        cameras=cameras,
        settings=dataclasses.replace(settings or CleanSettings(), **changes),
        progress=progress,
    )


def clean_ply(source: Path, target: Path | None, *, denoiser: Any = None, **options: Any) -> CleanedSplats:
    """:func:`unghost.cleaning.clean_ply` with the shipped denoiser unless another is given."""
    return splats.clean_ply(source, target, denoiser=load_denoiser() if denoiser is None else denoiser, **options)
