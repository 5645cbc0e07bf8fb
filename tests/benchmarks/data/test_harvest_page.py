"""The sample of a harvest that docs hold: few cubes, of every kind of field."""

import dataclasses

import numpy as np
from unghost_tests.benches import refusal

from benchmarks.data import harvest_page
from benchmarks.options import SAMPLE
from unghost.core.shards.storage import read_shard


def scenes(*fields):
    """The stored sample as one shard a scene, its cubes rolled so that each scene has others."""
    stored = read_shard(SAMPLE)
    found = []
    for number, field in enumerate(fields):
        arrays = {
            each.name: np.roll(np.array(getattr(stored, each.name)), number, axis=0)
            for each in dataclasses.fields(stored)
            if isinstance(getattr(stored, each.name), np.ndarray)
        }
        told = {"seed": 0, "scene": number, "field": field, "resolution": 64, "steps": 9, "licence": "generated"}
        found.append(dataclasses.replace(stored, provenance=told, **arrays))
    return found


def test_kinds_of_fields_take_turns():
    order = [shard.provenance["scene"] for shard in harvest_page.alternating(scenes("a", "a", "a", "b", "a", "b"))]
    assert order == [0, 3, 1, 5, 2, 4]


def test_a_sample_has_one_cube_a_scene_and_every_kind(tmp_path, monkeypatch):
    monkeypatch.setattr(harvest_page, "SAMPLE_CUBES", 3)
    shards = scenes("dense", "dense", "dense", "hash")
    size = harvest_page.write_sample(shards, tmp_path / "sample")
    assert size == sum(path.stat().st_size for path in (tmp_path / "sample").iterdir())
    sample = read_shard(tmp_path / "sample", verify=True)
    assert [scene["scene"] for scene in sample.provenance["scenes"]] == [0, 1, 3]
    best = np.array(shards[0].inputs[harvest_page.interesting(shards[0])[0]])
    assert all((cube == best).all() for cube in sample.inputs)  # every scene has the same cubes, in another order
    harvest_page.write_sample(shards, tmp_path / "sample")  # replaces what is there
    assert len(read_shard(tmp_path / "sample")) == 3


def test_what_is_missing(monkeypatch, capsys):
    assert "needs HARVEST" in refusal(harvest_page, monkeypatch, capsys)
    assert "there is no nowhere" in refusal(harvest_page, monkeypatch, capsys, "nowhere")


def test_a_row_of_pictures(monkeypatch):
    monkeypatch.setattr(harvest_page, "WIDTH", 32)
    pictures = harvest_page.draw_row(read_shard(SAMPLE), 0)
    assert len(pictures) == len(harvest_page.HEADINGS)
    assert all(np.asarray(picture).shape == (harvest_page.WIDTH, harvest_page.WIDTH, 3) for picture in pictures)
