"""Parts of benchmarks/data/harvest_page.py."""

import numpy as np
from unghost_tests.benches import refusal

from benchmarks.data import harvest_page
from benchmarks.options import SAMPLE
from unghost.core.shards.storage import read_shard


def test_what_is_missing(monkeypatch, capsys):
    assert "needs HARVEST" in refusal(harvest_page, monkeypatch, capsys)
    assert "there is no nowhere" in refusal(harvest_page, monkeypatch, capsys, "nowhere")


def test_a_row_of_pictures(monkeypatch):
    monkeypatch.setattr(harvest_page, "WIDTH", 32)
    pictures = harvest_page.draw_row(read_shard(SAMPLE), 0)
    assert len(pictures) == len(harvest_page.HEADINGS)
    assert all(np.asarray(picture).shape == (harvest_page.WIDTH, harvest_page.WIDTH, 3) for picture in pictures)
