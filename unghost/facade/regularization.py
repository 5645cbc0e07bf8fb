"""``unghost.DensityRegularizer``: the regularizer with the shipped denoiser unless another is given (torch)."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.cameras import Cameras
from ..core.manifest import Denoiser
from ..core.sparse_points import SparsePoints
from ..denoisers import load_denoiser
from ..regularizer.density_regularizer import DensityRegularizer as RequiredDenoiserRegularizer
from ..regularizer.pitch import FieldPitch
from ..regularizer.settings import RegularizerSettings
from .choice import choose_denoiser


class DensityRegularizer(RequiredDenoiserRegularizer):
    """Add a learned prior over local geometry, a visibility prior and sight lines to the loss of any radiance field.

    Args:
        denoiser: from :func:`unghost.load_denoiser`; None loads, through onnxruntime, the shipped one that fits what is
            known (:func:`unghost.facade.choice.choose_denoiser`).
        aabb: ``(2, 3)`` smallest and largest corner, scene units: where the losses act.
        cameras: of the training photos; None switches the visibility loss off.
        depth_maps: ``(cameras, height, width)`` of the photos, along the optical axis, inf for nothing: the visibility
            loss then counts only cameras from which nothing hides a point.
        points: sparse points of the training photos, in the frame of ``cameras``; None switches the sight-line loss
            off.
        field_pitch: side of the field's own cells, scene units, or a function of cube centres ``(N, 3)`` that returns
            it as ``(N,)`` (a contracted field); None estimates it from the field (``pitch_estimate`` says how).
        device: where positions are created; None for the device of the field's parameters, else the CPU.
        cubes: cubes a step (40: the paper).
        every: act on every n-th call only; the calls between cost nothing and return zeros.
        dsds_weight: factor of the DSDS loss; 0 switches it off.
        visibility_weight: factor of the visibility loss; 0 switches it off.
        seed: seed for every random draw.
        settings: all other settings; the five arguments above replace theirs where given.

    Raises:
        ValueError: an impossible box or setting; ``depth_maps`` without ``cameras``.

    Example:
        >>> import torch
        >>> import unghost
        >>> field = torch.nn.Sequential(torch.nn.Linear(3, 1), torch.nn.Softplus())
        >>> regularizer = unghost.DensityRegularizer(aabb=[[-1, -1, -1], [1, 1, 1]], field_pitch=1 / 32, cubes=2)
        >>> losses = regularizer(field)
        >>> sorted(losses)
        ['dsds', 'sight_lines', 'visibility']
        >>> sum(losses.values()).backward()
        >>> bool(field[0].weight.grad.abs().sum() > 0)
        True
    """

    def __init__(
        self,
        denoiser: Denoiser | None = None,
        *,
        aabb: ArrayLike,
        cameras: Cameras | None = None,
        depth_maps: NDArray[np.floating] | None = None,
        points: SparsePoints | None = None,
        field_pitch: FieldPitch = None,
        device: Any = None,
        cubes: int | None = None,
        every: int | None = None,
        dsds_weight: float | None = None,
        visibility_weight: float | None = None,
        seed: int | None = None,
        settings: RegularizerSettings | None = None,
    ) -> None:
        given = {
            "cubes": cubes,
            "every": every,
            "dsds_weight": dsds_weight,
            "visibility_weight": visibility_weight,
            "seed": seed,
        }
        changes: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
        super().__init__(
            load_denoiser(choose_denoiser(cameras, points)) if denoiser is None else denoiser,
            aabb=aabb,
            cameras=cameras,
            depth_maps=depth_maps,
            points=points,
            field_pitch=field_pitch,
            device=device,
            settings=dataclasses.replace(settings or RegularizerSettings(), **changes),
        )
