"""How long a call takes: the median, after one that does not count."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any


def median_seconds(work: Callable[[], Any], repeats: int) -> tuple[float, Any]:
    """Of ``repeats`` calls, and what the last of them returned."""
    work()
    taken = []
    for _ in range(repeats):
        begun = time.perf_counter()
        result = work()
        taken.append(time.perf_counter() - begun)
    return statistics.median(taken), result
