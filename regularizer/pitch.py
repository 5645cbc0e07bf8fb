"""The pitch that a regularizer works with: given, or estimated from the field and kept up to date. numpy only."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..cleaning.pitch_estimation import PitchEstimate, Query, estimate_pitch, fallback_pitch
from ..core.errors import InvalidArgument
from ..core.occupancy import OccupancyRule

FieldPitch = float | Callable[[NDArray[np.float64]], NDArray[np.float64]] | None

RANKS = {"extent": 0, "smoothness": 1, "cells": 2}  # an estimate replaces one of its own rank or below
PATIENCE = 4  # steps after which a failed estimate is warned of
PLACES = 8  # along each axis, at which a function's typical pitch is read
WINDOW = 25  # steps over which skipped cubes are counted
MOST_SKIPPED = 0.9
LEAST_MATTER = 0.25  # of the density that makes a cell occupied
CONTRAST = 2.0  # of the highest density of a step's cubes to the lowest, from which they are more than even fog


def checked_pitch(field_pitch: Any) -> FieldPitch:
    """A number (numpy's and torch's too) as a float, a function or None as it is.

    Raises:
        InvalidArgument: a number that is not finite and > 0.
    """
    if field_pitch is None or callable(field_pitch):
        return field_pitch
    try:
        pitch = float(field_pitch)
    except (TypeError, ValueError):
        pitch = np.nan
    if not 0 < pitch < np.inf:
        raise InvalidArgument(f"DensityRegularizer: field_pitch must be finite and > 0, got {field_pitch}")
    return pitch


class PitchSource:
    """Pitch of the field's cells: as it was given, else estimated at steps 0, 1, 2, 4, 8, ….

    A field is nearly constant when its training begins, and some are refined later, so one estimate is not enough.

    Args:
        given: a number, a function of places ``(N, 3)``, or None.
        aabb: ``(2, 3)``, scene units.

    Attributes:
        estimate: the one in use; None if a pitch was given, or before the first step.
    """

    def __init__(self, given: FieldPitch, aabb: NDArray[np.float64]) -> None:
        self.given, self.aabb = checked_pitch(given), aabb
        self.estimate: PitchEstimate | None = None
        self._typical: float | None = None
        self._steps, self._warned = 0, False

    @property
    def of_cubes(self) -> FieldPitch:
        """What cubes are drawn with: as given, else the estimate; None before the first one."""
        if self.given is not None or self.estimate is None:
            return self.given
        return self.estimate.pitch

    @property
    def nominal(self) -> float:
        """One pitch for the whole box; a function's median, and 1/128 of the longest side before the first estimate."""
        pitch = self.of_cubes
        if pitch is None:
            return fallback_pitch(self.aabb)
        if not callable(pitch):
            return pitch
        if self._typical is None:
            shares = (np.stack(np.meshgrid(*[np.arange(PLACES)] * 3, indexing="ij"), axis=-1) + 0.5) / PLACES
            places = self.aabb[0] + shares.reshape(-1, 3) * (self.aabb[1] - self.aabb[0])
            typical = float(np.median(np.asarray(pitch(places), dtype=np.float64)))
            if not 0 < typical < np.inf:
                raise InvalidArgument(
                    f"DensityRegularizer: field_pitch must be finite and > 0 at every cube centre, got {typical}"
                )
            self._typical = typical
        return self._typical

    def refresh(self, query: Query, rng: np.random.Generator) -> None:
        """Count a step, and estimate the pitch anew if it is one of those; nothing where a pitch was given.

        Args:
            query: positions ``(M, 3)`` to densities ``(M,)``, NaN for invalid ones.
            rng: generator.
        """
        if self.given is not None:
            return
        step, self._steps = self._steps, self._steps + 1
        if step & (step - 1) and self.estimate is not None:
            return
        found = estimate_pitch(query, self.aabb, rng=rng)
        if self.estimate is None or RANKS[found.source] >= RANKS[self.estimate.source]:
            self.estimate = found
        if self.estimate.source == "extent" and self.estimate.varies and step >= PATIENCE and not self._warned:
            self._warned = True
            warnings.warn(
                f"DensityRegularizer: field_pitch is not known and could not be estimated, as {found.reason}; "
                f"{found.pitch:.4g} is used, 1/128 of the longest side of aabb: pass field_pitch, the side of the "
                f"field's cells",
                stacklevel=4,
            )

    def state(self) -> dict[str, Any]:
        """What a resumed run needs."""
        return {"steps": self._steps, "estimate": None if self.estimate is None else dataclasses.asdict(self.estimate)}

    def load(self, state: dict[str, Any]) -> None:
        """Inverse of :meth:`state`."""
        self._steps = int(state["steps"])
        self.estimate = None if state["estimate"] is None else PitchEstimate(**state["estimate"])


class SkipWatch:
    """Warns once if nearly all cubes are skipped as empty, step after step, of a field that holds matter.

    Args:
        rule: density to occupancy.
        aabb: ``(2, 3)``, scene units. Matter is what varies, and reaches a quarter of the density that makes a cell
            of 1/128 of its longest side occupied; even fog, as at the beginning of a training, is not.
    """

    def __init__(self, rule: OccupancyRule, aabb: NDArray[np.float64]) -> None:
        self.rule, self.matter = rule, LEAST_MATTER * float(rule.density_threshold(fallback_pitch(aabb)))
        self._warned = False
        self._restart()

    def _restart(self) -> None:
        self._steps = self._cubes = self._skipped = self._holding = 0

    def note(self, *, cubes: int, skipped: int, lowest: float, highest: float, pitch: float) -> None:
        """Count a step: its cubes, those skipped, the extreme densities in them, and the pitch in use."""
        self._steps += 1
        self._cubes, self._skipped = self._cubes + cubes, self._skipped + skipped
        self._holding += highest > max(self.matter, CONTRAST * lowest)
        if self._steps < WINDOW or self._warned:
            return
        share, holds = self._skipped / max(self._cubes, 1), self._holding > WINDOW / 2
        self._restart()
        if share <= MOST_SKIPPED or not holds:
            return
        self._warned = True
        measure = f"an opacity over a cell of {pitch:.4g}" if self.rule.kind == "opacity" else "a density"
        warnings.warn(
            f"DensityRegularizer: {share:.0%} of the cubes of {WINDOW} steps were skipped as empty, although the field "
            f"holds matter: none of their voxels has {measure} above {self.rule.threshold}; check field_pitch, the "
            f"side of the field's cells, and rule",
            stacklevel=4,
        )
