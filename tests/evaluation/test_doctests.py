"""The examples in the docstrings of evaluation run and say what they say."""

import doctest
import importlib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
MODULES = sorted(
    "unghost." + ".".join(path.relative_to(ROOT).with_suffix("").parts)
    for path in (ROOT / "evaluation").rglob("*.py")
    if ">>>" in path.read_text(encoding="utf-8")
)
EXPECTED = {  # modules of which every public function has an example
    "unghost.evaluation.metrics.geometry": 5,
    "unghost.evaluation.metrics.ldr_flip": 2,
    "unghost.evaluation.metrics.masks": 3,
    "unghost.evaluation.metrics.perceptual": 1,
    "unghost.evaluation.metrics.pixelwise": 1,
    "unghost.evaluation.metrics.similarity": 2,
    "unghost.evaluation.scoring.curves": 5,
    "unghost.evaluation.scoring.engine": 1,
    "unghost.evaluation.scoring.evaluation": 1,
    "unghost.evaluation.scoring.intervals": 4,
}


@pytest.mark.parametrize("name", MODULES)
def test_examples(name):
    found = doctest.testmod(importlib.import_module(name), optionflags=FLAGS)
    assert found.attempted > 0
    assert found.failed == 0


@pytest.mark.parametrize(("name", "count"), EXPECTED.items())
def test_examples_are_there(name, count):
    tests = doctest.DocTestFinder().find(importlib.import_module(name))
    assert sum(bool(test.examples) for test in tests) >= count
