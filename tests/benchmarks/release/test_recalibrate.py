"""One command for all that follows from a model."""

import json
import sys

import pytest
from unghost_tests.benches import check_short, refusal

from benchmarks.release import recalibrate
from unghost.export.runtime import read_manifest


@pytest.mark.slow
def test_a_short_run_ships_a_model_again_elsewhere(monkeypatch, tmp_path):
    before = (recalibrate.WEIGHTS / "xs.onnx").read_bytes()
    words = ["--short", "--weights", str(tmp_path / "weights"), "--out", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", ["recalibrate.py", *words])
    recalibrate.main()
    assert (recalibrate.WEIGHTS / "xs.onnx").read_bytes() == before
    manifest = read_manifest(tmp_path / "weights" / "xs.onnx")
    rows = json.loads((tmp_path / "threshold_xs.json").read_text(encoding="utf-8"))["rows"]
    assert [row["threshold"] for row in rows if row["chosen"]] == [manifest.removal_threshold]
    assert json.loads((tmp_path / "demo.json").read_text(encoding="utf-8"))["command"] == "unghost demo --seed 0"


def test_what_is_missing_is_one_line(monkeypatch, capsys):
    check_short(recalibrate, models=("xs",))
    assert "no shipped model nobody; there are default" in refusal(recalibrate, monkeypatch, capsys, "nobody")
