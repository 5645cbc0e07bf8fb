"""Options and parts of benchmarks/regularizer/cost.py."""

import numpy as np
import pytest

pytest.importorskip("torch")

import torch
from unghost_tests.benches import check_short, refusal

from benchmarks.cleaning.cost import ring
from benchmarks.regularizer import cost


def test_short():
    check_short(cost, repeats=1, cubes=2)


def test_what_is_missing(monkeypatch, capsys):
    assert "needs CAPTURE" in refusal(cost, monkeypatch, capsys)
    assert "no nowhere" in refusal(cost, monkeypatch, capsys, "nowhere", "--short")


def test_the_published_way_to_count_agrees_where_lenses_are_straight():
    cameras, points = ring(60), np.random.default_rng(0).uniform(-1, 1, (500, 3))
    found = cost.nerfstudio_count(cameras, torch.from_numpy(points).float()).numpy()
    assert (found != cameras.view_count(points)).mean() < 0.01  # float32 on the border of an image
