import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from unghost.core.occupancy import signed_from_occupancy
from unghost.core.shards.packing import pack_labels, quantize_signed
from unghost.core.shards.storage import write_shard
from unghost.data_recipes.corruptions.structured import CORRUPTIONS
from unghost.data_recipes.inspection.statistics import (
    AGREEMENT,
    FEATURES,
    cube_features,
    cube_statistics,
    feature_distances,
    sampling_floor,
    shard_statistics,
    statistics_distance,
    wasserstein,
)
from unghost.data_recipes.recipe import Recipe
from unghost.data_recipes.solids.compose import sample_cube

EMPTY, FULL = np.full((1, 32, 32, 32), -1.0), np.full((1, 32, 32, 32), 1.0)


def slab(thick, opacity=1.0, start=8):
    signed = np.full((32, 32, 32), -1.0)
    signed[start : start + thick] = 2 * opacity - 1
    return signed


def some_cubes(count, seed, kind=None, severity=0.8):
    cubes = []
    for index in range(count):
        rng = np.random.default_rng([seed, index])
        clean = sample_cube(rng, Recipe(empty_share=0.0))[0]
        cubes.append(clean if kind is None else CORRUPTIONS[kind](rng, clean, severity))
    return signed_from_occupancy(np.stack(cubes))


def test_features_of_a_slab_by_hand():
    """Two voxels of 32: 2048 voxels. Of the pairs that touch it, 2 * 1024 step by one; 1024 lie across its middle and
    2 * 2 * 32 * 31 along it, without a step: contrast 2048 / (2048 + 1024 + 3968)."""
    found = cube_features(slab(2))
    assert found["occupied_share"] == 2 / 32
    assert found["faint_share"] == 0
    assert found["thickness"] == pytest.approx(2)
    assert found["components"] == 1
    assert found["largest_share"] == 1
    assert found["contrast"] == pytest.approx(2048 / 7040)
    assert list(found) == list(FEATURES)


def test_faint_voxels_are_haze_and_not_occupied():
    found = cube_features(slab(3, 0.05))
    assert (found["occupied_share"], found["faint_share"]) == (0, pytest.approx(3 / 32))
    assert found["thickness"] == found["components"] == found["largest_share"] == found["contrast"] == 0


def test_pieces_are_counted_with_corners_touching():
    signed = np.full((32, 32, 32), -1.0)
    signed[3, 3, 3] = signed[4, 4, 4] = signed[10:12, 10, 10] = signed[20, 20, 20] = 1.0
    found = cube_features(signed)
    assert found["components"] == 3
    assert found["largest_share"] == 2 / 5


def test_agreement_by_hand():
    """Input: layers 8 to 11; surface: 10 to 15; ignored: 8. Judged: 9 is ghost, 10 and 11 are right, 12 to 15 lack."""
    labels = np.zeros((32, 32, 32), dtype=np.uint8)
    labels[10:16], labels[8] = 1, 2
    found = cube_features(slab(4), labels)
    assert found["iou"] == pytest.approx(2 / 7)
    assert found["ghost_share"] == pytest.approx(1 / 3)
    assert found["missing_share"] == pytest.approx(4 / 6)
    assert found["surface_share"] == pytest.approx(6 / 32)
    assert found["ignored_share"] == pytest.approx(1 / 32)


@pytest.mark.parametrize(
    ("shown", "true", "expected"),
    [(EMPTY, 0, (1, 0, 0)), (FULL, 1, (1, 0, 0)), (FULL, 0, (0, 1, 0)), (EMPTY, 1, (0, 0, 1)), (FULL, 2, (1, 0, 0))],
)
def test_agreement_of_empty_and_full_cubes(shown, true, expected):
    found = cube_features(shown[0], np.full((32, 32, 32), true, dtype=np.uint8))
    assert (found["iou"], found["ghost_share"], found["missing_share"]) == expected


def test_bytes_and_floats_give_the_same():
    signed = np.random.default_rng(0).uniform(-1, 1, size=(2, 32, 32, 32))
    labels = np.zeros(signed.shape, dtype=np.uint8)
    first, second = cube_statistics(signed, labels), cube_statistics(quantize_signed(signed), labels)
    assert list(first.features) == [*FEATURES, *AGREEMENT]
    for name, values in first.features.items():
        np.testing.assert_array_equal(values, second.features[name])
    np.testing.assert_array_equal(first.levels, second.levels)


def test_summary_is_json_and_the_histogram_is_of_all_voxels():
    found = cube_statistics(np.stack([slab(8), slab(8, 0.5), slab(8, 0.05), EMPTY[0]]))
    summary = json.loads(json.dumps(found.summary(), allow_nan=False))
    assert (summary["cubes"], summary["empty_share"]) == (4, 0.5)
    assert summary["occupied_share"] == {"mean": 0.125, "median": 0.125, "p10": 0.0, "p90": 0.25}
    # a slab of 8 layers is a quarter of its cube, a sixteenth of all four; opacity 0.5 is the sixth bin's
    expected = np.zeros(10)
    expected[[0, 5, 9]] = 14 / 16, 1 / 16, 1 / 16
    np.testing.assert_allclose(summary["opacity_histogram"], expected, atol=1e-5)
    assert cube_statistics(EMPTY[:0]).summary()["thickness"]["mean"] is None


def area_between(first, second, first_weights, second_weights):
    """The area between the distribution functions of two samples, summed over the steps of both."""
    points = np.sort(np.concatenate([first, second]))
    heights = [
        [weights[values <= point].sum() / weights.sum() for point in points]
        for values, weights in ((first, first_weights), (second, second_weights))
    ]
    return np.abs(np.subtract(*heights))[:-1] @ np.diff(points)


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**31), first=st.integers(1, 9), second=st.integers(1, 9), ties=st.booleans())
def test_wasserstein_is_the_area_between_the_distribution_functions(seed, first, second, ties):
    rng = np.random.default_rng(seed)
    a, b = (rng.integers(0, 3, n).astype(float) if ties else rng.normal(size=n) for n in (first, second))
    u, v = rng.random(first) + 0.01, rng.random(second) + 0.01
    assert wasserstein(a, b) == pytest.approx(area_between(a, b, np.ones(first), np.ones(second)), abs=1e-12)
    assert wasserstein(a, b, u, v) == pytest.approx(area_between(a, b, u, v), abs=1e-12)
    assert wasserstein(b, a, v, u) == pytest.approx(wasserstein(a, b, u, v), abs=1e-12)


def test_wasserstein_of_a_shift_is_the_shift():
    assert wasserstein([0, 1, 2], [0.5, 1.5, 2.5]) == pytest.approx(0.5)
    with pytest.raises(ValueError, match="each sample must have some weight"):
        wasserstein([], [1.0])
    with pytest.raises(ValueError, match="each sample must have some weight, got 2 values"):
        wasserstein([1.0], [1.0, 2.0], None, [0.0, 0.0])


def test_distance_by_hand():
    """One cube each, slabs of 1 and 3: the parts are differences of g_f, and opacity is 1 in both."""
    parts = feature_distances(cube_statistics(slab(1)[None]), cube_statistics(slab(3)[None]))
    assert parts["occupied_share"] == pytest.approx(np.sqrt(3 / 32) - np.sqrt(1 / 32))
    assert parts["thickness"] == pytest.approx((np.log2(4) - np.log2(2)) / np.log2(33))
    assert parts["components"] == parts["largest_share"] == parts["faint_share"] == parts["opacity"] == 0
    # one layer: 2048 steps of 2048 + 1984 pairs; three: of 2048 + 2048 + 3 * 1984
    assert parts["contrast"] == pytest.approx(2048 / 4032 - 2048 / 10048)
    whole = statistics_distance(cube_statistics(slab(1)[None]), cube_statistics(slab(3)[None]))
    assert whole == pytest.approx(sum(parts.values()) / 7)


def test_opacity_is_compared_over_occupied_voxels():
    one, half, nothing = (cube_statistics(cube[None]) for cube in (slab(4), slab(4, 128 / 255), EMPTY[0]))
    assert feature_distances(one, half)["opacity"] == pytest.approx(127 / 255)
    assert feature_distances(one, nothing)["opacity"] == 1
    assert feature_distances(nothing, nothing)["opacity"] == 0


@pytest.mark.slow
def test_distance_is_a_metric_on_real_cubes():
    sets = [cube_statistics(some_cubes(12, 0, kind)) for kind in (None, "fog_volumes", "salt")]
    table = np.array([[statistics_distance(a, b) for b in sets] for a in sets])
    np.testing.assert_allclose(np.diag(table), 0, atol=1e-12)
    np.testing.assert_allclose(table, table.T)
    assert (table[~np.eye(3, dtype=bool)] > 0.02).all()
    assert (table <= 1).all()
    for i, j, k in np.ndindex(3, 3, 3):
        assert table[i, k] <= table[i, j] + table[j, k] + 1e-12


@pytest.mark.slow
def test_more_fog_is_further_away():
    clean = cube_statistics(some_cubes(16, 1))
    near, far = (cube_statistics(some_cubes(16, 1, "fog_volumes", severity)) for severity in (0.1, 1.0))
    assert statistics_distance(clean, near) < statistics_distance(clean, far)


@pytest.mark.slow
def test_the_floor_is_below_the_distance_to_other_cubes():
    clean, foggy = cube_statistics(some_cubes(24, 2)), cube_statistics(some_cubes(24, 2, "blocks", 1.0))
    floor = sampling_floor(clean)
    assert 0 < floor < statistics_distance(clean, foggy)
    assert floor == sampling_floor(clean)
    assert sampling_floor(cube_statistics(np.repeat(FULL, 4, axis=0))) == pytest.approx(0, abs=1e-12)
    with pytest.raises(ValueError, match="at least two cubes, got 1"):
        sampling_floor(cube_statistics(FULL))


def stored(folder, signed, labels):
    count = len(signed)
    write_shard(
        folder,
        {
            "inputs": quantize_signed(signed),
            "labels": pack_labels(labels),
            "severity": np.zeros(count, dtype=np.float32),
            "edge_fraction": np.full(count, 0.1, dtype=np.float32),
            "group": np.zeros(count, dtype=np.int32),
        },
        {},
    )
    return folder


def test_shards_are_measured_as_one_set(tmp_path):
    signed = np.stack([slab(thick) for thick in (1, 2, 3, 4, 5)])
    labels = (signed > 0).astype(np.uint8)
    folders = [stored(tmp_path / "a", signed[:2], labels[:2]), stored(tmp_path / "b", signed[2:], labels[2:])]
    whole = shard_statistics(folders)
    np.testing.assert_allclose(whole.features["thickness"], [1, 2, 3, 4, 5])
    np.testing.assert_array_equal(whole.features["iou"], 1)
    some = shard_statistics(folders, most=3, seed=4)
    assert len(some) == 3
    np.testing.assert_array_equal(
        some.features["thickness"], shard_statistics(folders, most=3, seed=4).features["thickness"]
    )
    assert set(np.round(some.features["thickness"])) <= {1, 2, 3, 4, 5}
    chosen = whole.select([0, 4])
    np.testing.assert_allclose(chosen.features["thickness"], [1, 5])
    assert chosen.levels.sum() == 2 * 32**3


def test_bad_arguments_are_named(tmp_path):
    with pytest.raises(ValueError, match=r"inputs must have shape \(N, 32, 32, 32\), got \(32, 32, 32\)"):
        cube_statistics(FULL[0])
    with pytest.raises(ValueError, match="labels must have the shape of inputs"):
        cube_statistics(FULL, np.zeros((2, 32, 32, 32), dtype=np.uint8))
    for wrong in (2.0, np.nan):
        with pytest.raises(ValueError, match=r"inputs must lie in \[-1, 1\]"):
            cube_statistics(FULL * wrong)
    with pytest.raises(ValueError, match="at least one shard"):
        shard_statistics([])
    with pytest.raises(ValueError, match="both sets need cubes, got 0 and 1"):
        feature_distances(cube_statistics(FULL[:0]), cube_statistics(FULL))
