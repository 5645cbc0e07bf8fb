"""SIGKILL at moments chosen to hurt: a resumed run ends with the bits of one that was left alone."""

import dataclasses
import json
import os
import signal
import subprocess
import sys

import pytest
import torch

from unghost.prior.checkpoint import load_model, read_tensors
from unghost.prior.training.loop import train

pytestmark = [
    pytest.mark.skipif(not (hasattr(signal, "SIGKILL") and hasattr(os, "fork")), reason="needs fork and SIGKILL"),
    pytest.mark.slow,
]

# What is killed, and at which call of it (the first write is config.json); then the step of the state on disk.
MOMENTS = {
    "before anything is kept": ("os.fsync", 1, None),
    "half a checkpoint is written": ("half a write", 4, "2"),
    "a checkpoint is written and not yet in place": ("os.replace", 4, "2"),
    "a checkpoint is just in place": ("os.replace, after", 4, "3"),
    "weights have moved and their average has not": ("average", 4, "3"),
    "half a line of the log is written": ("half a line", 1, None),
    "training is over, nothing is scored": ("validation", 1, "6"),
    "half of the model is written": ("half a write", 9, "6"),
    "the model is there, its scores are not": ("os.replace", 10, "6"),
}
PROGRAM = """
import json, os, pathlib, signal, sys
import torch._dynamo, torch.utils.tensorboard, tqdm  # once, not in every child
from unghost.prior import checkpoint, ema, train
from unghost.prior.training.config import TrainConfig

spec = json.loads(sys.argv[1])

def die():
    os.kill(os.getpid(), signal.SIGKILL)

def at_call(owner, name, number, *, after=False):
    honest, calls = getattr(owner, name), []
    def counted(*arguments, **options):
        calls.append(0)
        if len(calls) == number and not after:
            die()
        result = honest(*arguments, **options)
        if len(calls) == number:
            die()
        return result
    setattr(owner, name, counted)

def half_a_write(mode, number):
    honest, calls = pathlib.Path.open, []
    def opened(path, *arguments, **options):
        stream = honest(path, *arguments, **options)
        if arguments[:1] == (mode,):
            calls.append(0)
            if len(calls) == number:
                write = stream.write
                def torn(data):
                    write(data[: len(data) // 2])
                    stream.flush()
                    die()
                class Torn:
                    def __enter__(self): return self
                    def __exit__(self, *_): return None
                    write = staticmethod(torn)
                return Torn()
        return stream
    pathlib.Path.open = opened

def prepare(kind, number):
    if kind == "half a write":
        half_a_write("wb", number)
    elif kind == "half a line":
        half_a_write("a", number)
    elif kind == "average":
        at_call(ema.ExponentialMovingAverage, "update", number)
    elif kind == "validation":
        at_call(train, "_finish", number)
    else:
        name, _, after = kind.partition(",")
        at_call(os, name.split(".")[1], number, after=bool(after))

for out, (kind, number, _) in spec["moments"].items():
    child = os.fork()
    if not child:
        prepare(kind, number)
        train.train(TrainConfig.from_dict(spec["config"]), train_shards=[(spec["shard"], 1.0)], out=out,
                    validation_shards={"held": spec["held"]}, progress=False)
        os._exit(0)
    _, status = os.waitpid(child, 0)
    print(json.dumps([out, os.WTERMSIG(status) if os.WIFSIGNALED(status) else -1]), flush=True)
"""


@pytest.fixture(scope="module", autouse=True)
def _one_thread():
    """As the killed runs have: sums of several threads are taken in another order."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def config():
    from unghost.prior.networks.restoration import NetworkConfig
    from unghost.prior.training.config import TrainConfig

    return TrainConfig(
        network=NetworkConfig(widths=(8, 8, 8), condition_width=8),
        steps=6,
        batch_size=2,
        precision="fp32",
        warmup_steps=1,
        checkpoint_seconds=1e6,
        checkpoint_steps=1,
        validate_seconds=0.0,
        seed=3,
    )


@pytest.fixture(scope="module")
def settings(shard_paths):
    return {
        "train_shards": [(shard_paths["a"], 1.0)],
        "validation_shards": {"held": shard_paths["held_out"]},
        "progress": False,
    }


@pytest.fixture(scope="module")
def killed(config, shard_paths, tmp_path_factory):
    """The folder of a killed run for each moment, and the signal that ended it."""
    root = tmp_path_factory.mktemp("killed")
    folders = {name: root / str(index) for index, name in enumerate(MOMENTS)}
    spec = {
        "config": dataclasses.asdict(config),
        "shard": str(shard_paths["a"]),
        "held": str(shard_paths["held_out"]),
        "moments": {str(folders[name]): moment for name, moment in MOMENTS.items()},
    }
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, json.dumps(spec)],
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=500,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    signals = dict(json.loads(line) for line in done.stdout.splitlines())
    return {name: (folder, signals[str(folder)]) for name, folder in folders.items()}


@pytest.fixture(scope="module")
def undisturbed(config, settings, tmp_path_factory):
    return train(config, **settings, out=tmp_path_factory.mktemp("whole") / "run")


@pytest.mark.parametrize("moment", MOMENTS)
def test_killed_when(moment, killed, undisturbed, config, settings):
    folder, ended_by = killed[moment]
    assert ended_by == signal.SIGKILL
    state, expected = folder / "state.safetensors", MOMENTS[moment][2]
    assert state.exists() == (expected is not None)
    if expected is not None:
        assert read_tensors(state)[1]["step"] == expected  # whole, and the last one that was finished
    assert (folder / "config.json").exists()
    result = train(config, **settings, out=folder, resume=True)
    first, second = (read_tensors(path / "state.safetensors")[0] for path in (undisturbed.model.parent, folder))
    assert set(first) == set(second)
    assert all(torch.equal(first[name], second[name]) for name in first)
    left, right = load_model(undisturbed.model).network.state_dict(), load_model(result.model).network.state_dict()
    assert all(torch.equal(left[name], right[name]) for name in left)
    assert result.validation == undisturbed.validation
    torn = 0
    for line in (folder / "log.jsonl").read_text().splitlines():
        try:
            json.loads(line)
        except json.JSONDecodeError:
            torn += 1
    assert torn == (moment == "half a line of the log is written")  # one line lost, the next ones whole
