"""What benchmarks/integrations/nerfstudio.py says where there is no nerfstudio."""

import importlib.util

import pytest

pytest.importorskip("torch")

from unghost_tests.benches import check_short, refusal

from benchmarks.integrations import nerfstudio


def test_short():
    check_short(nerfstudio, steps=12, rays=64)


@pytest.mark.skipif(importlib.util.find_spec("nerfstudio") is not None, reason="nerfstudio is installed")
def test_the_environment_is_named(monkeypatch, capsys):
    assert "make nerfstudio" in refusal(nerfstudio, monkeypatch, capsys)
