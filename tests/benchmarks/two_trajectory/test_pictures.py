"""Options of benchmarks/two_trajectory/pictures.py."""

import pytest

pytest.importorskip("torch")

from unghost_tests.benches import check_short, refusal

from benchmarks.two_trajectory import pictures


def test_short():
    check_short(pictures, scene="room-1", views=2)


def test_what_is_missing(monkeypatch, capsys):
    assert "no nowhere" in refusal(pictures, monkeypatch, capsys, "--capture", "nowhere")
