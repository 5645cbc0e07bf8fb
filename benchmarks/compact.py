"""Smaller results files: rounded numbers, one line per row."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from unghost.core.io import write_text

DIGITS = 5  # tables print means with 3 decimals: no number of theirs changes


def rounded(value: Any, digits: int = DIGITS) -> Any:
    """A copy of a JSON value with every float rounded to so many significant digits."""
    if isinstance(value, float):
        return float(f"{value:.{digits}g}")
    if isinstance(value, Mapping):
        return {key: rounded(each, digits) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [rounded(each, digits) for each in value]
    return value


def write_lines(path: str | Path, results: Mapping[str, Any]) -> None:
    """Write a results file atomically, with every row of its lists on one line.

    Raises:
        ValueError: a number is NaN or infinite, which JSON does not have.
    """
    parts = [f" {json.dumps(key)}: {_value(value)}" for key, value in results.items()]
    write_text(path, "{\n" + ",\n".join(parts) + "\n}\n")


def _value(value: Any) -> str:
    """One key's JSON: a list of objects or lists has a line for each."""
    if isinstance(value, (list, tuple)) and any(isinstance(each, (list, tuple, Mapping)) for each in value):
        return "[\n  " + ",\n  ".join(_line(each) for each in value) + "\n ]"
    return _line(value)


def _line(value: Any) -> str:
    return json.dumps(value, separators=(",", ":"), allow_nan=False)
