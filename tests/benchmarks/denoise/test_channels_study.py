"""Options of benchmarks/denoise/channels_study.py; its parts are tested in test_run.py."""

import pytest

pytest.importorskip("torch")

from unghost_tests.benches import check_short, refusal

from benchmarks.denoise import channels_study


def test_short():
    check_short(channels_study, steps=2, size="xs")


def test_what_is_missing(monkeypatch, capsys, tmp_path):
    assert "needs SHARDS" in refusal(channels_study, monkeypatch, capsys)
    assert "needs MESHES" in refusal(channels_study, monkeypatch, capsys, tmp_path)
    assert "no nowhere" in refusal(channels_study, monkeypatch, capsys, "nowhere=.5", "--short")
