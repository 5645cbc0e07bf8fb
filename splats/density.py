r"""3D Gaussian splats as a density field. numpy only.

A splat of opacity ``o`` is a cloud whose centre, crossed along the splat's thinnest axis, absorbs ``o``:

    density(p) = sum_i  k_i exp(-|p - mean_i|^2_{S_i} / 2),     k_i = -ln(1 - o_i) / (sqrt(2 pi) s_i)

``s_i`` being the smallest standard deviation of the covariance ``S_i``. Splats are often far thinner than what asks;
each covariance is therefore widened by ``(pitch / 2)^2`` along all axes (the 3D filter of Mip-Splatting, Yu et al.
2024, section 4.1), ``k_i`` for the widened one, so that no splat falls between two samples a pitch apart and its
opacity, seen face-on, stays what it was. ``-ln(1 - o)`` is the softplus of the logit: exact where o rounds to 1. A
logit beyond ``MOST_LOGIT`` counts as that: ``o`` is then 1 in float32, for which converters write infinity.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.errors import InvalidArgument
from .ply import Gaussians

MOST_LOGIT = 24.0 * math.log(2.0)  # of 1 - 2^-24, the largest opacity that float32 rounds to less than 1
CUT = 3.0  # standard deviations; beyond, a splat counts as nothing
PAIRS = 1 << 19  # of a position and a splat that are looked at together: about 100 MB
_WRAP = 1 << 20  # cells are numbered modulo this along each axis


@dataclass(frozen=True)
class _Level:
    """Splats of about one extent, listed by the cells that they touch."""

    side: float
    keys: NDArray[np.int64]  # sorted, of the cells that hold any
    starts: NDArray[np.int64]  # (cells + 1,)
    members: NDArray[np.int32]


class SplatField:
    """The density of many splats, exact at any position up to the cut at three standard deviations.

    A position is compared only with the splats listed for its cell, one list a power of two of their extents: at most
    27 entries a splat, some 350 bytes. A call looks at no more than half a million pairs at once, whatever it is asked.

    Attributes:
        pitch: the distance of neighbouring samples that it is made for: ``clean``'s ``field_pitch``.

    Example:
        >>> one = Gaussians.create([[0, 0, 0]], [[0.1, 0.1, 0.1]], [[1, 0, 0, 0]], [0.0])
        >>> field = SplatField(one, pitch=0.05)
        >>> bool(field.density_fn([[0, 0, 0]])[0, 0] > field.density_fn([[0.1, 0, 0]])[0, 0] > 0)
        True
    """

    def __init__(self, gaussians: Gaussians, *, pitch: float) -> None:
        """List the splats by cell; those that are not valid are left out.

        Raises:
            ValueError: ``pitch`` is not finite and > 0.
        """
        if not 0.0 < pitch < np.inf:
            raise InvalidArgument(f"SplatField: pitch must be finite and > 0, got {pitch}")
        self.pitch = float(pitch)
        gaussians = gaussians.only(gaussians.valid)
        spread = np.sqrt(gaussians.extents**2 + (pitch / 2) ** 2)
        self._means = gaussians.means
        self._whiten = (gaussians.rotations / spread[:, None, :]).transpose(0, 2, 1).astype(np.float32)
        depth = np.logaddexp(0.0, np.minimum(gaussians.logits, MOST_LOGIT))
        self._peaks = depth / (np.sqrt(2.0 * np.pi) * spread.min(axis=1))
        self._reach_squared = (CUT * spread.max(axis=1)) ** 2
        reach = CUT * np.sqrt(np.einsum("nij,nj->ni", gaussians.rotations**2, spread**2))
        self._levels = list(_levels(gaussians.means, reach))

    def density_fn(self, positions: ArrayLike) -> NDArray[np.float32]:
        """Density ``(..., 1)`` per scene unit at ``positions (..., 3)``, scene units; NaN where one is not finite."""
        points = np.asarray(positions, dtype=np.float64)
        if points.shape[-1:] != (3,):
            raise InvalidArgument(f"SplatField.density_fn: positions must have shape (..., 3), got {points.shape}")
        flat = points.reshape(-1, 3)
        total = np.zeros(len(flat))
        finite = np.asarray(np.isfinite(flat).all(axis=1))
        for level in self._levels:
            for rows, members in _pairs(level, np.where(finite[:, None], flat, 0.0)):
                apart = flat[rows] - self._means[members]
                close = np.flatnonzero(np.einsum("ni,ni->n", apart, apart) < self._reach_squared[members])
                rows, members = rows[close], members[close]
                whitened = np.matmul(self._whiten[members], apart[close].astype(np.float32)[:, :, None])[:, :, 0]
                square = np.einsum("ni,ni->n", whitened, whitened)
                near = np.flatnonzero(square < CUT**2)
                value = self._peaks[members[near]] * np.exp(-0.5 * square[near])
                total += np.bincount(rows[near], value, len(flat))
        total[~finite] = np.nan
        return total.astype(np.float32).reshape(*points.shape[:-1], 1)


def _keys(cells: NDArray[np.float64]) -> NDArray[np.int64]:
    """One number for each cell ``(..., 3)``. Far cells may share one: that costs time, never a wrong value."""
    x, y, z = np.moveaxis(np.mod(cells, _WRAP).astype(np.int64), -1, 0)
    keys: NDArray[np.int64] = (x * _WRAP + y) * _WRAP + z
    return keys


def _levels(means: NDArray[np.float64], reach: NDArray[np.float64]) -> Iterator[_Level]:
    """``reach (N, 3)``: half the sides of the box around each splat."""
    longest = reach.max(axis=1)
    powers = np.ceil(np.log2(longest)).astype(int)
    for power in np.unique(powers):
        side = float(2.0**power)  # reach <= side < 2 * reach: a splat touches 1 to 3 cells along each axis
        chosen = np.flatnonzero(powers == power).astype(np.int32)
        low = np.floor((means[chosen] - reach[chosen]) / side)
        high = np.floor((means[chosen] + reach[chosen]) / side)
        found: list[tuple[NDArray[np.int64], NDArray[np.int32]]] = []
        for step in np.ndindex(3, 3, 3):
            moved = low + step  # beyond 2^53 cells a step is lost: then it must not be listed twice
            touched = ((moved <= high) & (moved - low == step)).all(axis=1)
            found.append((_keys(moved[touched]), chosen[touched]))
        keys = np.concatenate([key for key, _ in found])
        members = np.concatenate([member for _, member in found])
        order = np.argsort(keys, kind="stable")
        cells, starts = np.unique(keys[order], return_index=True)
        yield _Level(side, cells, np.append(starts, len(keys)), members[order])


def _pairs(level: _Level, points: NDArray[np.float64]) -> Iterator[tuple[NDArray[np.int64], NDArray[Any]]]:
    """Rows of ``points (M, 3)`` and the splats listed for their cells, a bounded number at once."""
    keys = _keys(np.floor(points / level.side))
    place = np.minimum(np.searchsorted(level.keys, keys), len(level.keys) - 1)
    rows = np.flatnonzero(level.keys[place] == keys)
    first, count = level.starts[place[rows]], np.diff(level.starts)[place[rows]]
    ends = np.cumsum(count)
    done, total = 0, int(ends[-1]) if len(ends) else 0
    while done < total:  # pair number n belongs to the row whose end is the first beyond n
        number = np.arange(done, min(done + PAIRS, total))
        at = np.searchsorted(ends, number, side="right")
        yield rows[at], level.members[first[at] + number - (ends[at] - count[at])]
        done += PAIRS
