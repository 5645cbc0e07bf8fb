"""The benchmark of the loader and the trainer runs, and says what it timed."""

import json
import sys

import pytest

pytest.importorskip("torch")
pytest.importorskip("tyro")

from unghost_tests.benches import check_short, refusal

from benchmarks.release import training_speed


def test_loader_network_and_both(shard_paths, tmp_path, monkeypatch):
    monkeypatch.setattr(training_speed.torch, "set_num_threads", lambda count: None)  # other tests keep theirs
    monkeypatch.setattr(training_speed, "keep_freed_memory", lambda: True)
    monkeypatch.setattr(
        sys,
        "argv",
        [
            "training_speed.py",
            str(shard_paths["a"]),
            "--sizes",
            "xs",
            "--batches",
            "1",
            "--batch-size",
            "2",
            "--threads",
            "1",
            "--out",
            str(tmp_path),
        ],
    )
    training_speed.main()
    found = json.loads((tmp_path / "training_speed.json").read_text(encoding="utf-8"))
    assert [(row["method"], len(row["channels"]), row["memory"]) for row in found["rows"]] == [
        ("xs", 1, "returned"),
        ("xs", 1, "kept"),
        ("xs", 6, "kept"),
    ]
    for row in found["rows"]:
        assert row["loader_over_network"] == pytest.approx(
            row["loader_cubes_per_second"] / row["network_cubes_per_second"]
        )
        assert row["training_cubes_per_second"] > 0
    assert str(tmp_path) not in json.dumps(found)


def test_short_and_what_is_missing(monkeypatch, capsys):
    check_short(training_speed, sizes=("xs",))
    assert "needs SHARDS" in refusal(training_speed, monkeypatch, capsys)
    assert "no nowhere" in refusal(training_speed, monkeypatch, capsys, "nowhere=.5")
