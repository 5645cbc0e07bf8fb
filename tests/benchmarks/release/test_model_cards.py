"""Parts of benchmarks/release/model_cards.py."""

import pytest

pytest.importorskip("torch")

from benchmarks.release import model_cards
from unghost.core.manifest import Manifest


def test_shares_add_up_and_the_first_run_comes_first():
    shards = [
        {"source": "a", "shards": 1, "cubes": 10, "weight": 3.0},
        {"source": "b", "shards": 2, "cubes": 5, "weight": 1.0},
    ]
    assert model_cards.sources(shards) == [["a", "1", "10", "0.75"], ["b", "2", "5", "0.25"]]
    last = {"steps": 3, "started_from": {"steps": 2, "started_from": {"steps": 1}}}
    assert [stage["steps"] for stage in model_cards.stages(last)] == [1, 2, 3]
    manifest = Manifest("m", training=last)
    assert [model_cards.run_folder(manifest, number) for number in range(3)] == ["out/m-0", "out/m-1", "out/m"]


def test_every_shipped_model_has_a_card_and_a_size():
    for name, path, manifest in model_cards.models():
        assert path.with_name(f"{name.upper()}.md").exists()
        assert model_cards.size_of(manifest) != "custom"
