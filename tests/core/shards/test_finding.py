import pytest

from unghost.core.shards.finding import expand_shards, find_shards
from unghost.core.shards.storage import write_shard


def test_shards_are_found_and_unfinished_ones_are_not(tmp_path, arrays):
    for name in ("s1", "s0"):
        write_shard(tmp_path / name, arrays(1), {})
    (tmp_path / "s2.partial").mkdir()
    (tmp_path / "s2.partial" / "manifest.json").write_text("{}", encoding="utf-8")
    assert find_shards(tmp_path) == [tmp_path / "s0", tmp_path / "s1"]
    assert find_shards(str(tmp_path / "s1")) == [tmp_path / "s1"]


def test_shards_of_a_folder_share_its_weight_by_length(tmp_path, arrays):
    for index, count in enumerate((1, 3)):
        write_shard(tmp_path / f"s{index}", arrays(count), {})
    (tmp_path / "s2.partial").mkdir()
    assert expand_shards(f"{tmp_path}=2") == [(tmp_path / "s0", 0.5), (tmp_path / "s1", 1.5)]
    assert expand_shards(str(tmp_path / "s1")) == [(tmp_path / "s1", 1.0)]


def test_a_folder_of_one_shard_has_the_whole_weight(tmp_path, arrays):
    write_shard(tmp_path / "s0", arrays(1), {})
    assert expand_shards(f"{tmp_path}=3") == expand_shards(f"{tmp_path / 's0'}=3") == [(tmp_path / "s0", 3.0)]


@pytest.mark.parametrize("weight", ["0", "-1", "inf", "nan"])
def test_impossible_weights_are_refused(weight):
    with pytest.raises(ValueError, match="must be finite and > 0"):
        expand_shards(f"x={weight}")


def test_refusals_name_what_was_given(tmp_path):
    with pytest.raises(ValueError, match=r"expand_shards: 'x=much' must be FOLDER or FOLDER=WEIGHT"):
        expand_shards("x=much")
    for find in (find_shards, expand_shards):
        with pytest.raises(ValueError, match=r"find_shards: .*absent is not a shard and holds none"):
            find(str(tmp_path / "absent"))
