import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from unghost.core.channels import (
    CHANNEL_NAMES,
    UNKNOWN,
    encode_share,
    encode_surroundings,
    encode_view_count,
    full_channel,
)
from unghost.core.shards.packing import dequantize_signed, unpack_labels
from unghost.core.shards.storage import read_shard, write_shard
from unghost.prior.training.batches import (
    ANY_EDGE,
    BLIND_SEVERITY,
    DEPTH_JITTER,
    FINER,
    SYMMETRIES,
    Mixture,
    apply_symmetry,
    scale_depth,
    stored_channels,
)


def test_symmetries_are_the_48_of_the_cube():
    grid = np.arange(27).reshape(3, 3, 3)
    images = {apply_symmetry(grid, index).tobytes() for index in range(len(SYMMETRIES))}
    assert len(images) == 48
    assert np.array_equal(apply_symmetry(grid, 0), grid)


def test_symmetries_keep_the_distance_to_the_centre():
    axis = np.arange(4) - 1.5
    radius = axis[:, None, None] ** 2 + axis[:, None] ** 2 + axis**2
    for index in range(48):
        assert np.array_equal(apply_symmetry(radius, index), radius)


def test_input_and_label_move_together(shard_paths):
    """The clean cubes' inputs are their labels, whatever the symmetry."""
    batch = Mixture([(shard_paths["a"], 1.0)], seed=0).batch(0, 40)
    occupied = batch.channels[:, 0] > 0
    clean = [index for index in range(40) if np.array_equal(np.unique(batch.channels[index]), [-1.0, 1.0])]
    assert len(clean) >= 3
    for index in clean:
        assert np.array_equal(occupied[index], batch.labels[index] == 1)


def test_types_shapes_and_range_of_timesteps(shard_paths):
    batch = Mixture([(shard_paths["a"], 1.0), (shard_paths["b"], 1.0)], seed=0).batch(5, 4)
    assert batch.channels.shape == (4, 1, 32, 32, 32)
    assert batch.channels.dtype == np.float32
    assert batch.labels.shape == (4, 32, 32, 32)
    assert batch.labels.dtype == np.uint8
    assert batch.timestep.dtype == np.int64
    assert batch.edge_fraction.dtype == np.float32


def test_a_sample_depends_on_seed_and_index_alone(shard_paths):
    shards = [(shard_paths["a"], 1.0), (shard_paths["b"], 2.0)]
    mixture, other = Mixture(shards, seed=1), Mixture(shards, seed=2)
    large, small = mixture.batch(0, 6), mixture.batch(2, 2)  # samples 0..5 and 4..5
    assert np.array_equal(large.channels[4:], small.channels)
    assert np.array_equal(large.labels[4:], small.labels)
    assert np.array_equal(large.timestep[4:], small.timestep)
    assert not np.array_equal(other.batch(0, 6).timestep, large.timestep)


def test_stream_equals_random_access_and_starts_anywhere(shard_paths):
    mixture = Mixture([(shard_paths["a"], 1.0)], seed=4)
    stream = mixture.stream(3, 2)
    for step in (3, 4, 5):
        assert np.array_equal(next(stream).channels, mixture.batch(step, 2).channels)
    stream.close()


def test_timesteps_lie_between_severity_and_the_end(shard_paths):
    shard = read_shard(shard_paths["a"])
    mixture = Mixture([(shard_paths["a"], 1.0)], seed=0)
    times = {index: [] for index in range(len(shard))}
    for index in range(400):
        cube = mixture._draw(index).cube
        times[cube].append(int(mixture.batch(index, 1).timestep[0]))
    for cube, drawn in times.items():
        assert min(drawn) >= np.rint(999 * min(shard.severity[cube], BLIND_SEVERITY))
        assert max(drawn) <= 999
    assert min(times[0]) < 200  # severity 0: seen at every timestep
    assert max(times[0]) > 800


def test_weights_of_the_mixture(shard_paths):
    mixture = Mixture([(shard_paths["a"], 1.0), (shard_paths["b"], 3.0)], seed=0)
    share = np.mean([mixture._draw(index).shard is mixture.shards[1] for index in range(2000)])
    assert share == pytest.approx(0.75, abs=0.04)


def test_values_come_from_the_shard(shard_paths):
    shard = read_shard(shard_paths["b"])
    mixture = Mixture([(shard_paths["b"], 1.0)], seed=0)
    cube, symmetry = mixture._draw(9).cube, mixture._draw(9).symmetry
    batch = mixture.batch(9, 1)
    assert np.array_equal(batch.channels[0, 0], apply_symmetry(dequantize_signed(shard.inputs[cube]), symmetry))
    assert np.array_equal(batch.labels[0], apply_symmetry(unpack_labels(shard.labels[cube : cube + 1])[0], symmetry))
    as_it_is = Mixture([(shard_paths["b"], 1.0)], seed=0, redraw_edges=False).batch(9, 1)
    assert as_it_is.edge_fraction[0] == shard.edge_fraction[cube]
    np.testing.assert_array_equal(as_it_is.channels, batch.channels)


def test_edge_fractions_do_not_tell_curated_cubes_from_harvested_ones(shard_paths):
    curated = Mixture([(shard_paths["b"], 1.0)], seed=0)
    logs = np.log([curated._draw(index).edge_fraction for index in range(2000)])
    low, high = np.log(ANY_EDGE)
    assert logs.min() >= low
    assert logs.max() <= high
    quantiles = np.quantile(logs, [0.25, 0.5, 0.75])
    np.testing.assert_allclose(quantiles, low + (high - low) * np.array([0.25, 0.5, 0.75]), atol=0.25)
    harvested, shard = Mixture([(shard_paths["seen"], 1.0)], seed=0), read_shard(shard_paths["seen"])
    draws = [harvested._draw(index) for index in range(500)]
    divided = np.array([shard.edge_fraction[draw.cube] / draw.edge_fraction for draw in draws])
    assert 0.999 < divided.min() < 1.1
    assert 0.9 * FINER < divided.max() < 1.001 * FINER


def test_scaled_depth_is_that_of_a_scaled_density():
    depth = np.array([0.0, 0.1, 1.0, 3.0])
    signed = (1.0 - 2.0 * np.exp(-depth)).astype(np.float32)
    for factor in (0.5, 1.0, 2.0):
        np.testing.assert_allclose(scale_depth(signed, factor), 1.0 - 2.0 * np.exp(-factor * depth), atol=1e-6)
    assert scale_depth(np.array([-1.0, 1.0], dtype=np.float32), 0.6).tolist() == [-1.0, 1.0]


def test_harvested_cubes_alone_get_another_depth(shard_paths, tmp_path):
    arrays = {
        "inputs": np.full((2, 32, 32, 32), 64, dtype=np.uint8),  # opacity .25
        "labels": np.zeros((2, 8192), dtype=np.uint8),
        "severity": np.zeros(2, dtype=np.float32),
        "edge_fraction": np.full(2, 0.1, dtype=np.float32),
        "group": np.zeros(2, dtype=np.int32),
    }
    for recipe, kind in (("harvest", "harvest"), ("rooms", "pairs")):
        write_shard(tmp_path / recipe, arrays, {"recipe": recipe}, kind=kind)
    fitted, rooms = (
        Mixture([(tmp_path / name, 1.0)], seed=0).batch(0, 40).channels[:, 0, 0, 0, 0] for name in ("harvest", "rooms")
    )
    assert np.unique(rooms).tolist() == pytest.approx([64 / 127.5 - 1])
    factors = np.log((1 - fitted) / 2) / np.log((1 - rooms) / 2)
    assert len(np.unique(factors)) == 40
    assert np.abs(np.log(factors)).max() <= DEPTH_JITTER + 1e-6
    assert np.log(factors).min() < -0.5 * DEPTH_JITTER < 0.5 * DEPTH_JITTER < np.log(factors).max()


def test_harvested_cubes_are_marked(shard_paths, tmp_path):
    shard = read_shard(shard_paths["a"])
    names = ("inputs", "labels", "severity", "edge_fraction", "group")
    arrays = {name: np.array(getattr(shard, name)) for name in names}
    write_shard(tmp_path / "fitted", arrays, {"recipe": "by hand"}, kind="harvest")
    assert Mixture([(tmp_path / "fitted", 1.0)], seed=0).batch(0, 4).harvested.tolist() == [True] * 4
    assert Mixture([(shard_paths["a"], 1.0)], seed=0).batch(0, 4).harvested.tolist() == [False] * 4
    write_shard(tmp_path / "named", arrays, {"recipe": "harvest"}, kind="pairs")  # the recipe is free text
    assert Mixture([(tmp_path / "named", 1.0)], seed=0).batch(0, 4).harvested.tolist() == [False] * 4


def test_errors(shard_paths, tmp_path):
    with pytest.raises(ValueError, match="at least one"):
        Mixture([], seed=0)
    with pytest.raises(ValueError, match="weights must be finite and > 0"):
        Mixture([(shard_paths["a"], 0.0)], seed=0)
    shard = read_shard(shard_paths["a"])
    names = ("inputs", "labels", "severity", "edge_fraction", "group")
    write_shard(tmp_path / "none", {name: getattr(shard, name)[:0] for name in names}, {})
    with pytest.raises(ValueError, match="holds no cubes"):
        Mixture([(tmp_path / "none", 1.0)], seed=0)


@settings(max_examples=48, deadline=None)
@given(st.integers(0, 47), st.integers(0, 2**32 - 1))
def test_symmetries_turn_all_grids_alike(symmetry, seed):
    """A symmetry commutes with what joins the grids: pooling the fine one, repeating the coarse one."""
    rng = np.random.default_rng(seed)
    fine, coarse = rng.normal(size=(8, 8, 8)), rng.normal(size=(16, 16, 16)).astype(np.float32)
    pooled = fine.reshape(4, 2, 4, 2, 4, 2).mean(axis=(1, 3, 5))
    turned = apply_symmetry(fine, symmetry).reshape(4, 2, 4, 2, 4, 2).mean(axis=(1, 3, 5))
    np.testing.assert_allclose(apply_symmetry(pooled, symmetry), turned, rtol=1e-12)
    assert np.array_equal(
        full_channel(apply_symmetry(coarse, symmetry)), apply_symmetry(full_channel(coarse), symmetry)
    )


def test_all_channels_and_the_labels_move_together(shard_paths):
    """Each sample equals its stored cube under one symmetry, applied to everything."""
    shard = read_shard(shard_paths["seen"])
    mixture = Mixture([(shard_paths["seen"], 1.0)], seed=2, channels=CHANNEL_NAMES)
    batch, seen = mixture.batch(0, 30), set()
    for row in range(30):
        draw = mixture._draw(row)
        seen.add(draw.symmetry)
        coarse = scale_depth(dequantize_signed(shard.surroundings[draw.cube]), draw.depth)
        expected = [
            scale_depth(dequantize_signed(shard.inputs[draw.cube]), draw.depth),
            full_channel(encode_surroundings(coarse)),
            encode_view_count(shard.view_count[draw.cube]),
            full_channel(encode_share((shard.transmittance[draw.cube] / np.float32(255)) ** draw.depth)),
            encode_share(shard.support[draw.cube] / np.float32(255)),  # evidence does not depend on the depth
            encode_share(shard.crossings[draw.cube] / np.float32(255)),
        ]
        assert len(expected) == len(CHANNEL_NAMES)
        for found, grid in zip(batch.channels[row], expected):
            np.testing.assert_allclose(found, apply_symmetry(grid, draw.symmetry), atol=1e-6)
        labels = unpack_labels(shard.labels[draw.cube : draw.cube + 1])[0]
        np.testing.assert_array_equal(batch.labels[row], apply_symmetry(labels, draw.symmetry))
    assert len(seen) > 15


@pytest.mark.slow
def test_optional_channels_are_dropped_one_by_one(shard_paths):
    mixture = Mixture([(shard_paths["seen"], 1.0)], seed=0, channels=CHANNEL_NAMES, drop_channels=0.3)
    gone = (mixture.batch(0, 300).channels == UNKNOWN).all(axis=(2, 3, 4))
    assert not gone[:, 0].any()
    np.testing.assert_allclose(gone[:, 1:5].mean(axis=0), 0.3, atol=0.08)
    support, crossings = gone[:, CHANNEL_NAMES.index("support")], gone[:, CHANNEL_NAMES.index("crossings")]
    assert not (support & ~crossings).any()  # without points there are no lines; without tracks there are points
    assert crossings.mean() == pytest.approx(1 - 0.7 * 0.7, abs=0.08)
    assert (gone[:, 1] & gone[:, 2]).mean() == pytest.approx(0.09, abs=0.05)
    whole = Mixture([(shard_paths["seen"], 1.0)], seed=0, channels=CHANNEL_NAMES).batch(0, 300)
    assert not (whole.channels[:, 1:] == UNKNOWN).any()
    kept = ~gone[:, 2]
    assert np.array_equal(mixture.batch(0, 300).channels[kept, 2], whole.channels[kept, 2])  # all else stays


def test_what_a_shard_does_not_store_is_unknown(shard_paths):
    names = ("signed_opacity", "view_count", "surroundings")
    batch = Mixture([(shard_paths["a"], 1.0), (shard_paths["seen"], 1.0)], seed=0, channels=names).batch(0, 40)
    known = ~(batch.channels[:, 1:] == UNKNOWN).any(axis=(2, 3, 4))
    assert np.array_equal(known[:, 0], batch.harvested)
    assert np.array_equal(known[:, 1], batch.harvested)
    assert 10 < batch.harvested.sum() < 30


def test_further_channels_change_no_other_draw(shard_paths):
    """The samples of a seed are the same ones whatever the network sees of them."""
    shards = [(shard_paths["a"], 1.0), (shard_paths["seen"], 1.0)]
    one = Mixture(shards, seed=7).batch(2, 8)
    all_ = Mixture(shards, seed=7, channels=CHANNEL_NAMES, drop_channels=0.5).batch(2, 8)
    assert np.array_equal(one.channels[:, 0], all_.channels[:, 0])
    for name in ("labels", "timestep", "edge_fraction", "harvested"):
        assert np.array_equal(getattr(one, name), getattr(all_, name))


def test_stored_channels(shard_paths):
    shard, index = read_shard(shard_paths["seen"]), np.array([4, 0])
    found = stored_channels(shard, index, CHANNEL_NAMES)
    assert found.shape == (2, len(CHANNEL_NAMES), 32, 32, 32)
    np.testing.assert_array_equal(found[:, 2], encode_view_count(shard.view_count[index]))
    blind = stored_channels(shard, index, CHANNEL_NAMES, without=("view_count",))
    np.testing.assert_array_equal(blind[:, :2], found[:, :2])
    assert (blind[:, 2] == UNKNOWN).all()


def test_bad_channels_are_refused(shard_paths):
    with pytest.raises(ValueError, match="Mixture: channels must start with"):
        Mixture([(shard_paths["a"], 1.0)], seed=0, channels=("view_count",))
    with pytest.raises(ValueError, match="Mixture: drop_channels must lie in"):
        Mixture([(shard_paths["a"], 1.0)], seed=0, drop_channels=1.5)
