"""Calibrate a restoration prior, so that ``(x0_pred + 1) / 2`` is the probability that an opaque voxel is surface."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from unghost.core.occupancy import DEFAULT_OPACITY_THRESHOLD, IGNORE_LABEL, SURFACE_LABEL, opacity_from_signed
from unghost.core.shards.finding import find_shards
from unghost.core.shards.packing import unpack_labels
from unghost.core.shards.storage import read_shard
from unghost.prior.networks.restoration import RestorationNet
from unghost.prior.training.batches import stored_channels

BATCH = 24
BINS = 20  # of equal width in probability, for the calibration error


def judged_voxels(
    network: RestorationNet, folders: Sequence[Path], *, timestep: int, cubes: int
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Logits and truth of the opaque voxels that count, ``(V,)`` each, of some cubes of each shard."""
    logits, surface = [], []
    for channels, edges, labels in _batches(network.config.channels, folders, cubes):
        with torch.no_grad():
            steps = torch.full((len(channels),), timestep)
            found = network.logits(torch.from_numpy(channels), steps, torch.from_numpy(edges))[:, 0].numpy()
        counts = (opacity_from_signed(channels[:, 0]) > DEFAULT_OPACITY_THRESHOLD) & (labels != IGNORE_LABEL)
        logits.append(found[counts].astype(np.float64))
        surface.append(labels[counts] == SURFACE_LABEL)
    return np.concatenate(logits), np.concatenate(surface)


def _batches(names: tuple[str, ...], folders: Sequence[Path], cubes: int) -> Iterator[tuple[Any, Any, Any]]:
    for path in (path for folder in folders for path in find_shards(folder)):
        shard = read_shard(path)
        rows = np.unique(np.linspace(0, len(shard) - 1, cubes).astype(np.int64))
        for part in np.array_split(rows, -(-len(rows) // BATCH)):
            yield stored_channels(shard, part, names), shard.edge_fraction[part], unpack_labels(shard.labels[part])


def fit_platt(logits: NDArray[np.float64], positive: NDArray[np.bool_], *, steps: int = 50) -> tuple[float, float]:
    """Scale and shift of logits by maximum likelihood (Platt 1999), with Newton's method.

    Raises:
        ValueError: all voxels are of one kind.
    """
    if positive.all() or not positive.any():
        raise ValueError("fit_platt: there must be voxels of both kinds")
    design = np.stack([logits, np.ones_like(logits)], axis=1)

    def loss(values: NDArray[np.float64]) -> float:
        margins = design @ values
        return float((np.logaddexp(0.0, margins) - positive * margins).mean())

    values, best = np.zeros(2), loss(np.zeros(2))
    for _ in range(steps):
        chance = 1.0 / (1.0 + np.exp(-np.clip(design @ values, -40, 40)))
        gradient = design.T @ (chance - positive)
        curvature = (design * (chance * (1 - chance))[:, None]).T @ design + 1e-9 * np.eye(2)
        change = np.linalg.solve(curvature, gradient)
        while np.abs(change).max() > 1e-9 and loss(values - change) > best:
            change /= 2
        if np.abs(change).max() <= 1e-9:
            break
        values, best = values - change, loss(values - change)
    return float(values[0]), float(values[1])


def calibration_error(logits: NDArray[np.float64], positive: NDArray[np.bool_]) -> float:
    """Expected calibration error: mean distance of stated from true shares, over bins of probability."""
    chance = 1.0 / (1.0 + np.exp(-np.clip(logits, -40, 40)))
    place = np.minimum((chance * BINS).astype(np.int64), BINS - 1)
    count = np.bincount(place, minlength=BINS)
    stated, true = (np.bincount(place, weights=values, minlength=BINS) for values in (chance, positive.astype(float)))
    return float(np.abs(stated - true).sum() / count.sum())


@torch.no_grad()
def bake(network: RestorationNet, scale: float, shift: float) -> None:
    """Change the last layer so that the network's logits are ``scale * logits + shift``."""
    network.head.weight.mul_(scale)
    assert network.head.bias is not None
    network.head.bias.mul_(scale).add_(shift)
    network.gain.mul_(scale)


def kept_and_removed(logits: NDArray[np.float64], surface: NDArray[np.bool_], threshold: float) -> tuple[float, float]:
    """Shares of opaque surface kept and of opaque ghosts removed at a threshold of ``x0_pred``."""
    removed = np.tanh(logits / 2) < threshold
    return float(1 - removed[surface].mean()), float(removed[~surface].mean())
