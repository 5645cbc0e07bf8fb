"""Nothing that is committed may name a place that exists on one machine only."""

import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
# Spelled in pieces, so that this file passes its own test.
FOREIGN = re.compile(
    r"(?<![\w.\-])/(?:" + "|".join(["ho" + "me", "wo" + "rk", "Us" + "ers", "ro" + "ot", "tm" + "p"]) + r")/"
)
TEXT = {".py", ".md", ".toml", ".txt", ".json", ".cfg", ".sh", ".html", ".csv", ".yml", ".yaml", ""}


def tracked():
    listing = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=False)
    if listing.returncode:
        pytest.skip("not a git checkout")
    return [ROOT / name for name in listing.stdout.split("\0") if name]


def foreign_lines(text):
    return [line.strip() for line in text.splitlines() if FOREIGN.search(line)]


def test_no_tracked_file_names_a_machines_folders():
    found = {}
    for path in tracked():
        if path.suffix in TEXT and path.is_file() and not path.is_symlink():
            lines = foreign_lines(path.read_text(encoding="utf-8"))
            if lines:
                found[path.relative_to(ROOT).as_posix()] = lines[:3]
    assert found == {}


@pytest.mark.parametrize("line", ["cd /ho" + "me/someone", "'/wo" + "rk/x'", "/Us" + "ers/me/x"])
def test_the_check_can_fail(line):
    assert foreign_lines(line)


@pytest.mark.parametrize("line", ["docs/ho" + "me/x", "../wo" + "rk/", "a frame/wo" + "rk/thing"])
def test_relative_paths_pass(line):
    assert not foreign_lines(line)
