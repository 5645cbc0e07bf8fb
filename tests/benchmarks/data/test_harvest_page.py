"""Parts of benchmarks/data/harvest_page.py."""

import numpy as np
from unghost_tests.benches import refusal

from benchmarks.data import harvest_page
from benchmarks.options import SAMPLE
from unghost.core.shards.storage import read_shard


def test_what_is_missing(monkeypatch, capsys):
    assert "needs HARVEST" in refusal(harvest_page, monkeypatch, capsys)
    assert "there is no nowhere" in refusal(harvest_page, monkeypatch, capsys, "nowhere")


def test_a_row_of_pictures():
    sample = read_shard(SAMPLE)
    rows = harvest_page.interesting(sample)
    assert sorted(rows.tolist()) == list(range(len(sample)))
    pictures = harvest_page.draw_row(sample, int(rows[0]))
    assert len(pictures) == len(harvest_page.HEADINGS)
    assert all(np.asarray(picture).shape == (harvest_page.WIDTH, harvest_page.WIDTH, 3) for picture in pictures)
