"""Atomic writes: the old file or the whole new one, and nothing left behind."""

import os
import pathlib

import numpy as np
import pytest

from unghost.core.io import atomic_file, new_folder, read_json, write_bytes, write_json, write_npz, write_text

WRITERS = {
    "bytes": lambda path, **options: write_bytes(path, b"new", **options),
    "text": lambda path, **options: write_text(path, "new", **options),
    "json": lambda path, **options: write_json(path, ["new"], **options),
    "npz": lambda path, **options: write_npz(path, new=np.ones(2), **options),
}


@pytest.fixture(params=WRITERS)
def write(request):
    return WRITERS[request.param]


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_contents(tmp_path):
    write_bytes(tmp_path / "b", b"\0\r\n")
    write_text(tmp_path / "t", "ä\r\nb\n")
    write_json(tmp_path / "j", {"ä": [1]})
    write_npz(tmp_path / "z", a=np.arange(3))
    assert (tmp_path / "b").read_bytes() == b"\0\r\n"
    assert (tmp_path / "t").read_bytes() == b"\xc3\xa4\r\nb\n"
    assert (tmp_path / "j").read_bytes() == b'{\n "\\u00e4": [\n  1\n ]\n}\n'
    assert read_json(tmp_path / "j", caller="test") == {"ä": [1]}
    assert np.load(tmp_path / "z")["a"].tolist() == [0, 1, 2]
    assert names(tmp_path) == ["b", "j", "t", "z"]


def test_parents_are_created_unless_told_not_to(tmp_path, write):
    write(tmp_path / "a" / "b" / "file")
    assert names(tmp_path / "a" / "b") == ["file"]
    with pytest.raises(FileNotFoundError):
        write(tmp_path / "c" / "file", parents=False)
    assert names(tmp_path) == ["a"]


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_a_failed_move_leaves_the_old_file_alone(tmp_path, write, error, monkeypatch):
    target = tmp_path / "file"
    target.write_text("old")

    def broken(*_):
        raise error

    monkeypatch.setattr(os, "replace", broken)
    with pytest.raises(type(error)):
        write(target)
    assert target.read_text() == "old"
    assert names(tmp_path) == ["file"]


def test_an_error_while_writing_leaves_the_old_file_alone(tmp_path):
    target = tmp_path / "file"
    target.write_text("old")

    def write_half():
        with atomic_file(target) as stream:
            stream.write(b"half")
            raise RuntimeError("half")

    with pytest.raises(RuntimeError, match="half"):
        write_half()
    assert target.read_text() == "old"
    assert names(tmp_path) == ["file"]


def test_nothing_stands_under_the_name_before_the_end(tmp_path):
    with atomic_file(tmp_path / "file") as stream:
        stream.write(b"new")
        assert names(tmp_path) == ["file.partial"]
    assert names(tmp_path) == ["file"]


@pytest.mark.parametrize("fsync", [False, True])
def test_contents_reach_the_disk_before_the_name_on_request(tmp_path, fsync, monkeypatch):
    order = []
    honest = os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda number: (order.append("fsync"), honest[0](number)))
    monkeypatch.setattr(os, "replace", lambda *paths: (order.append("replace"), honest[1](*paths)))
    write_bytes(tmp_path / "file", b"new", fsync=fsync)
    assert order == ["fsync", "replace"][not fsync :]


@pytest.mark.parametrize(("value", "error"), [(float("nan"), ValueError), (object(), TypeError)])
def test_what_json_does_not_have_leaves_the_old_file(tmp_path, value, error):
    path = tmp_path / "a.json"
    write_json(path, 1)
    with pytest.raises(error):
        write_json(path, value)
    assert read_json(path, caller="test") == 1
    assert names(tmp_path) == ["a.json"]


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe{", b"[" * 100_000])
def test_read_json_refuses(tmp_path, content):
    path = tmp_path / "a.json"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"^test: .*a\.json is not JSON"):
        read_json(path, caller="test")


@pytest.mark.parametrize("path", ["absent", "file/absent"])
def test_read_json_names_an_absent_file(tmp_path, path):
    (tmp_path / "file").write_text("")
    with pytest.raises(FileNotFoundError, match=r"^test: no file .*absent"):
        read_json(tmp_path / path, caller="test")


@pytest.mark.parametrize("unique", [False, True])
def test_a_new_folder_is_whole_or_absent(tmp_path, unique):
    target = tmp_path / "a" / "b"

    def write_half():
        with new_folder(target, unique=unique) as partial:
            (partial / "x").write_text("x")
            assert not target.exists()
            assert partial.parent == target.parent
            raise RuntimeError("half")

    with pytest.raises(RuntimeError, match="half"):
        write_half()
    assert names(tmp_path / "a") == []
    with new_folder(target, unique=unique) as partial:
        (partial / "x").write_text("x")
    assert names(target) == ["x"]
    assert names(target.parent) == ["b"]
    with pytest.raises(ValueError, match="is there already and not empty"), new_folder(target, unique=unique):
        pass
    assert names(target) == ["x"]


def test_a_new_folder_takes_the_place_of_an_empty_one(tmp_path):
    (tmp_path / "b").mkdir()
    with new_folder(tmp_path / "b") as partial:
        (partial / "x").write_text("x")
    assert names(tmp_path / "b") == ["x"]


def test_a_unique_partial_folder_touches_no_other_one_and_a_named_one_replaces_it(tmp_path):
    other = tmp_path / "b.partial"
    other.mkdir()
    (other / "mine").write_text("kept")
    with new_folder(tmp_path / "b"):
        pass
    assert names(other) == ["mine"]
    (tmp_path / "b").rmdir()
    with new_folder(tmp_path / "b", unique=False) as partial:
        assert partial == other
        assert names(partial) == []
    assert names(tmp_path) == ["b"]


@pytest.mark.skipif(os.name != "posix", reason="permissions of POSIX")
@pytest.mark.parametrize("unique", [False, True])
def test_a_new_folder_has_the_usual_permissions(tmp_path, unique):
    (tmp_path / "usual").mkdir()
    with new_folder(tmp_path / "new", unique=unique):
        pass
    assert pathlib.Path(tmp_path, "new").stat().st_mode == pathlib.Path(tmp_path, "usual").stat().st_mode


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_json_with_a_byte_order_mark_is_read(tmp_path, encoding):
    (tmp_path / "a.json").write_bytes('{"ä": 1}'.encode(encoding))
    assert read_json(tmp_path / "a.json", caller="test") == {"ä": 1}
