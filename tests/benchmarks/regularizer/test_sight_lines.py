"""Options and parts of benchmarks/regularizer/sight_lines.py."""

import dataclasses

import numpy as np
import pytest

pytest.importorskip("torch")

from unghost_tests.benches import check_short

from benchmarks.regularizer import sight_lines
from unghost.core.sight_lines import SightLines


def test_short():
    check_short(sight_lines, observations=10_000, repeats=2, twin=20)


def test_the_slow_twin_agrees_and_can_disagree(monkeypatch):
    points, cameras = sight_lines.scene(800)
    lines = SightLines.build(points, cameras, aabb=sight_lines.BOX, pitch=0.1)
    assert len(points.point) == 800
    assert len(lines) > 200
    sight_lines.check_counts(lines, 20)
    first = sight_lines.GridTraversal

    class Wrong(first):
        def count(self, chosen):
            return super().count(chosen) + (np.arange(np.prod(self.block.shape)) == 7).reshape(self.block.shape)

    monkeypatch.setattr(sight_lines, "GridTraversal", Wrong)
    with pytest.raises(AssertionError, match="differ from the slow twin"):
        sight_lines.check_counts(lines, 20)


@pytest.mark.slow
def test_rows():
    options = dataclasses.replace(sight_lines.Options(), observations=800, repeats=1, twin=5)
    points, cameras = sight_lines.scene(options.observations)
    rows = sight_lines.step_rows(points, cameras, options)
    assert [row["positions"] for row in rows] == [4096 * (12 + 8)] * 3
    assert all(row["cpu_seconds"] > 0 for row in rows)
