"""The restoration objective: masked cross-entropy, heavier where something could be wrong."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from ...core.errors import InvalidArgument
from ...core.occupancy import DEFAULT_OPACITY_THRESHOLD, IGNORE_LABEL, SURFACE_LABEL, opacity_from_signed


def interesting_voxels(signed_opacity: Tensor, labels: Tensor) -> Tensor:
    """Voxels that are opaque in the input or surface in the label, and their 26 neighbours.

    Args:
        signed_opacity: ``(N, 1, R, R, R)`` in [-1, 1].
        labels: ``(N, R, R, R)`` uint8: 0 free, 1 surface, 2 ignore.

    Returns:
        ``(N, 1, R, R, R)`` bool.
    """
    opaque = opacity_from_signed(signed_opacity) > DEFAULT_OPACITY_THRESHOLD
    seeds: Tensor = opaque | (labels == SURFACE_LABEL)[:, None]
    for axis in (2, 3, 4):  # a box is separable; torch's max_pool3d takes ten times as long on a CPU
        grown = seeds.clone()
        last = seeds.shape[axis] - 1
        grown.narrow(axis, 1, last).logical_or_(seeds.narrow(axis, 0, last))
        grown.narrow(axis, 0, last).logical_or_(seeds.narrow(axis, 1, last))
        seeds = grown
    return seeds


def restoration_loss(
    logits: Tensor,
    labels: Tensor,
    signed_opacity: Tensor,
    *,
    interesting_weight: float,
    keep_weight: Tensor | None = None,
) -> Tensor:
    """Weighted mean of the cross-entropy over each cube's valid voxels.

    ``sum_v w_v BCE(logit_v, label_v) / sum_v w_v`` over voxels whose label is not "ignore", ``w`` being
    ``interesting_weight`` on :func:`interesting_voxels` and 1 elsewhere: most voxels are trivially empty.
    Voxels that are opaque in the input and surface in the label count ``keep_weight`` times on top.

    Args:
        logits: ``(N, 1, R, R, R)``.
        labels: ``(N, R, R, R)`` uint8: 0 free, 1 surface, 2 ignore.
        signed_opacity: ``(N, 1, R, R, R)``, the input's first channel.
        interesting_weight: > 0.
        keep_weight: ``(N,)`` > 0; at k, an opaque voxel whose odds of being surface are 1 : k gets a logit of 0.
            None for 1.

    Returns:
        ``(N,)`` float32, 0 for a cube without a valid voxel.
    """
    if not interesting_weight > 0:
        raise InvalidArgument(f"restoration_loss: interesting_weight must be > 0, got {interesting_weight}")
    if logits.shape != signed_opacity.shape or logits[:, 0].shape != labels.shape:
        raise InvalidArgument(
            f"restoration_loss: logits {tuple(logits.shape)}, labels {tuple(labels.shape)} and signed_opacity "
            f"{tuple(signed_opacity.shape)} must be (N, 1, R, R, R), (N, R, R, R) and (N, 1, R, R, R)"
        )
    target = (labels == SURFACE_LABEL).float()[:, None]
    with torch.no_grad():
        weight = torch.where(interesting_voxels(signed_opacity, labels), interesting_weight, 1.0)
        if keep_weight is not None:
            opaque = opacity_from_signed(signed_opacity) > DEFAULT_OPACITY_THRESHOLD
            weight = torch.where(opaque & (target > 0), weight * keep_weight.view(-1, 1, 1, 1, 1), weight)
        weight = weight * (labels != IGNORE_LABEL)[:, None]
        total = weight.flatten(1).sum(1)
    losses = functional.binary_cross_entropy_with_logits(logits.float(), target, reduction="none")
    return (losses * weight).flatten(1).sum(1) / total.clamp(min=1e-6)
