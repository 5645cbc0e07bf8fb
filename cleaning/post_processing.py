"""From scores to what goes: votes first, connected pieces last. numpy only."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .components import dilate, label_components

Mask = NDArray[np.bool_]

MAJORITY = 0.5  # a piece with a larger share of cells voted empty goes whole ...
LARGEST_WHOLE = 0.25  # ... unless it holds more than this share of all that is occupied
MOST_DEPTH = -float(np.log(0.01))  # of a cell: 99 % of the light
MOST_REGIONS = 100  # listed in a summary


def decide(
    occupied: Mask,
    judged: Mask,
    score: NDArray[np.float32],
    *,
    threshold: float,
    smallest: int,
    speck: int,
    fringe: int = 0,
) -> tuple[Mask, Mask]:
    """Which cells to remove.

    1. An occupied cell is voted empty if its score lies below ``threshold``.
    2. A piece (26-connected occupied cells) of which most is voted empty goes whole, unless it is a large part of
       the scene: then cells are judged one by one.
    3. Fewer than ``speck`` connected cells voted empty, on something that stays, are pores of a solid: they stay.
    4. What is left over in pieces of fewer than ``smallest`` cells goes.
    5. Cells voted empty within ``fringe`` cells of one that stays are the soft skirt of a surface (in a trained field
       half of a surface's occupied cells hold little): they stay.
    6. A faint cell (judged, not occupied) goes if voted empty and not next to an occupied cell that stays.

    Args:
        occupied: ``(X, Y, Z)`` bool.
        judged: ``(X, Y, Z)`` bool, holds ``occupied``.
        score: ``(X, Y, Z)`` in [-1, 1].
        threshold: see 1.
        smallest: see 4, cells.
        speck: see 3, cells.
        fringe: see 5, cells.

    Returns:
        removed occupied cells, removed faint cells, both ``(X, Y, Z)`` bool.

    Example:
        >>> occupied, score = np.zeros((8, 8, 8), dtype=bool), np.ones((8, 8, 8), np.float32)
        >>> occupied[:, :, 0] = occupied[5:7, 5:7, 5:7] = True  # a floor and a floater
        >>> score[5:7, 5:7, 5:7] = -1.0
        >>> removed, faint = decide(occupied, occupied, score, threshold=0.0, smallest=8, speck=4)
        >>> int(removed.sum()), int(faint.sum())
        (8, 0)
    """
    voted = occupied & (score < threshold)
    labels, count = label_components(occupied)
    cells = np.bincount(labels.ravel(), minlength=count + 1)
    votes = np.bincount(labels.ravel(), weights=voted.ravel(), minlength=count + 1)
    whole = (votes > MAJORITY * cells) & (cells <= LARGEST_WHOLE * occupied.sum())
    whole[0] = False
    removed = voted | whole[labels]
    removed &= ~_small_pieces(removed & ~whole[labels], speck)
    removed |= _small_pieces(occupied & ~removed, smallest)
    for _ in range(fringe):
        removed &= ~dilate(occupied & ~removed)
    stays = dilate(occupied & ~removed)
    return removed, judged & ~occupied & (score < threshold) & ~stays


def optical_depth(signed: NDArray[np.float32]) -> NDArray[np.float64]:
    """Optical depth of cells by their signed opacity, at most ``MOST_DEPTH``: what is deeper looks no different.

    Example:
        >>> optical_depth(np.array([-1.0, 0.0, 1.0], np.float32)).round(3).tolist()  # nothing, half, all of the light
        [0.0, 0.693, 4.605]
    """
    through = np.maximum((1.0 - signed.astype(np.float64)) / 2.0, np.exp(-MOST_DEPTH))
    depth: NDArray[np.float64] = np.log(1.0 / through)
    return depth


def limit_removal(removed: Mask, score: NDArray[np.float32], depth: NDArray[np.float64], *, most: float) -> Mask:
    """Keep a removal within a budget of optical depth: cells of the lowest score first.

    Args:
        removed: ``(X, Y, Z)`` bool.
        score: ``(X, Y, Z)`` in [-1, 1].
        depth: ``(X, Y, Z)`` optical depth of each cell.
        most: sum of the depth that may go.

    Returns:
        The cells that still go, ``(X, Y, Z)`` bool.

    Example:
        >>> removed, score = np.ones((1, 1, 3), bool), np.array([[[-0.2, -0.9, -0.5]]], np.float32)
        >>> limit_removal(removed, score, np.ones((1, 1, 3)), most=2.0).tolist()
        [[[False, True, True]]]
    """
    cells = np.flatnonzero(removed)
    order = cells[np.argsort(score.ravel()[cells], kind="stable")]
    within = np.cumsum(depth.ravel()[order]) <= most * (1 + 1e-12)
    limited = np.zeros(removed.size, dtype=bool)
    limited[order[within]] = True
    return limited.reshape(removed.shape)


def _small_pieces(mask: Mask, fewest: int) -> Mask:
    """Cells of connected pieces with fewer than ``fewest`` cells."""
    labels, count = label_components(mask)
    small = np.bincount(labels.ravel(), minlength=count + 1) < fewest
    small[0] = False
    return small[labels]


def removed_regions(
    removed: Mask, score: NDArray[np.float32], origin: NDArray[np.float64], pitch: float
) -> tuple[list[dict[str, Any]], int]:
    """Connected removed regions, largest first (at most 100), and how many there are.

    Each has ``voxels``; ``volume`` and ``box`` ``[[x, y, z], [x, y, z]]`` in scene units; and ``confidence`` in
    [0, 1]: 1 if every window said "empty" everywhere, 0.5 at a tie.
    """
    labels, count = label_components(removed)
    cells = np.argwhere(removed)
    if count == 0:
        return [], 0
    number = labels[removed] - 1
    voxels = np.bincount(number, minlength=count)
    mean_score = np.bincount(number, weights=score[removed], minlength=count) / voxels
    low, high = np.full((count, 3), np.iinfo(np.int64).max), np.full((count, 3), -1)
    np.minimum.at(low, number, cells)
    np.maximum.at(high, number, cells)
    order = np.argsort(-voxels, kind="stable")[:MOST_REGIONS]
    regions = [
        {
            "voxels": int(voxels[i]),
            "volume": float(voxels[i] * pitch**3),
            "box": [(origin + low[i] * pitch).tolist(), (origin + (high[i] + 1) * pitch).tolist()],
            "confidence": float(np.clip((1.0 - mean_score[i]) / 2.0, 0.0, 1.0)),
        }
        for i in order
    ]
    return regions, count
