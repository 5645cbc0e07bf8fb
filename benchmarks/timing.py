"""Timing: the median of repeated calls, and clocks of wall and processor time."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any, TypedDict


def median_seconds(work: Callable[[], Any], repeats: int, *, warm_up: int = 1) -> tuple[float, Any]:
    """Median seconds of ``repeats`` calls after ``warm_up`` uncounted ones, and what the last call returned."""
    for _ in range(warm_up):
        work()
    taken = []
    for _ in range(repeats):
        begun = time.perf_counter()
        result = work()
        taken.append(time.perf_counter() - begun)
    return statistics.median(taken), result


class Spent(TypedDict):
    """Seconds by the clock and of all threads together."""

    seconds: float
    cpu_seconds: float


class Clock:
    """Seconds since the clock was made: wall time and processor time."""

    def __init__(self) -> None:
        self._begun = time.perf_counter(), time.process_time()

    def read(self) -> Spent:
        """``seconds`` of wall time and ``cpu_seconds`` of all threads together."""
        now = time.perf_counter(), time.process_time()
        return {"seconds": now[0] - self._begun[0], "cpu_seconds": now[1] - self._begun[1]}
