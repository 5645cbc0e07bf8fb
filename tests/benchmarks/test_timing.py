"""Medians and clocks."""

import pytest

from benchmarks import timing


def test_the_median_does_not_count_the_warm_up(monkeypatch):
    clock = iter((0.0, 5.0, 10.0, 11.0, 20.0, 22.0))
    monkeypatch.setattr(timing.time, "perf_counter", lambda: next(clock))
    calls = iter("abcde")
    assert timing.median_seconds(lambda: next(calls), 3, warm_up=2) == (2.0, "e")


def test_a_clock_reads_both_times(monkeypatch):
    wall, processor = iter((1.0, 4.0)), iter((10.0, 15.0))
    monkeypatch.setattr(timing.time, "perf_counter", lambda: next(wall))
    monkeypatch.setattr(timing.time, "process_time", lambda: next(processor))
    assert timing.Clock().read() == {"seconds": pytest.approx(3.0), "cpu_seconds": pytest.approx(5.0)}
