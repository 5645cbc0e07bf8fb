import importlib.util
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def load():
    spec = importlib.util.spec_from_file_location("stability_benchmark", ROOT / "benchmarks" / "stability.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


STABILITY = load()
LIMITS = {
    "float16 densities": 1e-3,
    "bfloat16 densities": 1e-2,
    "scene unit × 1e6": 1e-4,
    "scene unit × 1e-6": 1e-4,
    "a box 1e5 units from the origin": 1e-2,
}


@pytest.mark.parametrize("case", STABILITY.CASES, ids=lambda case: case.given)
def test_hostile_numbers(case):
    error = case.check()
    assert error is None or error <= LIMITS.get(case.given, 1e-6)


def test_the_document_holds_every_row():
    text = (ROOT / "docs" / "stability.md").read_text(encoding="utf-8")
    for case in STABILITY.CASES:
        assert f"| {case.given} | {case.behaviour} |" in text, f"run benchmarks/stability.py again: {case.given}"


def test_a_check_can_fail():
    with pytest.raises(AssertionError, match="was accepted"):
        STABILITY.raises(1.0)
