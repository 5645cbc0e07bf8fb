"""Options that all benchmarks share."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import pytest
import tyro

from benchmarks.options import NOT_GIVEN, RESULTS, SHORT_RESULTS, BenchmarkOptions, give_up, given, parse


@dataclass(frozen=True)
class Options(BenchmarkOptions):
    """For a test.

    Attributes:
        capture: a folder.
        shards: folders.
        steps: of it.
        share: a number.
        fast: a flag.
        more: a folder that may be left out.
    """

    SHORT: ClassVar[dict[str, Any]] = {"steps": 1, "shards": ("sample",)}
    DATA: ClassVar[dict[str, str]] = {"capture": "a capture", "more": "more"}
    SHORT_WITHOUT: ClassVar[tuple[str, ...]] = ("capture",)

    capture: tyro.conf.Positional[Path] = NOT_GIVEN
    shards: tuple[str, ...] = ("full",)
    steps: int = 9
    share: float = 0.5
    fast: bool = False
    more: Path | None = None


def test_short_changes_what_was_left_at_its_default(tmp_path):
    short = parse(Options, None, ["--short"])
    assert (short.steps, short.shards, short.out) == (1, ("sample",), SHORT_RESULTS)
    mine = parse(Options, None, ["--short", "--steps", "4", "--out", str(tmp_path)])
    assert (mine.steps, mine.shards, mine.out) == (4, ("sample",), tmp_path)
    full = parse(Options, None, [str(tmp_path)])
    assert (full.steps, full.shards, full.out) == (9, ("full",), RESULTS)


def test_a_short_run_never_writes_over_results(monkeypatch):
    monkeypatch.chdir(RESULTS.parents[1])
    assert parse(Options, None, ["--short", "--out", "docs/results"]).out == SHORT_RESULTS


def test_the_command_repeats_the_run_and_names_no_folder(tmp_path):
    folder = tmp_path / "plush"
    folder.mkdir()
    words = [str(folder), "--shards", "a/b=.5", "x=c/d.onnx", "--fast", "--share", "0.25", "--out", str(tmp_path)]
    options = parse(Options, None, words)
    command = f"python -m {Options.__module__} plush --shards b=.5 x=d.onnx --share 0.25 --fast"
    assert options.command() == command
    monkey = parse(Options, None, ["--short", "--steps", "4"])
    assert monkey.command() == f"python -m {Options.__module__} --short --steps 4"
    assert parse(Options, None, monkey.command().split()[3:]) == monkey


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "needs CAPTURE, a capture"),
        (["nowhere/at/all"], "capture: there is no nowhere/at/all; needs a capture"),
        (["--short", "--more", "nowhere"], "more: there is no nowhere; needs more"),
    ],
)
def test_missing_data_is_named_in_one_line(words, said, capsys):
    with pytest.raises(SystemExit) as stopped:
        parse(Options, None, words)
    assert stopped.value.code == 2
    assert capsys.readouterr().err == f"{Options.__module__}: {said}\n"


def test_give_up_and_given(capsys):
    with pytest.raises(SystemExit) as stopped:
        give_up(Options, "needs a browser")
    assert stopped.value.code == 2
    assert capsys.readouterr().err.endswith(": needs a browser\n")
    assert given(Path("a"))
    assert not given(Options().capture)


def test_help_explains_the_shared_options_too(capsys):
    with pytest.raises(SystemExit) as stopped:
        parse(Options, "A test.", ["--help"])
    assert stopped.value.code == 0
    text = capsys.readouterr().out
    assert "never to" in text
    assert "of torch and onnxruntime" in text
