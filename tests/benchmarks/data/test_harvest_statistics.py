"""Options and parts of benchmarks/data/harvest_statistics.py."""

import pytest

pytest.importorskip("torch")

from unghost_tests.benches import check_short, refusal

from benchmarks.data import harvest_statistics
from benchmarks.options import SAMPLE
from unghost.data_recipes.inspection.statistics import shard_statistics


def test_short():
    check_short(harvest_statistics, harvest=SAMPLE, cubes=12)


def test_what_is_missing(monkeypatch, capsys, tmp_path):
    assert "needs CAPTURE" in refusal(harvest_statistics, monkeypatch, capsys)
    assert "needs HARVEST" in refusal(harvest_statistics, monkeypatch, capsys, tmp_path)
    assert "no nowhere" in refusal(harvest_statistics, monkeypatch, capsys, "nowhere", "--short")


def test_distances_are_to_the_first_set():
    assert [*harvest_statistics.by_kind(SAMPLE)] == ["mixed"]
    sample = shard_statistics([SAMPLE], most=8)
    first, second = harvest_statistics.rows_of({"capture": sample, "harvest": harvest_statistics.corrupted("salt", 8)})
    assert first["distance"] == 0.0
    assert 0.0 < second["distance"] <= 1.0
