"""Lines of progress."""

from benchmarks import progress
from benchmarks.options import ROOT


def test_a_plan_counts_stages_and_learns_how_long_they_take(monkeypatch, capsys):
    clock = iter((0.0, 0.0, 0.0, 60.0, 60.0))
    monkeypatch.setattr(progress.time, "perf_counter", lambda: next(clock))
    plan = progress.Plan(["fit", "fit", "tune"], {"fit": 120.0, "tune": 30.0})
    plan.begin("fit", "first")
    plan.begin("fit", "second")  # the first took a minute: so will this one
    assert capsys.readouterr().out.splitlines() == [
        "[1/3] first · 0.0 min so far, about 4.5 left",
        "[2/3] second · 1.0 min so far, about 1.5 left",
    ]
    plan.skip(["tune"])
    assert plan.left == []


def test_the_last_line_names_files(capsys, tmp_path):
    progress.wrote(ROOT / "out" / "short" / "a.json", tmp_path / "b.png")
    assert capsys.readouterr().out == f"wrote out/short/a.json, {tmp_path.resolve() / 'b.png'}\n"
