r"""Statistics of cubes, and the distance between two sets of them.

What a prior learns from must look like what it will meet. So the cubes of a shard are measured by what their
*input* shows (a real capture has no truth), each feature one number a cube:

    occupied_share  voxels of opacity > 0.1 over all voxels
    faint_share     voxels of opacity in (0.02, 0.1] over all voxels: haze that no threshold sees
    thickness       mean of :func:`local_thickness` over the occupied voxels, in voxels; 0 if there are none
    components      pieces of occupied voxels (26 neighbours)
    largest_share   occupied voxels in the largest piece, over all occupied ones
    contrast        mean opacity step between face neighbours of which one at least is occupied: about 0.5 for a
                    sheet of one voxel, 0.3 for one of two, below 0.1 for fog
    opacity         of the occupied voxels of all cubes, as one distribution

and, where labels are known, over the voxels that count (not labelled "ignore"):

    iou             of the occupied input and the surface labels; 1 if both are empty
    ghost_share     occupied voxels that are labelled free, over the occupied; 0 if there are none
    missing_share   surface voxels that are not occupied, over the surface; 0 if there is none
    surface_share   voxels labelled surface over all voxels
    ignored_share   voxels labelled "ignore" over all voxels

**The distance** between two sets A and B. Each feature f is mapped to [0, 1] by a fixed increasing g_f (below:
``FEATURES``), and

    d_f(A, B) = W1(g_f(A), g_f(B)) = \int_0^1 |F_A(u) - F_B(u)| du,      d(A, B) = mean over f of d_f(A, B)

with F the empirical distribution functions over cubes (for ``opacity``: over occupied voxels). So d is a metric
on the seven distributions: in [0, 1], symmetric, 0 when all seven agree, with the triangle inequality. Two samples
of one set of cubes are not at 0: :func:`sampling_floor` says how much of a distance may be chance.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core.errors import InvalidArgument, needs_extra
from ...core.frames import RESOLUTION
from ...core.occupancy import DEFAULT_OPACITY_THRESHOLD, FREE_LABEL, IGNORE_LABEL, SURFACE_LABEL, opacity_from_signed
from ...core.shards.packing import dequantize_signed, quantize_signed, unpack_labels
from ...core.shards.storage import Shard, read_shard
from .thickness import local_thickness

Values = NDArray[np.float64]
Occupancy = NDArray[np.bool_]
FAINT_OPACITY = 0.02
LEVELS = 256  # of a stored opacity


def _logarithmic(most: int) -> Callable[[Values], Values]:
    """``log2(1 + value) / log2(1 + most)``, at most 1."""
    return lambda values: np.minimum(np.log2(1.0 + values) / np.log2(1.0 + most), 1.0)


FEATURES: dict[str, Callable[[Values], Values]] = {
    "occupied_share": np.sqrt,
    "faint_share": np.sqrt,
    "thickness": _logarithmic(RESOLUTION),
    "components": _logarithmic((RESOLUTION // 2) ** 3),  # the most that 32^3 voxels can hold
    "largest_share": np.array,
    "contrast": np.array,
}
"""What the distance compares, with each feature's map to [0, 1]; ``opacity`` joins them, unmapped."""

AGREEMENT = ("iou", "ghost_share", "missing_share", "surface_share", "ignored_share")


@dataclass(frozen=True)
class CubeStatistics:
    """Features of ``N`` cubes.

    Attributes:
        features: name to ``(N,)`` float64: those of ``FEATURES``, and of ``AGREEMENT`` if labels were known.
        levels: ``(N, 256)`` int32, how many voxels of each cube have each stored opacity (level / 255).
    """

    features: Mapping[str, Values]
    levels: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.levels)

    @property
    def empty_share(self) -> float:
        """Cubes without one occupied voxel, over all cubes."""
        return float((self.features["occupied_share"] == 0).mean()) if len(self) else 0.0

    def select(self, index: ArrayLike) -> CubeStatistics:
        """Some of the cubes."""
        chosen = np.asarray(index)
        return CubeStatistics({name: values[chosen] for name, values in self.features.items()}, self.levels[chosen])

    def summary(self) -> dict[str, Any]:
        """JSON-able: ``cubes``, ``empty_share``, and per feature ``mean``, ``median``, ``p10``, ``p90``.

        ``opacity_histogram`` holds the share of all voxels in ten equal bins of opacity, the first from 0 to 0.1.
        """
        rows: dict[str, Any] = {"cubes": len(self), "empty_share": round(self.empty_share, 4)}
        for name, values in self.features.items():
            marks = [values.mean(), *np.quantile(values, [0.5, 0.1, 0.9])] if len(values) else [None] * 4
            rows[name] = {
                key: None if mark is None else round(float(mark), 4)
                for key, mark in zip(("mean", "median", "p10", "p90"), marks)
            }
        rows["opacity_histogram"] = [round(float(share), 5) for share in self.opacity_histogram(10)]
        return rows

    def opacity_histogram(self, bins: int) -> Values:
        """Share of all voxels in each of ``bins`` equal bins of opacity in [0, 1]; sums to 1."""
        place = np.minimum(np.arange(LEVELS) * bins // (LEVELS - 1), bins - 1)
        counts = np.bincount(place, weights=self.levels.sum(axis=0, dtype=np.float64), minlength=bins)
        shares: Values = counts / max(counts.sum(), 1.0)
        return shares


def _contrast(opacity: NDArray[np.float32], occupied: Occupancy) -> float:
    """Mean opacity step between face neighbours of which at least one is occupied."""
    steps, pairs = 0.0, 0
    for axis in range(3):
        ahead, behind = [slice(None)] * 3, [slice(None)] * 3
        ahead[axis], behind[axis] = slice(1, None), slice(None, -1)
        counted = occupied[tuple(ahead)] | occupied[tuple(behind)]
        change = np.abs(opacity[tuple(ahead)] - opacity[tuple(behind)])
        steps += float(change.sum(where=counted, dtype=np.float64))
        pairs += int(counted.sum())
    return steps / pairs if pairs else 0.0


def cube_features(signed: NDArray[np.floating], labels: NDArray[np.uint8] | None = None) -> dict[str, float]:
    """The features of one cube.

    Args:
        signed: ``(R, R, R)`` signed opacity in [-1, 1].
        labels: ``(R, R, R)`` of 0 free, 1 surface, 2 ignore; None if the truth is unknown.

    Returns:
        Those of ``FEATURES``, and with labels those of ``AGREEMENT``.
    """
    with needs_extra("recipes", caller="cube_features"):
        from scipy.ndimage import label

    opacity = opacity_from_signed(signed)
    occupied: Occupancy = opacity > DEFAULT_OPACITY_THRESHOLD
    count = int(occupied.sum())
    pieces, number = label(occupied, np.ones((3, 3, 3)))
    largest = int(np.bincount(pieces.ravel())[1:].max()) if number else 0
    features = {
        "occupied_share": count / occupied.size,
        "faint_share": float(((opacity > FAINT_OPACITY) & ~occupied).mean()),
        "thickness": float(local_thickness(occupied).mean()) if count else 0.0,
        "components": float(number),
        "largest_share": largest / count if count else 0.0,
        "contrast": _contrast(opacity, occupied),
    }
    if labels is not None:
        counts = labels != IGNORE_LABEL
        shown, surface = occupied & counts, labels == SURFACE_LABEL
        both, either = int((shown & surface).sum()), int((shown | surface).sum())
        ghosts, true = int((shown & (labels == FREE_LABEL)).sum()), int(surface.sum())
        features["iou"] = both / either if either else 1.0
        features["ghost_share"] = ghosts / int(shown.sum()) if shown.any() else 0.0
        features["missing_share"] = (true - both) / true if true else 0.0
        features["surface_share"] = true / labels.size
        features["ignored_share"] = float(1.0 - counts.mean())
    return features


def cube_statistics(inputs: NDArray[Any], labels: NDArray[np.uint8] | None = None) -> CubeStatistics:
    """Measure cubes.

    Args:
        inputs: ``(N, 32, 32, 32)``: signed opacity in [-1, 1], or uint8 as shards store it. Floats are rounded to
            the 256 levels of a shard first, so that both give the same.
        labels: ``(N, 32, 32, 32)`` uint8, or None.

    Raises:
        ValueError: another shape, or values that are not in [-1, 1].
    """
    if inputs.ndim != 4 or inputs.shape[1:] != (RESOLUTION,) * 3:
        raise InvalidArgument(f"cube_statistics: inputs must have shape (N, 32, 32, 32), got {inputs.shape}")
    if labels is not None and labels.shape != inputs.shape:
        raise InvalidArgument(
            f"cube_statistics: labels must have the shape of inputs, {inputs.shape}, got {labels.shape}"
        )
    if inputs.dtype != np.uint8:
        if inputs.size and not (np.abs(inputs) <= 1.0).all():
            raise InvalidArgument("cube_statistics: inputs must lie in [-1, 1] (signed opacity), others were found")
        inputs = quantize_signed(inputs)
    names = [*FEATURES, *(AGREEMENT if labels is not None else ())]
    table, levels = np.zeros((len(inputs), len(names))), np.zeros((len(inputs), LEVELS), dtype=np.int32)
    for row, stored in enumerate(inputs):
        found = cube_features(dequantize_signed(stored), None if labels is None else labels[row])
        table[row] = [found[name] for name in names]
        levels[row] = np.bincount(stored.ravel(), minlength=LEVELS)
    return CubeStatistics(dict(zip(names, table.T.copy())), levels)


def shard_statistics(shards: Sequence[Shard | str | Path], *, most: int | None = 512, seed: int = 0) -> CubeStatistics:
    """Measure the cubes of some shards as one set.

    Args:
        shards: open shards or their folders.
        most: measure at most so many cubes, drawn without replacement (about 15 ms each); None for all.
        seed: of that draw.

    Raises:
        ValueError: no shard, or ``most`` < 1.
    """
    if not shards or (most is not None and most < 1):
        raise InvalidArgument(f"shard_statistics: needs at least one shard and most >= 1, got {len(shards)} and {most}")
    opened = [shard if isinstance(shard, Shard) else read_shard(shard) for shard in shards]
    places = [(number, row) for number, shard in enumerate(opened) for row in range(len(shard))]
    if most is not None and most < len(places):
        chosen = np.random.default_rng(seed).choice(len(places), size=most, replace=False)
        places = [places[int(index)] for index in np.sort(chosen)]
    inputs = np.zeros((len(places), *(RESOLUTION,) * 3), dtype=np.uint8)
    labels = np.zeros_like(inputs)
    for row, (number, place) in enumerate(places):
        inputs[row] = opened[number].inputs[place]
        labels[row] = unpack_labels(opened[number].labels[place : place + 1])[0]
    return cube_statistics(inputs, labels)


def wasserstein(
    first: ArrayLike, second: ArrayLike, first_weights: ArrayLike | None = None, second_weights: ArrayLike | None = None
) -> float:
    """Wasserstein-1 distance of two weighted samples on a line, by scipy.

    Args:
        first, second: ``(n,)`` and ``(m,)``.
        first_weights, second_weights: of the same lengths, >= 0; equal ones if None.

    Raises:
        ValueError: a sample that is empty or has no weight.
    """
    from scipy.stats import wasserstein_distance

    for values, weights in ((first, first_weights), (second, second_weights)):
        count = np.size(values)
        if not (count if weights is None else np.sum(weights)) > 0:
            raise InvalidArgument(f"wasserstein: each sample must have some weight, got {count} values without")
    return float(wasserstein_distance(first, second, first_weights, second_weights))


def _opacity_distance(first: CubeStatistics, second: CubeStatistics) -> float:
    """W1 of the opacities of all occupied voxels; 1 if only one of the sets has any, 0 if neither."""
    opacities = np.arange(LEVELS) / (LEVELS - 1)
    occupied = opacities > DEFAULT_OPACITY_THRESHOLD
    counts = [found.levels.sum(axis=0, dtype=np.float64) * occupied for found in (first, second)]
    if not (counts[0].any() and counts[1].any()):
        return float(counts[0].any() != counts[1].any())
    return wasserstein(opacities, opacities, *counts)


def feature_distances(first: CubeStatistics, second: CubeStatistics) -> dict[str, float]:
    """``d_f`` of the module's text for every feature of ``FEATURES`` and ``opacity``, each in [0, 1].

    If only one of the sets has an occupied voxel, their distance in ``opacity`` is 1.

    Raises:
        ValueError: a set without cubes.
    """
    if not len(first) or not len(second):
        raise InvalidArgument(f"feature_distances: both sets need cubes, got {len(first)} and {len(second)}")
    found = {
        name: wasserstein(mapped(first.features[name]), mapped(second.features[name]))
        for name, mapped in FEATURES.items()
    }
    return {**found, "opacity": _opacity_distance(first, second)}


def statistics_distance(first: CubeStatistics, second: CubeStatistics) -> float:
    """How unlike the inputs of two sets of cubes are, in [0, 1]: the mean of :func:`feature_distances`."""
    return float(np.mean(list(feature_distances(first, second).values())))


def sampling_floor(found: CubeStatistics, *, rounds: int = 16, seed: int = 0) -> float:
    """What chance alone makes of the distance: the mean one between two random halves of a set.

    A distance to a set of other cubes says something where it is well above this. Cubes of one scene resemble each
    other, which random halves do not show: the floor is a lower bound.

    Raises:
        ValueError: fewer than two cubes.
    """
    if len(found) < 2:
        raise InvalidArgument(f"sampling_floor: needs at least two cubes, got {len(found)}")
    rng, half, distances = np.random.default_rng(seed), len(found) // 2, []
    for _ in range(rounds):
        order = rng.permutation(len(found))
        distances.append(statistics_distance(found.select(order[:half]), found.select(order[half:])))
    return float(np.mean(distances))
