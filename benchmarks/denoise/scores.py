"""Scores of a denoiser on a set of labelled cubes: one pass, every column of the reference measurement."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unghost.core.occupancy import (
    DECISION,
    DEFAULT_OPACITY_THRESHOLD,
    FREE_LABEL,
    IGNORE_LABEL,
    SURFACE_LABEL,
    opacity_from_signed,
)
from unghost.prior.training.validation import KEPT, KeepCurve, masked_iou

Predict = Callable[[NDArray[np.int64]], NDArray[np.float32]]


@dataclass
class Tally:
    """Voxels counted over all cubes of a set.

    Attributes:
        curves: scores of true and ghost voxels; one for the set, one for each group.
        ious, ious_before: of each cube.
        counts: ghosts, ghosts removed, true voxels, true ones kept, holes, holes filled.
    """

    curves: dict[int, KeepCurve] = field(default_factory=dict)
    ious: list[float] = field(default_factory=list)
    ious_before: list[float] = field(default_factory=list)
    counts: NDArray[np.int64] = field(default_factory=lambda: np.zeros(6, dtype=np.int64))

    def add(
        self, signed: NDArray[np.float32], labels: NDArray[np.uint8], group: NDArray[np.int32], x0_pred: NDArray[Any]
    ) -> None:
        """Some cubes: inputs, labels and predictions ``(N, R, R, R)``, groups ``(N,)``."""
        opaque = opacity_from_signed(signed) > DEFAULT_OPACITY_THRESHOLD
        surface, valid, kept = labels == SURFACE_LABEL, labels != IGNORE_LABEL, x0_pred > DECISION
        ghost, true, hole = opaque & (labels == FREE_LABEL), opaque & surface, ~opaque & surface
        self.ious += masked_iou(kept, surface, valid).tolist()
        self.ious_before += masked_iou(opaque, surface, valid).tolist()
        pairs = ((ghost, ~kept), (true, kept), (hole, kept))
        self.counts += np.array([n for where, done in pairs for n in (where.sum(), (where & done).sum())])
        for value in np.unique(group):
            mine = group == value
            self.curves.setdefault(int(value), KeepCurve()).add(x0_pred[mine], true[mine], ghost[mine])

    def _pooled(self) -> KeepCurve:
        pooled = KeepCurve()
        for curve in self.curves.values():
            pooled.true += curve.true
            pooled.ghost += curve.ghost
        return pooled

    def row(self) -> dict[str, Any]:
        """JSON-able; None for what is undefined."""
        ghosts, removed, true, kept, holes, filled = (int(count) for count in self.counts)
        scores: dict[str, Any] = {
            "cubes": len(self.ious),
            "iou_before": float(np.mean(self.ious_before)),
            "iou": float(np.mean(self.ious)),
            "iou_p5": float(np.quantile(self.ious, 0.05)),
            "floater_recall": _share(removed, ghosts),
            "surface_kept": _share(kept, true),
            "holes_filled": _share(filled, holes),
        }
        pooled = self._pooled()
        whole = [curve for curve in self.curves.values() if curve.true.any() and curve.ghost.any()]
        for share in KEPT:
            key = f"ghosts_removed_{round(share * 100)}"
            defined = bool(pooled.true.any() and pooled.ghost.any())
            scores[key] = pooled.removed(pooled.threshold(share)) if defined else None
            each = [curve.removed(curve.threshold(share)) for curve in whole]
            scores[f"{key}_per_group"] = float(np.mean(each)) if each else None
        return scores | {"groups": len(self.curves), "true_voxels": true, "ghost_voxels": ghosts}


def _share(part: int, whole: int) -> float | None:
    return part / whole if whole else None


def score(
    predict: Predict,
    signed: NDArray[np.float32],
    labels: NDArray[np.uint8],
    group: NDArray[np.int32],
    *,
    batch: int = 64,
) -> dict[str, Any]:
    """Denoise a set and count.

    Args:
        predict: rows of the set to ``x0_pred (n, R, R, R)``.
        signed: ``(N, R, R, R)`` in [-1, 1], what was seen.
        labels: ``(N, R, R, R)``: 0 free, 1 surface, 2 ignore.
        group: ``(N,)``, scene or mesh.
        batch: cubes at a time.

    Returns:
        ``iou_before iou iou_p5 floater_recall surface_kept holes_filled`` at the decision 0, and for .98, .95, .90 of
        the true voxels kept ``ghosts_removed_98`` (one threshold for the whole set) and
        ``ghosts_removed_98_per_group`` (a threshold for each scene, mean over the scenes).
    """
    tally = Tally()
    for start in range(0, len(signed), batch):
        rows = np.arange(start, min(start + batch, len(signed)))
        tally.add(signed[rows], labels[rows], group[rows], predict(rows))
    return tally.row()
