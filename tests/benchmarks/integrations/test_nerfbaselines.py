"""Parts of benchmarks/integrations/nerfbaselines.py that need no nerfbaselines."""

import importlib.util

import numpy as np
import pytest
from unghost_tests.benches import check_short, refusal

from benchmarks.integrations import nerfbaselines


def test_short():
    check_short(nerfbaselines)


@pytest.mark.skipif(importlib.util.find_spec("nerfbaselines") is not None, reason="nerfbaselines is installed")
def test_the_environment_is_named(monkeypatch, capsys):
    assert "make nerfbaselines" in refusal(nerfbaselines, monkeypatch, capsys)


def test_the_wall_is_half_seen_and_the_last_view_not_at_all():
    maps, photos, rgb, depth = nerfbaselines.scene()
    seen = maps.visible(occlusion=False).mean(axis=(1, 2))
    assert 0.1 < seen[0] < 1.0
    assert seen[2] == 0.0
    assert photos.shape == rgb.shape == (*depth.shape, 3)
    toy = nerfbaselines.Toy(rgb, depth)
    np.testing.assert_array_equal(toy.render(None)["color"], rgb[0])
    np.testing.assert_array_equal(toy.render(None)["depth"], depth[1])
