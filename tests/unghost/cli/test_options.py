import dataclasses
import importlib
import subprocess
import sys

import pytest

from unghost.cli.captures import PosingOptions, PosingSettings
from unghost.cli.cleaning import CleanOptions, CleanSettings
from unghost.cli.entry import VERBS, main
from unghost.cli.options import given, in_options, option_names, options_of
from unghost.cli.recipes import HarvestConfig, HarvestOptions
from unghost.cli.training import TrainConfig, TrainOptions

PAIRS = [
    ("capture", PosingSettings, PosingOptions, set()),
    ("harvest", HarvestConfig, HarvestOptions, {"kinds", "shares"}),
    ("train", TrainConfig, TrainOptions, {"network"}),
    (
        "clean",
        CleanSettings,
        CleanOptions,
        {"strength", "keep_boxes", "resolution", "field_pitch", "rule", "soft", "skip_empty", "backend", "chunk"},
    ),
]


@pytest.mark.parametrize("verb", VERBS)
def test_the_overview_says_what_the_verb_says(verb):
    module, summary = VERBS[verb]
    function = getattr(importlib.import_module(f"unghost.cli.{module}"), verb)
    assert function.__doc__.strip().splitlines()[0] == summary


@pytest.mark.parametrize(
    ("words", "absent"), [(["--help"], "onnxruntime torch scipy pandas"), (["masks", "-h"], "torch")]
)
def test_help_is_quick_because_it_imports_little(words, absent):
    code = f"import sys\nfrom unghost.cli import main\ntry: main({words})\nexcept SystemExit: pass\n"
    code += f"print('LOADED', [name for name in {absent.split()} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "LOADED []"


@pytest.mark.parametrize(("verb", "config", "options", "left_out"), PAIRS)
def test_every_field_of_a_configuration_is_an_option(verb, config, options, left_out, capsys):
    fields = {item.name for item in dataclasses.fields(config)}
    assert {item.name for item in dataclasses.fields(options)} == fields - left_out
    assert given(options()) == {}
    with pytest.raises(SystemExit):
        main([verb, "--help"])
    text = capsys.readouterr().out
    for name in fields - left_out:
        assert f"--{name.replace('_', '-')} " in text or f"--{name.replace('_', '-')}," in text
    assert not any(mark in text for mark in ("``", ":func:"))


def test_defaults_stand_in_the_help_and_falsy_values_count():
    @dataclasses.dataclass(frozen=True)
    class Config:
        """Things.

        Attributes:
            share: of ``x``, see :class:`~a.b.Thing`.
            name: of it.
            sizes: of each.
        """

        share: float = 0.5
        name: str = "n"
        sizes: tuple[int, ...] = (1, 2)
        other: int = 3

    made = options_of(Config, leave_out=("other",))
    assert "of x, see Thing." in made.__doc__
    assert given(made(share=0.0, name="", sizes=())) == {"share": 0.0, "name": "", "sizes": ()}


@pytest.mark.parametrize(
    ("message", "written"),
    [
        ("2 photos are gone (missing='drop' leaves them out)", "2 photos are gone (--missing drop leaves them out)"),
        ("evaluate: eval_split must say which", "evaluate: --eval-split must say which"),
        ("see downscale (now 8)", "see --downscale (now 8)"),
        ("make: downscale and eval_split must be right", "make: --downscale and --eval-split must be right"),
        ("it holds with normalize=False alone", "it holds with --no-normalize alone"),
        ("it is with normalize=True", "it is with --normalize"),
        ("masks: minimum_views must be >= 1", "masks: --min-views must be >= 1"),
        ("photos must all have one size", "photos must all have one size"),  # no argument, but what it names
        ("no file out/eval_split, nor 'eval_split'", "no file out/eval_split, nor 'eval_split'"),
        ("the downscale of eval_split.json", "the downscale of eval_split.json"),
        ("3 photos are gone (backend='torch' does it); left", "3 photos are gone; left"),  # no option of that name
        ("say --eval-split or --missing drop", "say --eval-split or --missing drop"),
    ],
)
def test_errors_name_options_as_they_are_typed(message, written):
    names = {"missing", "eval_split", "downscale", "normalize", "photos", "min_views"}
    assert in_options(message, names) == written


def test_every_verb_has_options_and_a_positional_argument_is_none():
    from unghost.cli import captures, cleaning

    assert {"out", "frames", "longest_side", "seed"} <= option_names(captures.capture)
    assert not {"train", "evaluation", "options"} & option_names(captures.capture)
    assert {"keep_box", "cameras", "strength"} <= option_names(cleaning.clean)
    assert in_options("nothing must be", set()) == "nothing must be"
