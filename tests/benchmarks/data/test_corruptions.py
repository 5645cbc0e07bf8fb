"""Parts of benchmarks/data/corruptions.py."""

from pathlib import Path

import numpy as np

from benchmarks.data import corruptions
from unghost.data_recipes.corruptions.structured import CORRUPTIONS

PAGE = Path(__file__).resolve().parents[3] / "docs" / "corruptions.md"


def test_every_family_is_explained_and_on_the_page():
    assert set(corruptions.IMITATES) == {*CORRUPTIONS, "corrupt", "soften"}
    text = PAGE.read_text(encoding="utf-8")
    assert all(f"## {name}" in text for name in corruptions.IMITATES)


def test_measured_changes_by_hand(monkeypatch):
    cube = np.zeros((32, 32, 32), dtype=bool)
    cube[:4, 0, 0] = True
    added = cube.copy()
    added[4, 0, 0] = True
    monkeypatch.setitem(corruptions.CORRUPTIONS, "salt", lambda rng, clean, severity: added)
    assert corruptions.measure("salt", [cube]) == [(0.25, 0.8)] * len(corruptions.SEVERITIES)
