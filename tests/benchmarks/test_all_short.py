"""The runner of all short forms."""

import importlib
import subprocess
import sys

from benchmarks import all_short


def test_names_are_chosen_by_their_beginnings():
    assert all_short.Options().chosen() == list(all_short.WITHOUT_DATA)
    assert all_short.Options(("cleaning", "data.cur")).chosen() == ["cleaning.cost", "cleaning.splats", "data.curate"]


def test_no_short_form_lacks_data():
    for name in all_short.WITHOUT_DATA:
        module = importlib.import_module(f"benchmarks.{name}")
        assert module.Options(short=True).shortened().lacking() is None, name


def test_the_summary_tells_failures(monkeypatch, tmp_path, capsys):
    def run(command, *, stdout, **ignored):
        stdout.write("a line\nthe last line\n")
        return subprocess.CompletedProcess(command, int("splats" in command[2]))

    monkeypatch.setattr(all_short.subprocess, "run", run)
    monkeypatch.setattr(all_short, "SHORT_RESULTS", tmp_path)
    monkeypatch.setattr(sys, "argv", ["all_short", "cleaning"])
    assert all_short.main() == 1
    text = capsys.readouterr().out
    assert "[1/2] cleaning.cost\n    0 s, of a processor 0 s, status 0: the last line" in text
    first, second, last = text.splitlines()[-3:]
    assert (first.split()[0], first.split()[-1]) == ("cleaning.cost", "ok")
    assert second.startswith("cleaning.splats ")
    assert second.endswith("FAILED, status 1")
    assert last.startswith("wrote ")
