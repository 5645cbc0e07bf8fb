"""Scores at equal coverage: curves of methods with a knob, points of those without, and how they compare.

Whoever removes more is scored on easier pixels, so that a score without its coverage says little. A method with a
knob (a threshold) is a curve of score over coverage. Three rules, stated once:

* **Between two neighbouring coverages a score is interpolated linearly** (PSNR in dB). Points of one coverage count
  once, as the better of them: whoever turns the knob would take it.
* **Nothing is extrapolated.** Outside its own coverages a curve has no score: None.
* **Area** is the mean score over the range of coverages that all compared curves have: the exact integral of the
  straight lines over it, divided by its width. A point has no area.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.errors import InvalidArgument
from ...core.metrics import get_metric
from ..metrics.checks import Mask
from .conventions import one_convention

FloatArray = NDArray[np.float64]
SAME = 1e-12  # coverages closer than this are one


@dataclass(frozen=True, eq=False)
class Curve:
    """Scores of one method over its coverages; made by :meth:`create`.

    Attributes:
        method: its name.
        convention: of the scores.
        metric: which score.
        coverage: ``(k,)`` strictly rising, in [0, 1].
        score: ``(k,)``, finite.
        knob: ``(k,)`` where the knob stood; NaN for a method without one.
        higher_is_better: of the score.
        undefined: settings left out because their score or coverage was undefined.
    """

    method: str
    convention: str
    metric: str
    coverage: FloatArray
    score: FloatArray
    knob: FloatArray
    higher_is_better: bool = True
    undefined: int = 0

    @classmethod
    def create(
        cls,
        method: str,
        rows: Sequence[Mapping[str, Any]],
        *,
        metric: str = "psnr",
        knob: str | None = None,
        higher_is_better: bool | None = None,
    ) -> Curve:
        """From results rows, one a setting of the knob, in any order.

        Args:
            method: its name.
            rows: each with ``coverage``, the metric, one common ``convention``, and the knob's value.
            metric: the rows' key.
            knob: the rows' key; None for a method without one.
            higher_is_better: of the metric; None for what the registry says (:mod:`unghost.core.metrics`).

        Raises:
            ValueError: rows of two conventions (both named), coverages outside [0, 1], or no row with a finite score.

        Example:
            >>> rows = [{"coverage": 0.4, "psnr": 20.0}, {"coverage": 0.8, "psnr": 18.0}]
            >>> curve = Curve.create("ours", rows)
            >>> round(curve.at(0.6), 6), curve.at(0.9)
            (19.0, None)
            >>> round(curve.area(0.4, 0.8), 6)
            19.0
        """
        if higher_is_better is None:
            higher_is_better = get_metric(metric).better == "higher"
        convention = one_convention("Curve.create", rows)
        triples = [(row.get("coverage"), row.get(metric), np.nan if knob is None else row[knob]) for row in rows]
        known = [
            (float(c), float(s), float(k))
            for c, s, k in triples
            if c is not None and s is not None and np.isfinite(c) and np.isfinite(s)
        ]
        if not known:
            raise InvalidArgument(f"Curve.create: {method!r} has no row with a finite {metric} and coverage")
        outside = [c for c, _, _ in known if not 0 <= c <= 1]
        if outside:
            raise InvalidArgument(f"Curve.create: coverage of {method!r} must lie in [0, 1], got {outside[0]}")
        worst_first = sorted(known, key=lambda each: (each[0], each[1] if higher_is_better else -each[1]))
        kept: list[tuple[float, float, float]] = []
        for each in worst_first:
            if kept and each[0] - kept[-1][0] <= SAME:
                kept.pop()
            kept.append(each)
        places, scores, knobs = np.array(kept, dtype=np.float64).T
        undefined = len(rows) - len(known)
        return cls(method, str(convention), metric, places, scores, knobs, higher_is_better, undefined)

    @property
    def is_point(self) -> bool:
        """Whether there is one coverage only."""
        return len(self.coverage) == 1

    def at(self, coverage: float) -> float | None:
        """Score at a coverage, interpolated linearly; None outside the curve's own coverages."""
        if not self.coverage[0] - SAME <= coverage <= self.coverage[-1] + SAME:
            return None
        return float(np.interp(coverage, self.coverage, self.score))

    def area(self, low: float, high: float) -> float | None:
        """Mean score over coverages ``low .. high``; None if the curve does not reach over all of them.

        Raises:
            ValueError: not ``low < high``.
        """
        if not low < high:
            raise InvalidArgument(f"Curve.area: low must be < high, got {low} and {high}")
        ends = self.at(low), self.at(high)
        if ends[0] is None or ends[1] is None:
            return None
        inner = (self.coverage > low) & (self.coverage < high)
        x = np.concatenate([[low], self.coverage[inner], [high]])
        y = np.concatenate([[ends[0]], self.score[inner], [ends[1]]])
        return float(((y[1:] + y[:-1]) / 2 * np.diff(x)).sum() / (high - low))


def common_range(curves: Sequence[Curve]) -> tuple[float, float] | None:
    """Coverages that every curve reaches, points left aside; None where there are none.

    Example:
        >>> rows = [{"coverage": 0.4, "psnr": 20.0}, {"coverage": 0.8, "psnr": 18.0}]
        >>> curve = Curve.create("ours", rows)
        >>> common_range([curve, Curve.create("theirs", rows[:1])])  # a point reaches nothing
        (0.4, 0.8)
    """
    whole = [curve for curve in curves if not curve.is_point]
    if not whole:
        return None
    low, high = max(curve.coverage[0] for curve in whole), min(curve.coverage[-1] for curve in whole)
    return (float(low), float(high)) if high - low > SAME else None


def compare(curves: Sequence[Curve], *, coverage: float | None = None) -> list[dict[str, Any]]:
    """Methods at equal coverage and by area: a results row each, in the order given.

    Args:
        curves: of one convention and one metric, with different names.
        coverage: where to compare; None: the largest that every *curve* reaches, that is the lowest of their
            highest coverages (None for all if there is no curve or one does not reach down to it).

    Returns:
        ``method``, ``convention``, ``coverage_low`` and ``coverage_high`` of its own, ``at_coverage`` (where), then
        ``<metric>_at_coverage`` and ``<metric>_area`` (over ``area_range``); None where a method does not reach: a
        point has a score at its own coverage only, and no area.

    Raises:
        ValueError: two conventions or metrics (both named), two curves of one name, a coverage outside [0, 1].

    Example:
        >>> rows = [{"coverage": 0.4, "psnr": 20.0}, {"coverage": 0.8, "psnr": 18.0}]
        >>> other = [{"coverage": 0.6, "psnr": 17.0}, {"coverage": 0.9, "psnr": 16.0}]
        >>> curves = [Curve.create("ours", rows), Curve.create("theirs", other)]
        >>> [(row["method"], round(row["psnr_at_coverage"], 2)) for row in compare(curves)]  # at .8
        [('ours', 18.0), ('theirs', 16.33)]
    """
    _comparable("compare", curves)
    if coverage is not None and not 0 <= coverage <= 1:
        raise InvalidArgument(f"compare: coverage must lie in [0, 1], got {coverage}")
    shared = common_range(curves)
    if coverage is None and shared is not None:
        coverage = shared[1]
    rows = []
    for curve in curves:
        rows.append(
            {
                "method": curve.method,
                "convention": curve.convention,
                "coverage_low": float(curve.coverage[0]),
                "coverage_high": float(curve.coverage[-1]),
                "at_coverage": coverage,
                f"{curve.metric}_at_coverage": None if coverage is None else curve.at(coverage),
                "area_range": None if shared is None else list(shared),
                f"{curve.metric}_area": None if shared is None or curve.is_point else curve.area(*shared),
            }
        )
    return rows


def against_points(curves: Sequence[Curve]) -> list[dict[str, Any]]:
    """Every curve against every point, at the point's own coverage: ``score - point`` (None where out of reach).

    Returns:
        Rows ``method``, ``point``, ``convention``, ``coverage``, ``<metric>`` of the curve and of the point
        (``<metric>_point``), and ``ahead``: by how much the curve is better, whichever way better is.

    Example:
        >>> rows = [{"coverage": 0.4, "psnr": 20.0}, {"coverage": 0.8, "psnr": 18.0}]
        >>> curve, point = Curve.create("ours", rows), Curve.create("theirs", [{"coverage": 0.6, "psnr": 18.5}])
        >>> round(against_points([curve, point])[0]["ahead"], 6)
        0.5
    """
    _comparable("against_points", curves)
    rows: list[dict[str, Any]] = []
    for curve in (each for each in curves if not each.is_point):
        for point in (each for each in curves if each.is_point):
            there, value = float(point.coverage[0]), float(point.score[0])
            found = curve.at(there)
            ahead = None if found is None else (found - value) * (1 if curve.higher_is_better else -1)
            rows.append(
                {
                    "method": curve.method,
                    "point": point.method,
                    "convention": curve.convention,
                    "coverage": there,
                    curve.metric: found,
                    f"{curve.metric}_point": value,
                    "ahead": ahead,
                }
            )
    return rows


def cut_to_coverage(mask: Mask, confidence: NDArray[Any], *, coverage: float) -> Mask:
    """The surest pixels of a mask, as many as a coverage asks: a knob for methods that have none.

    Args:
        mask: bool, any shape: one image, or all of a scene, in which case the surest of the whole scene stay.
        confidence: of the same shape, larger is surer (accumulation, or minus an uncertainty), no NaN in the mask.
        coverage: share of *all* pixels to keep, rounded down to whole pixels.

    Returns:
        A mask within ``mask``; of equally sure pixels the first in C order stay. If the mask has fewer pixels than
        asked, a copy of it: coverage cannot be added.

    Raises:
        ValueError: shapes, a mask that is not bool, a coverage outside [0, 1], a confidence that is NaN.

    Example:
        >>> mask, confidence = np.array([[True, True, True, False]]), np.array([[0.1, 0.9, 0.5, 1.0]])
        >>> cut_to_coverage(mask, confidence, coverage=0.5).tolist()
        [[False, True, True, False]]
    """
    if mask.dtype != np.bool_ or mask.shape != confidence.shape:
        raise InvalidArgument(
            f"cut_to_coverage: mask must be bool of the shape of confidence {confidence.shape}, got {mask.dtype} "
            f"{mask.shape}"
        )
    if not 0 <= coverage <= 1:
        raise InvalidArgument(f"cut_to_coverage: coverage must lie in [0, 1], got {coverage}")
    candidates = np.flatnonzero(mask)
    sureness = np.asarray(confidence, dtype=np.float64).ravel()[candidates]
    if np.isnan(sureness).any():
        raise InvalidArgument(f"cut_to_coverage: {int(np.isnan(sureness).sum())} confidences in the mask are NaN")
    keep = min(int(coverage * mask.size + 1e-9), len(candidates))
    kept = np.zeros(mask.size, dtype=np.bool_)
    kept[candidates[np.argsort(-sureness, kind="stable")[:keep]]] = True
    return kept.reshape(mask.shape)


def _comparable(caller: str, curves: Sequence[Curve]) -> None:
    if not curves:
        raise InvalidArgument(f"{caller}: curves must hold at least one")
    one_convention(caller, [{"method": each.method, "convention": each.convention} for each in curves])
    metrics = {(each.metric, each.higher_is_better): each.method for each in curves}
    if len(metrics) > 1:
        listed = " and ".join(f"{key[0]!r} (curve {method!r})" for key, method in metrics.items())
        raise InvalidArgument(f"{caller}: curves of one metric only, got {listed}")
    if len({each.method for each in curves}) != len(curves):
        raise InvalidArgument(f"{caller}: methods must have different names, got {[each.method for each in curves]}")
