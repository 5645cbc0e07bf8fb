"""Estimate the side of a density field's cells from its densities alone. numpy only.

Within a cell of a grid, a density is smooth; across a border of cells it has a kink (trilinear interpolation under any
smooth activation, every level of a hash grid) or a jump (nearest neighbour). Along one axis, the kinks of all lines lie
at multiples of the cell's side. So second differences along short lines, stacked by their coordinate, are a comb.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.aabb import as_aabb, scene_extent
from ..core.occupancy import opacity_from_density

FloatArray = NDArray[np.floating[Any]]
Mask = NDArray[np.bool_]
Query = Callable[[FloatArray], NDArray[Any]]
Source = Literal["cells", "smoothness", "extent"]

FALLBACK_CELLS = 128  # along the longest side, where nothing is found
MOST_QUERIES = 200_000

CANDIDATES = 4096  # lines an axis of which both ends and the middle are queried
LINES = 420  # an axis, drawn from those by the square of their contrast
FEWEST_LINES = 8  # an axis, with which a lattice is looked for
SAMPLES = 96  # a line
LEAST_CONTRAST = 1e-5  # (highest - lowest) / (highest + lowest): below it is rounding
STEPS = 8192  # samples along the longest side, if a line were that long
ROUNDING_STEPS = 8  # a step is at least so many of float32's at the box's farthest corner

LAGS = (1, 2, 4, 8, 16, 32)  # steps between the samples of a second difference: long ones are above noise
FINEST = 4.0  # steps a cell
COARSEST = 12  # cells along the box, of lattices found by their spectrum
COARSE_CELLS = (8.0, 48.0)  # of lattices tried one by one
COARSE_LAG = 4
SHARPNESS = 8  # power of the ranks of second differences
PADDING = 16  # of the spectrum
HARMONICS = 8  # of a lattice's frequency that are added up
SIGNIFICANCE = 12.0  # standard deviations of their sum; random kinks reach 10
MOST_PEAKS = 200
FOLDED = 7.0  # standard score of a lattice's kinks at its best phase
FOLDED_ALONE = 8.5  # the same without a peak of the spectrum; random kinks reach 6
WEAKEST = 0.35  # of the best score, that a finer lattice must have
DIVISORS = (2, 3, 4, 5, 6, 7, 8, 9, 11, 13, 17, 19, 23, 29, 31, 37, 41, 43)
HARMONIC = 1.15  # a lattice must score so many times what each of its divisors scores, which else explains it

PLACES = 2600  # at which the smoothness is measured
SMOOTH_LAGS = 2.0 ** -np.arange(4, 11)  # of the longest side, long to short
CURVED = 0.1  # squared second over squared first difference at which the wavelength is read
COARSEST_SMOOTH = 32  # cells along the longest side


@dataclass(frozen=True)
class PitchEstimate:
    """What :func:`estimate_pitch` found.

    Attributes:
        pitch: side of a cell, scene units, > 0.
        source: ``"cells"``: kinks of the density lie on a lattice with that spacing. ``"smoothness"``: there is no
            lattice, and it is half a wavelength of the field. ``"extent"``: 1/128 of the longest side.
        reason: where ``pitch`` comes from, one clause.
        varies: False for an empty or constant field, about which nothing can be found yet.
        queries: positions that were queried.

    Example:
        >>> PitchEstimate(0.1, "cells", "the kinks of the density are 0.1 apart", True, 200).source
        'cells'
    """

    pitch: float
    source: Source
    reason: str
    varies: bool
    queries: int


def fallback_pitch(aabb: ArrayLike) -> float:
    """Pitch of a field about which nothing is known: 1/128 of the longest side of ``aabb (2, 3)``, scene units.

    Example:
        >>> fallback_pitch([[0, 0, 0], [64, 1, 1]])
        0.5
    """
    return scene_extent(aabb) / FALLBACK_CELLS


def estimate_pitch(query: Query, aabb: ArrayLike, *, rng: np.random.Generator) -> PitchEstimate:
    """Estimate the side of a field's cells from at most 200,000 densities.

    Three steps. First, the lattice of a dense, nearest-neighbour or hash grid (its finest level) along each axis,
    between 8 and 2,048 cells a side of the box; of axes that differ, the median. A contracted field is judged by its
    part that is not contracted. Second, for a field without cells (an MLP), half its typical wavelength along a line,
    ``pi * sqrt(mean(g'^2) / mean(g''^2))`` (for a Gaussian random field the mean distance of its extrema: Rice 1944)
    of ``g``, the opacity over 1/128 of the longest side; derivatives are finite differences as long as keep their
    ratio at .1. It is at most 1/32 of the longest side. Third, for a field with sharp edges and no cells, and for one
    that is empty or constant, 1/128 of the longest side.

    Args:
        query: positions ``(M, 3)`` float64 to densities ``(M,)``, >= 0 per scene unit. Lines and places with an
            invalid density (NaN, infinite, negative) are left out.
        aabb: ``(2, 3)`` scene units; positions are in it.
        rng: generator.

    Returns:
        The estimate.

    Raises:
        ValueError: an impossible box.

    Example:
        >>> def density(positions):  # cells of .05, nearest neighbour
        ...     index = np.floor(positions / 0.05).astype(int)
        ...     return np.sin(index @ np.array([12.9898, 78.233, 37.719])) + 1.0
        >>> found = estimate_pitch(density, [[-1, -1, -1], [1, 1, 1]], rng=np.random.default_rng(0))
        >>> found.source, round(found.pitch, 3)
        ('cells', 0.05)
    """
    box = as_aabb(aabb, caller="estimate_pitch")
    ask = _Counter(query)
    smallest = ROUNDING_STEPS * float(np.spacing(np.float32(np.abs(box).max())))
    step = max(scene_extent(box) / STEPS, smallest)
    found, varies = [], False
    for axis in range(3):
        starts = _contrasting_lines(ask, box, axis, step, rng)
        varies = varies or len(starts) > 0
        pitch = _lattice_pitch(ask, box, axis, step, starts)
        found += [] if pitch is None else [pitch]
    if found:
        pitch = float(np.median(found))
        return PitchEstimate(pitch, "cells", f"the kinks of the density are {pitch:.4g} apart", True, ask.count)
    if not varies:
        return PitchEstimate(fallback_pitch(box), "extent", "the field is empty or constant", False, ask.count)
    half = _half_wavelength(ask, box, rng)
    if half is not None:
        return PitchEstimate(half, "smoothness", "the field has no cells, and varies smoothly", True, ask.count)
    return PitchEstimate(fallback_pitch(box), "extent", "the field has no cells, and sharp edges", True, ask.count)


class _Counter:
    """A query for positions ``(..., 3)`` that counts them and returns NaN for what is invalid."""

    def __init__(self, query: Query) -> None:
        self.query, self.count = query, 0

    def __call__(self, positions: FloatArray) -> FloatArray:
        values = np.asarray(self.query(positions.reshape(-1, 3)), dtype=np.float64).reshape(positions.shape[:-1])
        self.count += values.size
        return np.where(np.isfinite(values) & (values >= 0), values, np.nan)


def _contrasting_lines(ask: _Counter, box: FloatArray, axis: int, step: float, rng: np.random.Generator) -> FloatArray:
    """Starts ``(n, 3)`` of lines along an axis on which the density varies."""
    length, room = (SAMPLES - 1) * step, box[1] - box[0]
    room[axis] -= length
    if room[axis] <= 0:
        return np.zeros((0, 3))
    starts: FloatArray = box[0] + rng.random((CANDIDATES, 3)) * room
    density = ask(starts[:, None] + _along(axis, np.array([0.0, 0.5, 1.0]) * length))
    high, low = density.max(axis=1), density.min(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        contrast = (high / 2 - low / 2) / (high / 2 + low / 2)  # no overflow
    keen = np.flatnonzero(contrast > LEAST_CONTRAST)  # not NaN
    keys = np.log(rng.random(len(keen))) / contrast[keen] ** 2  # a weighted draw without replacement
    chosen: FloatArray = starts[keen[np.argsort(-keys)[:LINES]]]
    return chosen


def _along(axis: int, distances: FloatArray) -> FloatArray:
    """``distances (n,)`` as offsets ``(n, 3)`` along an axis."""
    offsets = np.zeros((len(distances), 3))
    offsets[:, axis] = distances
    return offsets


def _lattice_pitch(ask: _Counter, box: FloatArray, axis: int, step: float, starts: FloatArray) -> float | None:
    """Spacing of the lattice along one axis, scene units, or None."""
    if len(starts) < FEWEST_LINES:
        return None
    density = ask(starts[:, None] + _along(axis, np.arange(SAMPLES) * step))
    valid = np.isfinite(density).all(axis=1) & (density.max(axis=1) > 0)
    shape = density[valid] / density[valid].max(axis=1, keepdims=True)
    shape = np.log1p(shape / shape.mean(axis=1, keepdims=True))  # between a linear and a logarithmic view of it
    count = max(1, math.ceil((box[1, axis] - box[0, axis]) / step))
    first = (starts[valid, axis] - box[0, axis]) / step
    for lag in LAGS:
        stacked = _stacked_kinks(shape, first, lag, count)
        cells = None if stacked is None else _finest_lattice(*stacked, lag)
        if cells is not None:
            return count * step / cells
    return None


def _stacked_kinks(shape: FloatArray, first: FloatArray, lag: int, count: int) -> tuple[FloatArray, Mask] | None:
    """Second differences by coordinate: their ranks raised to a power, mean about 0, and which steps were sampled.

    Args:
        shape: ``(n, samples)``.
        first: ``(n,)`` coordinates of the first samples, in steps.
        lag: in steps.
        count: steps along the box.

    Returns:
        ``(count,)`` each, or None for too few lines.
    """
    bend = np.abs(shape[:, 2 * lag :] - 2 * shape[:, lag:-lag] + shape[:, : -2 * lag])
    most = bend.max(axis=1)
    used = most > LEAST_CONTRAST / 10
    if used.sum() < FEWEST_LINES:
        return None
    bend = bend[used] / most[used, None]
    places = first[used, None] + lag + np.arange(bend.shape[1])
    index = np.minimum(places.astype(np.int64), count - 1).ravel()
    seen = np.bincount(index, minlength=count)
    mean = np.bincount(index, weights=bend.ravel(), minlength=count) / np.maximum(seen, 1)
    sampled = seen > 0
    window = np.ones(max(1, count // COARSEST))
    level = np.convolve(mean, window, "same") / np.maximum(np.convolve(sampled, window, "same"), 1)
    inside = np.flatnonzero(sampled)
    ranks = np.argsort(np.argsort(mean[inside] / np.maximum(level[inside], 1e-300)))
    kinks = np.zeros(count)
    kinks[inside] = ((ranks + 0.5) / len(inside)) ** SHARPNESS - 1 / (SHARPNESS + 1)
    return kinks, sampled


def _finest_lattice(kinks: FloatArray, sampled: Mask, lag: int) -> float | None:
    """Cells along the box of the finest lattice on which kinks lie, or None."""
    fold = _Fold(kinks, sampled, lag)
    cells = _spectral_peaks(kinks, len(kinks) / (FINEST * max(1.0, 0.5 * lag)))
    scores = np.array([fold(each) for each in cells])
    for each, score in zip(cells, scores):
        if score < max(FOLDED, WEAKEST * scores.max()):
            continue
        if all(score >= HARMONIC * fold(each / k) for k in DIVISORS if each / k >= COARSEST - 1):
            return float(each)
    if lag == COARSE_LAG:  # few kinks a line leave no peak
        coarse = np.arange(*COARSE_CELLS, 1 / PADDING)
        scores = np.array([fold(each) for each in coarse])
        if scores.max() >= FOLDED_ALONE:
            return float(coarse[scores.argmax()])
    return None


def _spectral_peaks(kinks: FloatArray, finest: float) -> FloatArray:
    """Frequencies, in cells along the box and from fine to coarse, whose harmonics stand out of the spectrum."""
    padded = PADDING << math.ceil(math.log2(len(kinks)))
    power = np.abs(np.fft.rfft(kinks, padded)) ** 2
    cells = np.arange(len(power)) * (len(kinks) / padded)
    first, last, highest = np.searchsorted(cells, [COARSEST, finest, 2 * finest])
    if last <= first:
        return np.zeros(0)
    power = power / _noise_power(power, cells)
    summed, terms = np.zeros(last), np.zeros(last)
    for harmonic in range(1, HARMONICS + 1):
        index = np.arange(first, min(last, math.ceil(min(highest, len(power)) / harmonic)))
        summed[index] += power[index * harmonic]
        terms[index] += 1
    summed = (summed - terms) / np.sqrt(np.maximum(terms, 1))
    near = max(1, int(np.searchsorted(cells, 0.7)))
    peaks = np.flatnonzero((summed >= SIGNIFICANCE) & (summed == _highest(summed, near)))
    return cells[np.sort(peaks[np.argsort(-summed[peaks])[:MOST_PEAKS]])[::-1]]


def _noise_power(power: FloatArray, cells: FloatArray) -> FloatArray:
    """Mean power of noise about each frequency, from the medians of blocks (noise is exponentially distributed)."""
    block = max(8, int(np.searchsorted(cells, 24.0)))
    blocks = np.array_split(np.arange(len(power)), max(1, round(len(power) / block)))
    medians = [max(float(np.median(power[part])) / math.log(2), 1e-300) for part in blocks]
    return np.exp(np.interp(cells, [cells[part].mean() for part in blocks], np.log(medians)))


class _Fold:
    """Standard score of the kinks on a lattice of given spacing, at its best phase."""

    def __init__(self, kinks: FloatArray, sampled: Mask, lag: int) -> None:
        values = _highest(np.where(sampled, kinks, -1.0), max(1, lag // 2))[sampled]
        self.values = (values - values.mean()) / max(float(values.std()), 1e-12)
        self.places, self.count = np.flatnonzero(sampled), len(kinks)

    def __call__(self, cells: float) -> float:
        spacing = self.count / cells
        phases = max(3, round(spacing))
        index = ((self.places % spacing) * (phases / spacing)).astype(np.int64) % phases
        total = np.bincount(index, weights=self.values, minlength=phases)
        number = np.bincount(index, minlength=phases)
        return float((total / np.sqrt(np.maximum(number, 1))).max())


def _highest(values: FloatArray, reach: int) -> FloatArray:
    """Largest of the ``2 reach + 1`` values about each."""
    out, width, full = np.pad(values, reach, constant_values=-np.inf), 1, 2 * reach + 1
    while width < full:
        shift = min(width, full - width)
        out = np.maximum(out[: len(out) - shift], out[shift:])
        width += shift
    return out


def _half_wavelength(ask: _Counter, box: FloatArray, rng: np.random.Generator) -> float | None:
    """Half the field's typical wavelength along a line, scene units; None for a field with sharp edges."""
    extent, sides = scene_extent(box), box[1] - box[0]
    axis = rng.integers(0, 3, PLACES)
    lags = SMOOTH_LAGS * extent
    lags = lags[lags <= sides.min() / 4]
    if len(lags) < 2:
        return None
    direction = np.eye(3)[axis]
    margin = direction * lags[0]
    middle = box[0] + margin + rng.random((PLACES, 3)) * (sides - 2 * margin)
    distances = np.concatenate([[0.0], lags, -lags])
    density = ask(middle[:, None] + distances[:, None] * direction[:, None])
    opacity = opacity_from_density(density[np.isfinite(density).all(axis=1)], fallback_pitch(box))
    here, after, before = opacity[:, :1], opacity[:, 1 : len(lags) + 1], opacity[:, len(lags) + 1 :]
    second, first = ((after - 2 * here + before) ** 2).sum(axis=0), ((after - before) ** 2).sum(axis=0)
    if not (first > 0).all():
        return None
    ratio = np.maximum(second / first, 1e-12)
    curved = np.flatnonzero(ratio > CURVED)
    if not len(curved):
        return extent / COARSEST_SMOOTH
    pair = curved[-1] + np.array([1, 0])  # the longest lag below which all ratios are small, and the next
    if pair[0] == len(lags):
        return None
    lag = math.exp(float(np.interp(math.log(CURVED), np.log(ratio[pair]), np.log(lags[pair]))))
    # of a sine, second / first is tan(pi * lag / wavelength)^2
    return min(math.pi * lag / (2 * math.atan(math.sqrt(CURVED))), extent / COARSEST_SMOOTH)
