from pathlib import Path

import pytest
import torch
from unghost_tests.benches import check_short

from benchmarks.regularizer import stability as STABILITY

ROOT = Path(__file__).resolve().parents[3]
TYPES = (torch.float32, torch.float16, torch.bfloat16)
LIMITS = {  # elsewhere 1e-6
    "a smooth field": (1e-8, 1e-4, 1e-3),
    "`clean` of a smooth field": (1e-6, 1e-3, 1e-2),
    "scene unit × 1e6": (1e-5,),
    "scene unit × 1e-6": (1e-5,),
    "a box 1e5 units from the origin": (1e-2,),
    "scaled gradients, distances 0 to inf": (1e-6, 1e-3, 1e-2),
}
ROWS = [
    [cell.strip() for cell in line.strip("|").split(" | ")]
    for line in (ROOT / "docs" / "stability.md").read_text(encoding="utf-8").splitlines()
    if line.startswith("| ")
]


def rows_of(case):
    return [row for row in ROWS if row[:2] == [case.given, case.behaviour]]


@pytest.mark.slow
@pytest.mark.parametrize("case", STABILITY.CASES, ids=lambda case: case.given)
def test_hostile_numbers(case):
    """The behaviour of every row in every type, its error, and the error that the document has for it."""
    assert set(case.types) <= set(TYPES)
    assert len(rows_of(case)) == 1, f"run benchmarks/regularizer/stability.py again: {case.given}"
    for column, dtype in enumerate(TYPES):
        error, written = case.check(dtype) if dtype in case.types else None, rows_of(case)[0][2 + column]
        assert (error is None) == (written == "–"), (
            f"run benchmarks/regularizer/stability.py again: {case.given}, {dtype}"
        )
        if error is not None:
            limit = dict(zip(TYPES, LIMITS.get(case.given, ()))).get(dtype, 1e-6)
            assert error <= limit
            assert float(written) <= limit


def test_the_document_holds_these_rows_and_no_others():
    assert STABILITY.TYPES == TYPES
    assert [row[:2] for row in ROWS[1:]] == [[case.given, case.behaviour] for case in STABILITY.CASES]
    assert ROWS[0][2:] == [str(dtype).removeprefix("torch.") for dtype in TYPES]
    assert set(LIMITS) <= {case.given for case in STABILITY.CASES}


def test_checks_can_fail():
    with pytest.raises(AssertionError, match="no ValueError that says '; first'"):
        STABILITY.raises(1.0, torch.float32)
    with pytest.raises(AssertionError, match="no ValueError"):
        STABILITY.refuses(lambda: None, ValueError, "anything")


def test_short_checks_one_type(monkeypatch, capsys):
    check_short(STABILITY)
    checked = []
    case = STABILITY.Case("a case", "behaves", checked.append, TYPES)
    assert STABILITY.row_of(case, TYPES[:1]) == "| a case | behaves | – | – | – |"
    assert checked == [torch.float32]
