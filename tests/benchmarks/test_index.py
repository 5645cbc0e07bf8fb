"""benchmarks/README.md lists every benchmark, and what it lists exists."""

import re
from pathlib import Path

import pytest

from benchmarks import all_short

ROOT = Path(__file__).resolve().parents[2]
INDEX = (ROOT / "benchmarks" / "README.md").read_text(encoding="utf-8")
ROWS = [
    [cell.strip() for cell in line.strip().strip("|").split(" | ")]
    for line in INDEX.splitlines()
    if line.startswith("| ") and "python -m benchmarks." in line.split(" | ")[1]
]
COMMAND = re.compile(r"python -m (benchmarks(?:\.\w+)+)")


def module_of(row):
    return COMMAND.search(row[1]).group(1)


def path_of(module):
    return ROOT / (module.replace(".", "/") + ".py")


def runnable():
    """Modules with a ``main`` or a ``__main__`` guard."""
    found = set()
    for path in sorted((ROOT / "benchmarks").rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        if re.search(r'^(if __name__ == "__main__"|def main\()', text, re.MULTILINE):
            found.add(".".join(path.relative_to(ROOT).with_suffix("").parts))
    return found


def test_every_benchmark_is_listed_once():
    listed = [module_of(row) for row in ROWS]
    assert len(listed) == len(set(listed))
    assert set(listed) == runnable() - {"benchmarks.all_short"}


@pytest.mark.parametrize("module", sorted(set(COMMAND.findall(INDEX))))
def test_every_command_names_a_module(module):
    assert path_of(module).is_file()


@pytest.mark.parametrize("row", ROWS, ids=module_of)
def test_every_row_is_whole(row):
    question, _, short, result, needs, full, short_seconds = row
    assert question.endswith("?")
    assert needs
    assert full
    for target in re.findall(r"\]\(([^)]+)\)", result):
        assert (ROOT / "benchmarks" / target).exists(), target
    text = path_of(module_of(row)).read_text(encoding="utf-8")
    assert ("BenchmarkOptions" in text) == short.startswith("`--short`")
    assert (short_seconds == "–") != short.startswith("`--short`")


def test_every_result_file_is_listed():
    listed = {Path(target).name for target in re.findall(r"\]\(\.\./docs/results/([^)]+)\)", INDEX)}
    elsewhere = {"demo.json", "verify.json"}  # of `unghost demo` and `unghost verify`
    assert {path.name for path in (ROOT / "docs" / "results").glob("*.json")} == {
        name for name in listed if name.endswith(".json")
    } | elsewhere


def test_the_runner_knows_what_needs_no_data():
    without = {module_of(row).removeprefix("benchmarks.") for row in ROWS if row[2] == "`--short`"}
    assert without == set(all_short.WITHOUT_DATA)
