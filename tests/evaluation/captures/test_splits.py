import json

import numpy as np
import pytest

from unghost.evaluation.captures.splits import by_name, resolve_splits


def _resolve(tmp_path, names, *, meta=None, given=None, dropped=()):
    found = resolve_splits(names, meta=meta or {}, folder=tmp_path, given=given, dropped=dropped)
    assert all(indices.dtype == np.int64 for indices in found.values())
    return {name: indices.tolist() for name, indices in found.items()}


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["frame_00001.png", "frame_1_00001.png", "frame_00002.png"], {"train": [0, 2], "eval": [1]}),
        (["images/frame_00001.png", "images/frame_1_00007.jpg"], {"train": [0], "eval": [1]}),
        (["frame_00001.png", "frame_1_00001.png", "cover.png"], {"train": [0], "eval": [1]}),  # as before
        (["frame_00001.png", "frame_00002.png"], {}),
        (["images/train_1.png", "images/eval_1.png", "images/x_train.png"], {"train": [0, 2], "eval": [1]}),
        (["images/train_1.png", "images/eval_1.png", "images/other.png"], {}),
        (["images/a/1.png", "images/b/1.png", "images/a/2.png"], {"a": [0, 2], "b": [1]}),
        (["a/1.png", "1.png"], {}),
        (["images/1.png", "images/2.png"], {}),
    ],
)
def test_names_alone(tmp_path, names, expected):
    assert _resolve(tmp_path, names) == expected


def test_a_given_list_beats_a_file_beats_nerfstudios_lists_beats_names(tmp_path):
    names = ["frame_00001.png", "frame_1_00001.png"]
    assert set(by_name(names)) == {"train", "eval"}
    meta = {"train_filenames": names[:1], "val_filenames": names[1:], "test_filenames": names[1:]}
    assert _resolve(tmp_path, names, meta=meta) == {"train": [0], "val": [1], "test": [1]}
    (tmp_path / "splits.json").write_text(json.dumps({"note": "text", "one": names}))
    assert _resolve(tmp_path, names, meta=meta) == {"one": [0, 1]}
    given = {"two": ["./frame_1_00001.png"]}
    assert _resolve(tmp_path, names, meta=meta, given=given) == {"two": [1]}
    (tmp_path / "other.json").write_text(json.dumps(given))
    for path in (tmp_path / "other.json", str(tmp_path / "other.json")):
        assert _resolve(tmp_path, names, meta=meta, given=path) == {"two": [1]}


def test_the_end_of_a_path_is_enough_if_it_is_one_photos(tmp_path):
    names = ["images/a/1.png", "images/b/1.png", "images/b/2.png"]
    assert _resolve(tmp_path, names, given={"x": ["2.png", "a/1.png"]}) == {"x": [2, 0]}
    with pytest.raises(ValueError, match=r"names '1\.png', which is in 2 frames \(images/a/1\.png, images/b/1\.png\)"):
        _resolve(tmp_path, names, given={"x": ["1.png"]})
    with pytest.raises(ValueError, match=r"lists 'images/b/2\.png' twice"):
        _resolve(tmp_path, names, given={"x": ["2.png", "images/b/2.png"]})


def test_photos_that_were_dropped_leave_their_sweeps(tmp_path):
    given = {"x": ["a.png", "b.png"], "y": ["b.png", "c.png"]}
    assert _resolve(tmp_path, ["a.png", "b.png"], given=given, dropped=["c.png"]) == {"x": [0, 1], "y": [1]}
    with pytest.raises(ValueError, match="none of the 2 photos of split 'y' is there"):
        _resolve(tmp_path, ["a.png"], given={"y": ["b.png", "c.png"]}, dropped=["b.png", "c.png"])


@pytest.mark.parametrize("given", [{"x": []}, {"x": 3}, {"x": {"a.png": 1}}, {"x": [1]}, {"x": None}])
def test_what_is_no_list_is_refused(tmp_path, given):
    with pytest.raises(ValueError, match="split 'x' must be a list of file names"):
        _resolve(tmp_path, ["a.png"], given=given)


def test_a_split_file_that_is_not_there_is_named(tmp_path):
    with pytest.raises(ValueError, match=r"has no gone\.json"):
        _resolve(tmp_path, ["a.png"], given=tmp_path / "gone.json")
