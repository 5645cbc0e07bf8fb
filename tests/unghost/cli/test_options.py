import dataclasses
import importlib
import subprocess
import sys

import pytest

from unghost.cli.captures import PosingOptions, PosingSettings
from unghost.cli.cleaning import CleanOptions, CleanSettings
from unghost.cli.entry import VERBS, main
from unghost.cli.options import given, options_of
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
