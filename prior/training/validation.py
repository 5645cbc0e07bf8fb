"""Scores of a denoiser on a shard of held-out pairs."""

from __future__ import annotations

import itertools
from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ...core.arrays import to_numpy
from ...core.manifest import Denoiser
from ...core.occupancy import (
    DECISION,
    DEFAULT_OPACITY_THRESHOLD,
    FREE_LABEL,
    IGNORE_LABEL,
    SURFACE_LABEL,
    opacity_from_signed,
)
from ...core.shards.packing import unpack_labels
from ...core.shards.storage import Shard
from .batches import stored_channels

HISTOGRAM_BINS = 2048  # over [-1, 1]: thresholds are exact to 1/1024
KEPT = (0.98, 0.95, 0.90)
SEVERITY_EDGES = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)


def masked_iou(preds: NDArray[np.bool_], target: NDArray[np.bool_], valid: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Intersection over union of each cube ``(N, R, R, R)`` on its valid voxels; 1 where both are empty."""
    both = (preds & target & valid).reshape(len(preds), -1).sum(1)
    either = ((preds | target) & valid).reshape(len(preds), -1).sum(1)
    return np.where(either > 0, both / np.maximum(either, 1), 1.0)


@dataclass
class KeepCurve:
    """Histograms of a score on true and on ghost voxels; a voxel is removed if its score is below a threshold."""

    true: NDArray[np.int64] = field(default_factory=lambda: np.zeros(HISTOGRAM_BINS, np.int64))
    ghost: NDArray[np.int64] = field(default_factory=lambda: np.zeros(HISTOGRAM_BINS, np.int64))

    def add(self, score: NDArray[Any], true: NDArray[np.bool_], ghost: NDArray[np.bool_]) -> None:
        """Count voxels; ``score`` in [-1, 1], all of one shape."""
        bins = np.clip(np.floor((score + 1.0) * (HISTOGRAM_BINS / 2)), 0, HISTOGRAM_BINS - 1).astype(np.int64)
        self.true += np.bincount(bins[true], minlength=HISTOGRAM_BINS)
        self.ghost += np.bincount(bins[ghost], minlength=HISTOGRAM_BINS)

    def threshold(self, kept: float) -> float:
        """The largest threshold, a multiple of 1/1024, that keeps at least ``kept`` of the true voxels."""
        below = np.concatenate([[0], np.cumsum(self.true)])  # true voxels in bins before each edge
        allowed = np.flatnonzero(below <= (1.0 - kept) * below[-1] + 1e-9)
        return float(allowed[-1] / (HISTOGRAM_BINS / 2) - 1.0)

    def removed(self, threshold: float) -> float:
        """Part of the ghost voxels below a threshold that is a multiple of 1/1024; NaN without ghosts."""
        edge = round((threshold + 1.0) * (HISTOGRAM_BINS / 2))
        total = int(self.ghost.sum())
        return float(self.ghost[:edge].sum() / total) if total else float("nan")

    def kept(self, threshold: float) -> float:
        """Part of the true voxels at or above a threshold that is a multiple of 1/1024; NaN without any."""
        edge = round((threshold + 1.0) * (HISTOGRAM_BINS / 2))
        total = int(self.true.sum())
        return float(self.true[edge:].sum() / total) if total else float("nan")


def _subset(count: int, limit: int | None) -> NDArray[np.int64]:
    """All cubes, or ``limit`` of them evenly spread."""
    if limit is None or limit >= count:
        return np.arange(count)
    return np.linspace(0, count - 1, limit).round().astype(np.int64)


def _denoise(denoiser: Denoiser, channels: NDArray[np.float32], timestep: int, edge: NDArray[Any]) -> NDArray[Any]:
    if denoiser.kind == "torch":
        result = to_numpy(denoiser(torch.from_numpy(channels), timestep, torch.from_numpy(edge)))
    else:
        result = to_numpy(denoiser(channels, timestep, edge))
    return result[:, 0]


def evaluate(
    denoiser: Denoiser,
    shard: Shard,
    *,
    timestep: int | None = None,
    limit: int | None = None,
    batch_size: int = 64,
    without: Collection[str] = (),
) -> dict[str, Any]:
    """IoU before and after, and how many ghosts go when nearly all of the true surface stays.

    Occupied is opacity > 0.1 in the input, ``x0_pred`` > 0 in the output, "surface" in the label; ignored
    voxels do not count. A ghost voxel is opaque in the input and free in the label, a true one opaque and
    surface. One score above a threshold keeps a voxel: ``x0_pred``, and beside it the raw opacity.

    Args:
        denoiser: torch or numpy, of any channels; those that the shard does not store are unknown.
        shard: held-out pairs.
        timestep: the same for all; None for the manifest's default.
        limit: at most so many cubes, evenly spread.
        batch_size: cubes at a time.
        without: names of optional channels to call unknown, as for a caller who cannot supply them.

    Returns:
        ``cubes, timestep, iou_before, iou, iou_clean`` (severity 0; None without such cubes), ``by_severity``
        (rows ``severity_from, severity_to, cubes, iou_before, iou``), ``true_voxels, ghost_voxels``, and for .98, .95
        and .90 kept ``ghosts_removed_98, threshold_98, ghosts_removed_98_opacity`` …, and at the decision
        0 ``ghosts_removed_zero, surface_kept_zero``. JSON-able; None for what is undefined.
    """
    chosen = _subset(len(shard), limit)
    step = denoiser.manifest.default_timestep if timestep is None else timestep
    before, after = np.empty(len(chosen)), np.empty(len(chosen))
    learned, raw = KeepCurve(), KeepCurve()
    for start in range(0, len(chosen), batch_size):
        index = chosen[start : start + batch_size]
        channels = stored_channels(shard, index, denoiser.manifest.channels, without=without)
        signed, labels = channels[:, 0], unpack_labels(shard.labels[index])
        x0_pred = _denoise(denoiser, channels, step, np.array(shard.edge_fraction[index]))
        opaque = opacity_from_signed(signed) > DEFAULT_OPACITY_THRESHOLD
        surface, valid = labels == SURFACE_LABEL, labels != IGNORE_LABEL
        before[start : start + len(index)] = masked_iou(opaque, surface, valid)
        after[start : start + len(index)] = masked_iou(x0_pred > DECISION, surface, valid)
        for curve, score in ((learned, x0_pred), (raw, signed)):
            curve.add(score, opaque & surface, opaque & (labels == FREE_LABEL))
    severity = np.array(shard.severity[chosen])
    return {
        "cubes": len(chosen),
        "timestep": int(step),
        "iou_before": _mean(before),
        "iou": _mean(after),
        "iou_clean": _mean(after[severity == 0.0]),
        "by_severity": _by_severity(severity, before, after),
        **_ghost_scores(learned, raw),
    }


def _mean(values: NDArray[Any]) -> float | None:
    return float(values.mean()) if values.size else None


def _by_severity(severity: NDArray[Any], before: NDArray[Any], after: NDArray[Any]) -> list[dict[str, Any]]:
    rows = []
    for low, high in itertools.pairwise(SEVERITY_EDGES):
        inside = (severity > low) & (severity <= high)
        if inside.any():
            rows.append(
                {
                    "severity_from": low,
                    "severity_to": high,
                    "cubes": int(inside.sum()),
                    "iou_before": _mean(before[inside]),
                    "iou": _mean(after[inside]),
                }
            )
    return rows


def _ghost_scores(learned: KeepCurve, raw: KeepCurve) -> dict[str, Any]:
    true, ghost = int(learned.true.sum()), int(learned.ghost.sum())
    scores: dict[str, Any] = {"true_voxels": true, "ghost_voxels": ghost}
    defined = true > 0 and ghost > 0
    for kept in KEPT:
        key = f"{round(kept * 100)}"
        threshold = learned.threshold(kept)
        scores[f"threshold_{key}"] = threshold if defined else None
        scores[f"ghosts_removed_{key}"] = learned.removed(threshold) if defined else None
        scores[f"ghosts_removed_{key}_opacity"] = raw.removed(raw.threshold(kept)) if defined else None
    scores["ghosts_removed_zero"] = learned.removed(DECISION) if defined else None
    scores["surface_kept_zero"] = learned.kept(DECISION) if defined else None
    return scores
