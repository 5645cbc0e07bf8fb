"""Results files with rounded numbers and one line per row."""

import json

import pytest

from benchmarks.compact import rounded, write_lines


def test_rounding_to_significant_digits():
    value = {"a": 123.456789, "b": [0.000123456789, 7, True, None, "0.123456789"], "c": (1e9 + 0.5,)}
    assert rounded(value) == {"a": 123.46, "b": [0.00012346, 7, True, None, "0.123456789"], "c": [1e9]}
    assert rounded(123.456789, 2) == 120.0


def test_a_line_per_row(tmp_path):
    results = {
        "command": "x",
        "rows": [{"method": "a", "values": [1, 2.5]}, {"method": "b"}],
        "seeds": [0, 1],
        "none": [],
    }
    write_lines(tmp_path / "new" / "r.json", results)
    text = (tmp_path / "new" / "r.json").read_text()
    assert json.loads(text) == results
    assert text.splitlines()[2:5] == [' "rows": [', '  {"method":"a","values":[1,2.5]},', '  {"method":"b"}']
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["r.json"]
    with pytest.raises(ValueError, match="JSON"):
        write_lines(tmp_path / "r.json", {"rows": [{"method": "a", "psnr": float("nan")}]})
    assert not (tmp_path / "r.json").exists()
