"""Two runs in one folder: one of them goes on, the other one is told."""

import errno
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from unghost.data_recipes.curation import curate
from unghost.data_recipes.folder_lock import locked
from unghost.data_recipes.harvest.config import HarvestConfig
from unghost.data_recipes.harvest.run import harvest
from unghost.data_recipes.recipe import Recipe

fcntl = pytest.importorskip("fcntl")
filelock = pytest.importorskip("filelock")

RECIPE = Recipe(parts=(1, 2))
HOLDER = """
import sys, time
from unghost.data_recipes.folder_lock import locked

with locked(sys.argv[1], verb="curate"):
    print("held", flush=True)
    time.sleep(300)
"""


@pytest.fixture
def holder(tmp_path):
    """Another process that holds ``tmp_path / "out"``."""
    command = [sys.executable, "-c", HOLDER, str(tmp_path / "out")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "held\n"
        yield process
        process.kill()


def test_a_second_run_is_told_who_holds_the_folder(tmp_path, holder):
    rule = rf"curate: another run is at work in .*out \(process {holder.pid}\): wait for its end, or choose another"
    with pytest.raises(BlockingIOError, match=rule):
        curate(RECIPE, tmp_path / "out", count=2, seed=0)
    with pytest.raises(BlockingIOError, match="harvest: another run is at work in"):
        harvest(tmp_path / "out", scenes=1, fit=False)
    assert [path.name for path in (tmp_path / "out").iterdir()] == [".lock"]


def test_a_killed_run_leaves_no_lock(tmp_path, holder, whole_bytes):
    holder.send_signal(signal.SIGKILL)
    holder.wait()
    assert (tmp_path / "out" / ".lock").exists()  # the file, which means nothing
    (folder,) = curate(RECIPE, tmp_path / "out", count=2, seed=0)
    assert list((tmp_path / "out").iterdir()) == [folder]
    curate(RECIPE, tmp_path / "alone", count=2, seed=0)
    assert whole_bytes(tmp_path / "out") == whole_bytes(tmp_path / "alone")


def test_many_at_once_never_hold_it_together(tmp_path):
    """Threads that lock, look and unlock: the file is removed and made anew all the time."""
    inside, refused, worst = [], [], []

    def work():
        for _ in range(150):
            try:
                with locked(tmp_path / "out", verb="curate"):
                    inside.append(1)
                    worst.append(len(inside))
                    inside.pop()
            except BlockingIOError:
                refused.append(1)

    (tmp_path / "out").mkdir()
    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert max(worst) == 1
    assert len(worst) + len(refused) == 600
    assert not list((tmp_path / "out").iterdir())


def test_a_folder_without_anything_in_it_goes_and_one_that_was_there_stays(tmp_path):
    (tmp_path / "there").mkdir()

    def fail(folder, *, write):
        with locked(folder, verb="curate"):
            if write:
                (folder / "a").touch()
            raise KeyError(folder)

    for name in ("there", "new", "filled"):
        with pytest.raises(KeyError, match=name):
            fail(tmp_path / name, write=name == "filled")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["filled", "there"]


def test_where_there_are_no_locks_there_is_none(tmp_path, monkeypatch):
    def unsupported(handle, operation):
        raise OSError(errno.ENOTSUP, "Operation not supported")

    with monkeypatch.context() as patch:
        patch.setattr(fcntl, "flock", unsupported)
        with locked(tmp_path, verb="curate"), locked(tmp_path, verb="curate"):
            pass
    assert not list(tmp_path.iterdir())
    with monkeypatch.context() as patch:  # filelock's choice where there is no fcntl and no Windows
        patch.setattr(filelock, "FileLock", filelock.SoftFileLock)
        with locked(tmp_path, verb="curate"), locked(tmp_path, verb="curate"):
            assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("code", [errno.EACCES, errno.EPERM, errno.EROFS])
def test_in_a_folder_that_may_not_be_written_there_is_none(tmp_path, monkeypatch, code):
    real = os.open

    def refused(path, flags, *rest, **more):
        if str(path).endswith(".lock"):
            raise OSError(code, os.strerror(code), path)
        return real(path, flags, *rest, **more)

    with monkeypatch.context() as patch:
        patch.setattr(os, "open", refused)
        with locked(tmp_path, verb="curate"), locked(tmp_path, verb="curate"):
            pass
    assert not list(tmp_path.iterdir())


def test_a_missing_filelock_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "filelock", None)
    rule = r"curate: filelock is not installed, .* would not be refused: pip install unghost\[recipes\]"
    with pytest.warns(UserWarning, match=rule) as record, locked(tmp_path, verb="curate"):
        assert not list(tmp_path.iterdir())
    assert record[0].filename == __file__


def test_a_full_disk_does_not_matter_to_the_lock(tmp_path, monkeypatch):
    def full(path, text, encoding):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    with locked(tmp_path, verb="curate"):
        with pytest.raises(BlockingIOError, match=r"at work in .*: wait"), locked(tmp_path, verb="curate"):
            pass
        monkeypatch.undo()
    assert not list(tmp_path.iterdir())


def test_a_file_in_the_place_of_the_folder_is_named(tmp_path):
    (tmp_path / "out").touch()
    with pytest.raises(OSError, match="out"):
        curate(RECIPE, tmp_path / "out", count=2, seed=0)


def test_scenes_of_another_harvest_are_not_taken_over(tmp_path):
    config = HarvestConfig(cubes=1)
    assert harvest(tmp_path, scenes=2, config=config, fit=False) == 2
    assert harvest(tmp_path, scenes=2, config=config, fit=False) == 2
    assert sorted(path.name for path in tmp_path.iterdir()) == ["scene-00000", "scene-00001"]
    for changes, rule in (
        ({"seed": 1}, "seed: 0, not 1"),
        ({"config": HarvestConfig(cubes=2)}, "cubes: 1, not 2"),
        ({"fit": True}, "recipe: 'rooms', not 'harvest'"),
    ):
        with pytest.raises(ValueError, match=rf"scene-00000 is of another harvest \({rule}\): choose another out"):
            harvest(tmp_path, **{"scenes": 2, "config": config, "fit": False, **changes})
    path = tmp_path / "scene-00001" / "labels.npy"
    path.write_bytes(path.read_bytes()[:-1] + b"\x55")
    with pytest.raises(ValueError, match=r"read_shard: .*labels\.npy does not match the hash"):
        harvest(tmp_path, scenes=2, config=config, fit=False)
    assert path.exists()
