import dataclasses
import multiprocessing
import os
import signal
from contextlib import closing

import numpy as np
import pytest

from unghost.core.shards.packing import dequantize_signed, unpack_labels
from unghost.core.shards.storage import read_shard
from unghost.data_recipes.curation import SampleError, curate
from unghost.data_recipes.online import OnlinePairs, PairBatch
from unghost.data_recipes.recipe import Recipe, load_recipe

RECIPE = Recipe(parts=(1, 2))


def take(pairs, count, *, first_step=0, batch_size=6):
    with closing(pairs.stream(first_step, batch_size)) as stream:
        return [next(stream) for _ in range(count)]


def assert_equal(one, two):
    for field in dataclasses.fields(PairBatch):
        np.testing.assert_array_equal(getattr(one, field.name), getattr(two, field.name))


def test_shapes_types_and_ranges():
    batch = OnlinePairs(RECIPE, seed=1).batch(2, 5)
    assert (len(batch), batch.first) == (5, 10)
    assert (batch.channels.shape, batch.channels.dtype) == ((5, 1, 32, 32, 32), np.float32)
    assert (batch.labels.shape, batch.labels.dtype) == ((5, 32, 32, 32), np.uint8)
    for name, dtype in (("severity", np.float32), ("edge_fraction", np.float32), ("group", np.int32)):
        assert (getattr(batch, name).shape, getattr(batch, name).dtype) == ((5,), dtype)
    assert np.abs(batch.channels).max() <= 1
    assert set(np.unique(batch.labels)) <= {0, 1, 2}
    assert ((batch.severity >= 0) & (batch.severity <= 1)).all()
    assert ((batch.edge_fraction >= 0.01) & (batch.edge_fraction <= 0.2)).all()


def test_a_stream_is_what_a_shard_would_hold(tmp_path):
    shard = read_shard(curate(RECIPE, tmp_path, count=12, seed=4)[0])
    batches = take(OnlinePairs(RECIPE, seed=4), 3, batch_size=4)
    assert [batch.first for batch in batches] == [0, 4, 8]
    channels = np.concatenate([batch.channels for batch in batches])
    np.testing.assert_array_equal(channels[:, 0], dequantize_signed(np.array(shard.inputs)))
    labels = np.concatenate([batch.labels for batch in batches])
    np.testing.assert_array_equal(labels, unpack_labels(np.array(shard.labels)))
    for name in ("severity", "edge_fraction", "group"):
        np.testing.assert_array_equal(np.concatenate([getattr(b, name) for b in batches]), getattr(shard, name))


@pytest.mark.slow
def test_the_same_for_any_workers_and_any_start():
    one = take(OnlinePairs(RECIPE, seed=2), 6)
    for batch, other in zip(one, take(OnlinePairs(RECIPE, seed=2, workers=2), 6)):
        assert_equal(batch, other)
    for batch, other in zip(one[4:], take(OnlinePairs(RECIPE, seed=2), 2, first_step=4)):
        assert_equal(batch, other)
    for step, batch in enumerate(one):
        assert_equal(batch, OnlinePairs(RECIPE, seed=2).batch(step, 6))
    assert not np.array_equal(one[0].channels, OnlinePairs(RECIPE, seed=3).batch(0, 6).channels)


def test_closing_ends_the_workers_and_nothing_is_written(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    stream = OnlinePairs(RECIPE, seed=0, workers=2).stream(0, 4)
    assert multiprocessing.active_children() == []  # nothing starts before the first batch is asked for
    next(stream)
    assert len(multiprocessing.active_children()) == 2
    stream.close()
    assert multiprocessing.active_children() == []
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_killed_worker_changes_nothing():
    expected = take(OnlinePairs(RECIPE, seed=7), 8)
    with closing(OnlinePairs(RECIPE, seed=7, workers=2).stream(0, 6)) as stream:
        found = [next(stream) for _ in range(2)]
        os.kill(multiprocessing.active_children()[0].pid, signal.SIGKILL)
        found += [next(stream) for _ in range(6)]
    for batch, other in zip(expected, found):
        assert_equal(batch, other)


@pytest.fixture
def mesh_root(tmp_path):
    """A folder of one sound mesh."""
    trimesh = pytest.importorskip("trimesh")
    trimesh.creation.icosphere(subdivisions=1).export(tmp_path / "ball.ply")
    (tmp_path / "manifest.csv").write_text("path,split,licence\nball.ply,train,CC0-1.0\n", encoding="utf-8")
    return tmp_path


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 2])
def test_an_error_in_a_worker_names_the_sample(mesh_root, workers):
    recipe = dataclasses.replace(load_recipe("meshes"), cubes_per_mesh=4)
    pairs = OnlinePairs(recipe, seed=0, workers=workers, mesh_root=mesh_root)
    (mesh_root / "ball.ply").write_bytes(b"ply\nrubbish\n")
    with (
        closing(pairs.stream(3, 4)) as stream,
        pytest.raises(SampleError, match=r"sample 12 of seed 0: curate: none of .*ball\.ply"),
    ):
        next(stream)
    assert multiprocessing.active_children() == []


@pytest.mark.slow
def test_mesh_recipes_run_online(mesh_root):
    recipe = dataclasses.replace(load_recipe("meshes"), cubes_per_mesh=4)
    (batch,) = take(OnlinePairs(recipe, seed=0, workers=2, mesh_root=mesh_root), 1, batch_size=8)
    assert (batch.group == 0).all()
    assert (batch.labels == 1).any(axis=(1, 2, 3)).mean() > 0.5


def test_bad_arguments_are_named(tmp_path):
    for change, message in (({"seed": -1}, "seed must be >= 0, got -1"), ({"workers": 0}, "workers must be >= 1")):
        with pytest.raises(ValueError, match=message):
            OnlinePairs(RECIPE, **{"seed": 0, **change})
    with pytest.raises(ValueError, match="mesh_root must name their folder"):
        OnlinePairs(load_recipe("meshes"), seed=0)
    with pytest.raises(FileNotFoundError, match=r"manifest\.csv is not a file"):
        OnlinePairs(load_recipe("meshes"), seed=0, mesh_root=tmp_path)
    pairs = OnlinePairs(RECIPE, seed=0)
    for call in (lambda: pairs.batch(-1, 2), lambda: pairs.batch(0, 0), lambda: pairs.stream(0, 0)):
        with pytest.raises(ValueError, match="step must be >= 0 and batch_size >= 1"):
            call()
    with pytest.raises(ValueError, match="ahead must be >= 1, got 0"):
        pairs.stream(0, 2, ahead=0)
