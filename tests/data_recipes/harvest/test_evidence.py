from dataclasses import replace

import numpy as np
import pytest

from unghost.core.occupancy import FREE_LABEL, SURFACE_LABEL
from unghost.core.shards.packing import dequantize_share, unpack_labels
from unghost.core.shards.storage import ARRAYS, read_shard, write_shard
from unghost.data_recipes.harvest.config import HarvestConfig
from unghost.data_recipes.harvest.evidence import replace_evidence
from unghost.data_recipes.harvest.run import harvest, room_scene
from unghost.scenes.sparse_points import MatchingConfig

pytest.importorskip("torch")

SMALL = HarvestConfig(
    resolutions=(24, 32),
    photos=(6, 7),
    photo_width=(24, 28),
    observer_photos=4,
    observer_width=32,
    steps=(10, 14),
    rays=48,
    cubes=11,
    point_sets=2,
    fewest_opaque=0.0,
    most_ghosts=1.0,
)


@pytest.fixture(scope="module")
def harvested(tmp_path_factory):
    folder = tmp_path_factory.mktemp("harvest")
    assert harvest(folder, scenes=1, seed=3, first=5, config=SMALL) == 22
    return folder


@pytest.mark.slow
def test_evidence_is_stored_and_says_something(harvested):
    shard = read_shard(harvested / "scene-00005", verify=True)
    for stored in (shard.support, shard.crossings):
        share = dequantize_share(stored)
        assert 0 < (share > 0).mean() < 1
        assert share.max() > 0.3
    distance = np.linalg.norm(shard.frames[:, :3], axis=1)
    assert not shard.crossings[distance > 4].any()  # nothing is known beyond the box


@pytest.mark.slow
def test_the_same_points_without_a_field(harvested, tmp_path):
    """What the harvest stored follows from seed and number alone; other points change nothing else."""
    original = read_shard(harvested / "scene-00005")
    lines = []
    assert replace_evidence(harvested, tmp_path / "same", sets=2, log=lines.append) == 1
    assert lines[0].startswith("scene-00005: ")
    same = read_shard(tmp_path / "same" / "scene-00005", verify=True)
    few = MatchingConfig(points=(8, 9))
    assert replace_evidence(harvested, tmp_path / "few", sets=1, matching=few) == 1
    other = read_shard(tmp_path / "few" / "scene-00005", verify=True)
    for name in ("support", "crossings"):
        np.testing.assert_array_equal(getattr(same, name), getattr(original, name))
        assert (getattr(other, name) > 0).sum() < (getattr(original, name) > 0).sum()
    for name in (*ARRAYS, "surroundings", "view_count", "frames"):
        np.testing.assert_array_equal(getattr(other, name), getattr(original, name))
    assert max(other.provenance["points"]) <= 10
    assert len(other.provenance["points"]) == 2  # a set for each snapshot
    assert replace_evidence(harvested, tmp_path / "few", sets=1, matching=few) == 1  # there already


@pytest.mark.slow
def test_a_harvest_can_do_without(tmp_path):
    harvest(tmp_path, scenes=1, seed=3, first=5, config=replace(SMALL, point_sets=0, cubes=2))
    shard = read_shard(tmp_path / "scene-00005")
    assert shard.support is None
    assert shard.crossings is None


@pytest.mark.slow
def test_shards_that_cannot_be_copied_are_refused(harvested, tmp_path):
    with pytest.raises(ValueError, match="sets must be >= 1, got 0"):
        replace_evidence(harvested, tmp_path / "a", sets=0)
    shard = read_shard(harvested / "scene-00005")
    arrays = {name: np.asarray(getattr(shard, name)) for name in (*ARRAYS, "frames")}
    for changes, message in (
        ({"recipe": "rooms"}, "must be a harvested shard with frames"),
        ({"meshes": [{"path": "a.glb"}]}, "mesh_root must be given"),
    ):
        folder = tmp_path / message.split()[0]
        write_shard(folder / "s", arrays, {**shard.provenance, **changes}, kind="harvest")
        with pytest.raises(ValueError, match=message):
            replace_evidence(folder, tmp_path / "b")


@pytest.mark.slow
def test_rooms_without_a_field_have_evidence_too():
    """The cubes are those of a room without it; support lies on surfaces, crossings in the air."""
    config = replace(SMALL, cubes=40, photos=(12, 14), photo_width=(40, 48), room_pitch=(0.02, 0.05))
    arrays, _ = room_scene(1000, 5, config)
    plain, _ = room_scene(1000, 5, replace(config, point_sets=0))
    assert "support" not in plain
    for name in ("inputs", "labels", "frames"):
        np.testing.assert_array_equal(arrays[name], plain[name])
    labels = unpack_labels(arrays["labels"])
    support, crossings = arrays["support"] > 0, arrays["crossings"] > 0
    assert support[labels == SURFACE_LABEL].mean() > 2 * support[labels == FREE_LABEL].mean()
    assert crossings[labels == FREE_LABEL].mean() > 2 * crossings[labels == SURFACE_LABEL].mean()
    assert arrays["view_count"].max() >= 5
