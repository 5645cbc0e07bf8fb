"""Helpers for tests of benchmarks: their options, and what they say when data is missing."""

import sys

import pytest

from benchmarks.options import RESULTS, SHORT_RESULTS, parse


def parsed(module, *words):
    """Options of a benchmark from words of its command line."""
    return parse(module.Options, module.__doc__, words)


def check_short(module, **expected):
    """``--short`` gives each option of ``SHORT`` its value, writes to out/short, and is in the stored command."""
    full, short = module.Options(), parsed(module, "--short")
    assert full.out == RESULTS
    assert short.out == SHORT_RESULTS
    assert short.command() == f"python -m {module.__name__} --short"
    assert expected.items() <= {name: getattr(short, name) for name in expected}.items()
    for name, value in module.Options.SHORT.items():
        assert getattr(short, name) == value != getattr(full, name), name


def refusal(module, monkeypatch, capsys, *words):
    """The one line that a benchmark prints before it exits with status 2; nothing else may be printed."""
    monkeypatch.setattr(sys, "argv", ["benchmark", *map(str, words)])
    with pytest.raises(SystemExit) as stopped:
        module.main()
    assert stopped.value.code == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    (line,) = printed.err.splitlines()
    assert line.startswith(f"{module.__name__}: ")
    return line
