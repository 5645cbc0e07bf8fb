"""What goes wrong while shards are made: nothing finished is lost, nothing half-made is trusted."""

import dataclasses
import errno
import pathlib
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from unghost.core.shards.storage import read_shard
from unghost.data_recipes import pairs
from unghost.data_recipes.curation import SampleError, curate
from unghost.data_recipes.recipe import Recipe

RECIPE = Recipe(parts=(1, 3))


KILLED = """
import sys
from unghost.data_recipes.curation import curate
from unghost.data_recipes.recipe import Recipe

if __name__ == "__main__":
    curate(Recipe(parts=(1, 3)), sys.argv[1], count=200, seed=3, shard_length=25, workers=int(sys.argv[2]))
"""


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 2])
def test_a_killed_run_goes_on_to_the_same_bytes(tmp_path, workers, whole_bytes):
    script, out = tmp_path / "killed.py", tmp_path / "out"
    script.write_text(KILLED, encoding="utf-8")
    with subprocess.Popen([sys.executable, str(script), str(out), str(workers)]) as run:
        deadline = time.monotonic() + 120
        while not (out / "shard-00001").exists() and time.monotonic() < deadline and run.poll() is None:
            time.sleep(0.002)
        run.send_signal(signal.SIGKILL)
    assert run.returncode == -signal.SIGKILL
    survivors = sorted(path for path in out.glob("shard-*") if path.suffix != ".partial")
    assert (out / ".lock").exists()  # the run was killed with the folder in its hands; nobody has it now
    assert 2 <= len(survivors) < 8
    stamps = [(path / "manifest.json").stat().st_mtime_ns for path in survivors]
    (out / "shard-00007.partial").mkdir(exist_ok=True)  # as a kill while writing leaves it
    (out / "shard-00007.partial" / "inputs.npy").write_bytes(b"half")
    folders = curate(RECIPE, out, count=200, seed=3, shard_length=25)
    assert [(path / "manifest.json").stat().st_mtime_ns for path in survivors] == stamps
    assert sorted(out.iterdir()) == folders
    curate(RECIPE, tmp_path / "whole", count=200, seed=3, shard_length=25)
    assert whole_bytes(out) == whole_bytes(tmp_path / "whole")


def test_a_full_disk_costs_what_is_unfinished_only(tmp_path, monkeypatch, whole_bytes):
    real = pathlib.Path.open

    def full(self, *args, **kwargs):  # fails with ENOSPC on writing, as a full disk does
        return real(pathlib.Path("/dev/full") if "shard-00002" in str(self) else self, *args, **kwargs)

    monkeypatch.setattr(pathlib.Path, "open", full)
    rule = r"curate: .*No space left on device.*; 2 of 4 shards are finished and stay: the same call goes on"
    with pytest.raises(OSError, match=rule) as caught:
        curate(RECIPE, tmp_path / "out", count=20, seed=0, shard_length=5)
    assert caught.value.errno == errno.ENOSPC
    monkeypatch.undo()
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["shard-00000", "shard-00001"]
    curate(RECIPE, tmp_path / "out", count=20, seed=0, shard_length=5)
    curate(RECIPE, tmp_path / "whole", count=20, seed=0, shard_length=5)
    assert whole_bytes(tmp_path / "out") == whole_bytes(tmp_path / "whole")


def test_a_file_that_may_not_grow_is_named(tmp_path):
    resource = pytest.importorskip("resource")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, before[1]))
    try:
        with pytest.raises(OSError, match=r"File too large.*; 0 of 1 shards are finished") as caught:
            curate(RECIPE, tmp_path / "out", count=16, seed=0)  # 16 inputs are 524,288 bytes
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert caught.value.errno == errno.EFBIG
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("damage_done", ["cut", "flipped", "emptied"])
def test_a_damaged_shard_is_never_taken_for_finished(tmp_path, damage_done):
    folders = curate(RECIPE, tmp_path, count=10, seed=0, shard_length=5)
    path = folders[0] / ("manifest.json" if damage_done == "emptied" else "labels.npy")
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes({"cut": content[:-9], "flipped": content, "emptied": b""}[damage_done])
    with pytest.raises(ValueError, match=f"read_shard: .*{path.name}"):
        curate(RECIPE, tmp_path, count=10, seed=0, shard_length=5)
    assert path.exists()  # nothing is thrown away unasked
    shutil.rmtree(folders[0])
    curate(RECIPE, tmp_path, count=10, seed=0, shard_length=5)
    read_shard(folders[0], verify=True)


def test_another_curation_in_the_same_folder_is_refused(tmp_path):
    curate(RECIPE, tmp_path, count=4, seed=0)
    with pytest.raises(ValueError, match=r"holds another curation \(seed: 0, not 1\): choose another out folder"):
        curate(RECIPE, tmp_path, count=4, seed=1)
    with pytest.raises(ValueError, match=r"another curation \(recipe\.soft_share: 0\.5, not 0\.1\)"):
        curate(dataclasses.replace(RECIPE, soft_share=0.1), tmp_path, count=4, seed=0)
    with pytest.raises(ValueError, match=r"another curation \(count: 4, not 5; last: 3, not 4\)"):
        curate(RECIPE, tmp_path, count=5, seed=0)


def test_a_sample_that_fails_is_named(tmp_path, monkeypatch):
    real = pairs.sample_cube

    def failing(rng, recipe):
        if np.random.default_rng([0, 21]).bit_generator.state == rng.bit_generator.state:
            raise ZeroDivisionError("no such cube")
        return real(rng, recipe)

    monkeypatch.setattr(pairs, "sample_cube", failing)
    with pytest.raises(SampleError, match="curate: sample 21 of seed 0: ZeroDivisionError: no such cube"):
        curate(RECIPE, tmp_path / "out", count=30, seed=0)
    assert not list(tmp_path.rglob("shard*"))
