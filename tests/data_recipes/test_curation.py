import dataclasses
import shutil

import numpy as np
import pytest

from unghost.core import progress
from unghost.core.occupancy import FREE_LABEL, IGNORE_LABEL, SURFACE_LABEL
from unghost.core.shards.packing import dequantize_signed, pack_frame, unpack_frame, unpack_labels
from unghost.core.shards.storage import ARRAYS, read_shard
from unghost.data_recipes.curation import curate, damage, sample_pair
from unghost.data_recipes.recipe import Recipe, load_recipe
from unghost.data_recipes.solids.compose import sample_cube

RECIPE = Recipe(parts=(1, 3))


def arrays(folder):
    shard = read_shard(folder, verify=True)
    return {name: np.array(getattr(shard, name)) for name in ARRAYS}


@pytest.mark.slow
def test_same_bytes_for_one_and_two_workers(tmp_path):
    one = curate(RECIPE, tmp_path / "one", count=40, seed=3)
    two = curate(RECIPE, tmp_path / "two", count=40, seed=3, workers=2)
    for file in ("manifest.json", *(f"{name}.npy" for name in ARRAYS)):
        assert (one[0] / file).read_bytes() == (two[0] / file).read_bytes()


def test_shard_rows_are_the_single_samples(tmp_path):
    shard = read_shard(curate(RECIPE, tmp_path, count=12, seed=9)[0], verify=True)
    labels = unpack_labels(np.array(shard.labels))
    for index in (0, 5, 11):
        signed, expected, severity, fraction, group = sample_pair(RECIPE, index, seed=9)
        np.testing.assert_allclose(dequantize_signed(shard.inputs[index]), signed, atol=1 / 255 + 1e-6)
        np.testing.assert_array_equal(labels[index], expected)
        assert (shard.severity[index], shard.edge_fraction[index]) == (np.float32(severity), np.float32(fraction))
        assert shard.group[index] == group == index


def test_seeds_and_samples_differ():
    first = sample_pair(RECIPE, 0, seed=0)[0]
    assert not np.array_equal(first, sample_pair(RECIPE, 1, seed=0)[0])
    assert not np.array_equal(first, sample_pair(RECIPE, 0, seed=1)[0])


@pytest.mark.slow
def test_shares_of_clean_and_soft_inputs():
    pairs = [sample_pair(RECIPE, index, seed=1) for index in range(150)]
    untouched = [signed for signed, _, severity, _, _ in pairs if severity == 0]
    soft = [np.abs(signed).min() < 1 for signed, _, severity, _, _ in pairs if severity > 0]
    assert 0.03 < len(untouched) / 150 < 0.2
    assert 0.35 < np.mean(soft) < 0.65
    for signed, labels, severity, _, _ in pairs:
        if severity == 0:
            np.testing.assert_array_equal(signed, np.where(labels == SURFACE_LABEL, 1.0, -1.0))
        hard = np.abs(signed).min() == 1
        assert hard or not (labels == SURFACE_LABEL).any() or (labels == IGNORE_LABEL).any()
        assert not hard or not (labels == IGNORE_LABEL).any()
    assert any((labels == FREE_LABEL).all() for _, labels, _, _, _ in pairs)  # truly empty


def test_ignored_voxels_are_the_neighbours_of_a_soft_surface():
    recipe = dataclasses.replace(RECIPE, clean_share=0.0, soft_share=1.0)
    clean = np.zeros((32, 32, 32), dtype=bool)
    clean[10, 10, 10] = True
    wide = []
    for seed in range(20):
        _, labels, _ = damage(np.random.default_rng(seed), clean, recipe)
        reach = int(labels[9, 9, 9] == SURFACE_LABEL)  # soft_dilation is 1: no further dilation, or one
        expected = np.zeros_like(clean, dtype=np.uint8)
        expected[9 - reach : 12 + reach, 9 - reach : 12 + reach, 9 - reach : 12 + reach] = IGNORE_LABEL
        expected[10 - reach : 11 + reach, 10 - reach : 11 + reach, 10 - reach : 11 + reach] = SURFACE_LABEL
        np.testing.assert_array_equal(labels, expected)
        wide.append(reach)
    assert 0.2 < np.mean(wide) < 0.8


def test_empty_field_encodes_to_minus_one():
    empty = dataclasses.replace(RECIPE, empty_share=1.0, clean_share=1.0)
    signed, labels, _, _, _ = sample_pair(empty, 0, seed=0)
    assert (labels == FREE_LABEL).all()
    assert (signed == -1).all()


def test_finished_shards_are_skipped_and_missing_ones_made(tmp_path):
    folders = curate(RECIPE, tmp_path, count=20, seed=0, shard_length=8)
    assert [folder.name for folder in folders] == ["shard-00000", "shard-00001", "shard-00002"]
    assert [len(read_shard(folder)) for folder in folders] == [8, 8, 4]
    before = [arrays(folder) for folder in folders]
    stamps = [(folder / "manifest.json").stat().st_mtime_ns for folder in folders]
    shutil.rmtree(folders[1])
    assert curate(RECIPE, tmp_path, count=20, seed=0, shard_length=8) == folders
    for folder, wanted in zip(folders, before):
        for name, array in arrays(folder).items():
            np.testing.assert_array_equal(array, wanted[name])
    after = [(folder / "manifest.json").stat().st_mtime_ns for folder in folders]
    assert [a == b for a, b in zip(stamps, after)] == [True, False, True]


@pytest.mark.parametrize(
    ("name", "value"), [("count", 0), ("seed", -1), ("workers", 0), ("count", 2**31), ("shard_length", 0)]
)
def test_bad_numbers_are_named(tmp_path, name, value):
    with pytest.raises(ValueError, match=f"curate: {name} must be"):
        curate(RECIPE, tmp_path / "out", **{"count": 1, "seed": 0, "workers": 1, name: value})
    assert not (tmp_path / "out").exists()


def test_procedural_cubes_say_where_they_lay_and_are_nobodys(tmp_path):
    recipe = dataclasses.replace(RECIPE, empty_share=0.4)
    shard = read_shard(curate(recipe, tmp_path, count=12, seed=0)[0], verify=True)
    assert shard.source is shard.surroundings is shard.view_count is None
    assert "sources" not in shard.provenance
    assert shard.kind == "pairs"
    assert shard.provenance["licence"] == "generated"
    for index, (numbers, fraction) in enumerate(zip(shard.frames, shard.edge_fraction)):
        _, wanted, frame = sample_cube(np.random.default_rng([0, index]), recipe)
        np.testing.assert_array_equal(numbers, pack_frame(frame))
        assert fraction == np.float32(wanted)
    nowhere = np.isnan(shard.frames).all(axis=1)
    assert 0 < nowhere.sum() < 12


def test_exact_solids_come_by_tree_and_alone_as_together(tmp_path):
    pytest.importorskip("manifold3d")
    from unghost.data_recipes.solids import csg

    recipe = dataclasses.replace(load_recipe("csg"), cubes_per_mesh=3, clean_share=1.0, max_dilation=0, solid_share=0.0)
    shard = read_shard(curate(recipe, tmp_path, count=8, seed=0)[0], verify=True)
    assert shard.group.tolist() == [0, 0, 0, 1, 1, 1, 2, 2]
    assert shard.provenance["licence"] == "generated"
    for row in range(8):  # a cube can be cut again from its tree's number and its frame
        rng = np.random.default_rng([0, int(shard.group[row]), csg.STREAM])
        frame = unpack_frame(shard.frames[row])
        cut = csg.cut_cubes(csg.ClosedMesh.from_solid(csg.random_solid(rng)).mesh, [frame])[0]
        np.testing.assert_array_equal(unpack_labels(np.array(shard.labels[[row]]))[0] == SURFACE_LABEL, cut)
        assert shard.edge_fraction[row] == np.float32(frame.edge_length)
    for index in (2, 7):
        signed, labels, _, _, _ = sample_pair(recipe, index, seed=0)
        np.testing.assert_allclose(dequantize_signed(shard.inputs[index]), signed, atol=1 / 255 + 1e-6)
        np.testing.assert_array_equal(unpack_labels(np.array(shard.labels[index : index + 1]))[0], labels)


def test_progress_goes_to_stderr_and_silence_is_the_default(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(progress, "SECONDS_BETWEEN_LINES", 0.0)  # the work is quick
    curate(RECIPE, tmp_path / "quiet", count=2, seed=0)
    assert capsys.readouterr() == ("", "")
    curate(RECIPE, tmp_path / "loud", count=2, seed=0, progress=True)
    shown = capsys.readouterr()
    assert shown.out == ""
    assert "cube" in shown.err
