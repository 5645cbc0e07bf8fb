"""Progress of long measurements on the standard output: lines that appear at once, and a plan with the time left."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from .options import ROOT


def say(text: str) -> None:
    """Print a line of progress, at once."""
    print(text, flush=True)


def wrote(*paths: Path) -> None:
    """Print the last line of a benchmark: the files that it wrote."""
    places = [path.resolve() for path in paths]
    say("wrote " + ", ".join(str(p.relative_to(ROOT) if p.is_relative_to(ROOT) else p) for p in places))


class Plan:
    """Says what is being done, and about how long the rest will take.

    Args:
        stages: kinds of stages, one entry for each that is to come.
        guesses: seconds of each kind, until one has been timed.
    """

    def __init__(self, stages: Sequence[str], guesses: dict[str, float]) -> None:
        self.left, self.total = list(stages), len(stages)
        self.durations = {kind: [seconds] for kind, seconds in guesses.items()}
        self.begun = self.now = time.perf_counter()
        self.current: str | None = None

    def begin(self, stage: str, what: str) -> None:
        """Announce the next stage."""
        self._learn()
        rest = sum(float(np.mean(self.durations[each])) for each in self.left)
        self.left.remove(stage)
        self.current, self.now = stage, time.perf_counter()
        so_far = (self.now - self.begun) / 60
        say(
            f"[{self.total - len(self.left)}/{self.total}] {what} · {so_far:.1f} min so far, about {rest / 60:.1f} left"
        )

    def skip(self, stages: Iterable[str]) -> None:
        """Take stages that will not come out of the plan."""
        for stage in stages:
            self.left.remove(stage)

    def _learn(self) -> None:
        spent = time.perf_counter() - self.now
        if self.current is not None and spent > 2.0:  # less: it came from the cache
            timed = self.durations[self.current]
            self.durations[self.current] = [spent] if len(timed) == 1 else [*timed[-2:], spent]
