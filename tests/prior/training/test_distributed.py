"""Two real processes over gloo against one."""

import dataclasses
import json
import os
import re
import signal
import socket
import subprocess
import sys
import textwrap
import time

import numpy as np
import pytest
import torch

from unghost.prior.checkpoint import read_tensors
from unghost.prior.networks.restoration import NetworkConfig
from unghost.prior.training.batches import Batch, Mixture
from unghost.prior.training.config import TrainConfig
from unghost.prior.training.distributed import TIMEOUT_VARIABLE, Group, RankLost, joined
from unghost.prior.training.loop import train

TOLERANCE = 1e-6  # of a weight, after six steps of AdamW at 1e-3; 4e-8 was seen
SCRIPT = """
import json, os, signal, sys
from unghost.prior.training.config import TrainConfig
from unghost.prior.training.loop import train
import torch
spec = json.loads(sys.argv[1])
rank = int(os.environ["RANK"])
torch.set_num_threads(1)

def on_step(step, values):
    if rank == spec["victim"] and step == spec["step"]:
        os.kill(os.getpid(), getattr(signal, spec["signal"]))
    with open(f"{spec['out']}-{rank}.jsonl", "a") as stream:
        print(json.dumps(values), file=stream)

result = train(
    TrainConfig.from_dict(spec["config"]), train_shards=[tuple(pair) for pair in spec["shards"]], out=spec["out"],
    validation_shards=spec["validation"], resume=spec["resume"], progress=False, on_step=on_step,
)
print(rank, result.steps, sorted(result.validation), flush=True)
"""


CONFIG = TrainConfig(
    network=NetworkConfig(widths=(8, 8, 8), condition_width=8),
    steps=6,
    batch_size=4,
    precision="fp32",
    warmup_steps=1,
    checkpoint_seconds=1e6,
    validate_seconds=0.0,
    seed=3,
)


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture(scope="module")
def run(shard_paths, tmp_path_factory):
    """Runs the script in processes of its own; torchrun starts them unless ``bare``."""
    script = tmp_path_factory.mktemp("script") / "script.py"
    script.write_text(SCRIPT)

    def start(out, *, bare=False, victim=-1, step=0, signal_name="SIGKILL", resume=False, timeout=60.0, **changes):
        config = json.loads(dataclasses.replace(CONFIG, checkpoint_steps=2, **changes).to_json())
        spec = {
            "config": config,
            "out": str(out),
            "victim": victim,
            "step": step,
            "signal": signal_name,
            "shards": [[str(shard_paths["a"]), 2.0], [str(shard_paths["b"]), 1.0]],
            "resume": resume,
            "validation": {"held": str(shard_paths["held_out"])},
        }
        env = os.environ | {"OMP_NUM_THREADS": "1", TIMEOUT_VARIABLE: str(timeout)}
        port, words = str(free_port()), [str(script), json.dumps(spec)]
        if not bare:
            launch = ["-m", "torch.distributed.run", "--nproc-per-node", "2", "--master-addr", "127.0.0.1"]
            command = [sys.executable, *launch, "--master-port", port, *words]
            return subprocess.run(command, env=env, capture_output=True, text=True, timeout=300, check=False)
        meeting = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port, "WORLD_SIZE": "2"}
        return [
            subprocess.Popen(
                [sys.executable, *words],
                env=env | meeting | {"RANK": str(rank)},
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
            )
            for rank in range(2)
        ]

    return start


@pytest.fixture(scope="module")
def whole(run, tmp_path_factory):
    """An undisturbed run of two ranks, started by torchrun: its folder and what it printed."""
    out = tmp_path_factory.mktemp("whole") / "two"
    done = run(out)
    assert done.returncode == 0, done.stderr[-3000:]
    return out, done.stdout


def difference(first, second):
    """Largest difference of two training states, by kind of tensor."""
    left, right = (read_tensors(path / "state.safetensors")[0] for path in (first, second))
    assert set(left) == set(right)
    kinds = {}
    for name, value in left.items():
        kind = name.split(".")[0]
        kinds[kind] = max(kinds.get(kind, 0.0), float((value - right[name]).abs().max()))
    return kinds


@pytest.mark.slow
def test_two_ranks_give_the_result_of_one_process(whole, shard_paths, tmp_path):
    values, (out, printed) = [], whole
    alone = train(
        CONFIG,
        train_shards=[(shard_paths["a"], 2.0), (shard_paths["b"], 1.0)],
        out=tmp_path / "one",
        validation_shards={"held": shard_paths["held_out"]},
        progress=False,
        on_step=lambda _, v: values.append(v),
    )
    assert sorted(re.findall(r"^\d 6 .*$", printed, re.M)) == ["0 6 ['held']", "1 6 []"]  # one of them validates
    found = difference(tmp_path / "one", out)
    assert found["live"] < TOLERANCE
    assert found["average"] < TOLERANCE
    first, second = (
        [json.loads(line) for line in out.with_name(f"two-{rank}.jsonl").read_text().splitlines()] for rank in (0, 1)
    )
    assert first == second  # the same loss, gradient and rate, bit for bit, on either rank
    np.testing.assert_allclose([v["loss"] for v in first], [v["loss"] for v in values], rtol=1e-5)
    np.testing.assert_allclose([v["gradient_norm"] for v in first], [v["gradient_norm"] for v in values], rtol=1e-4)
    assert {item.name for item in out.iterdir()} == {item.name for item in (tmp_path / "one").iterdir()}
    lines = (out / "log.jsonl").read_text().splitlines()
    assert len(lines) == len((tmp_path / "one" / "log.jsonl").read_text().splitlines())  # nobody wrote twice
    scores = json.loads((out / "validation.json").read_text())
    assert scores["held"]["iou"] == pytest.approx(alone.validation["held"]["iou"], abs=1e-3)


@pytest.mark.slow
def test_a_rank_that_dies_ends_the_run_and_it_goes_on_from_its_checkpoint(run, whole, tmp_path):
    ranks = run(tmp_path / "run", bare=True, victim=1, step=4)
    begun = time.monotonic()
    outputs = [rank.communicate(timeout=200) for rank in ranks]
    assert ranks[1].returncode == -signal.SIGKILL
    assert ranks[0].returncode == 1
    assert "RankLost: train: rank 0 of 2, averaging gradients: another rank is gone" in outputs[0][1]
    assert time.monotonic() - begun < 150
    assert read_tensors(tmp_path / "run" / "state.safetensors")[1]["step"] == "4"
    done = run(tmp_path / "run", resume=True)
    assert done.returncode == 0, done.stderr[-3000:]
    assert difference(tmp_path / "run", whole[0]) == {"live": 0.0, "average": 0.0, "optimizer": 0.0}


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(signal, "SIGSTOP"), reason="needs SIGSTOP")
def test_a_rank_that_hangs_is_not_waited_for_for_ever(run, tmp_path):
    ranks = run(tmp_path / "run", bare=True, victim=1, step=2, signal_name="SIGSTOP", timeout=5.0)
    try:
        _, error = ranks[0].communicate(timeout=200)
    finally:
        ranks[1].kill()
        ranks[1].communicate(timeout=60)
    assert ranks[0].returncode == 1
    assert "another rank is gone or was silent for 5 s" in error


@pytest.mark.parametrize("size", [1, 2, 3])
def test_the_parts_of_the_ranks_are_the_batch(shard_paths, size):
    shards = [(shard_paths["a"], 1.0), (shard_paths["b"], 1.0)]
    whole = Mixture(shards, seed=5)
    for step in (0, 3):
        batch = whole.batch(step, 6)
        parts = [Group(rank, size).share(batch) for rank in range(size)]
        for field in dataclasses.fields(Batch):
            joined_parts = np.concatenate([getattr(part, field.name) for part in parts])
            np.testing.assert_array_equal(joined_parts, getattr(batch, field.name))


def test_batches_that_cannot_be_shared_out_are_refused(tiny_config):
    with pytest.raises(ValueError, match="batch_size must be a multiple of the number of processes, got 3 for 2"):
        Group(0, 2).check(tiny_config)
    Group(0, 3).check(tiny_config)


def test_alone_nothing_happens(monkeypatch):
    monkeypatch.delenv("WORLD_SIZE", raising=False)
    with joined("cpu") as group:
        assert (group, group.first) == (Group(), True)
        network, loss = torch.nn.Linear(2, 1), torch.tensor(3.0)
        assert group.average(network, loss) is loss
        assert group.agree(1.25) == 1.25
    assert not torch.distributed.is_initialized()


@pytest.mark.slow
def test_others_that_never_come_are_not_waited_for_for_ever(monkeypatch):
    settings = {"WORLD_SIZE": "2", "RANK": "1", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free_port())}
    for name, value in (settings | {TIMEOUT_VARIABLE: "1"}).items():
        monkeypatch.setenv(name, value)
    with pytest.raises(RankLost, match="rank 1 of 2: the others did not come"), joined("cpu"):
        pass
    monkeypatch.setenv(TIMEOUT_VARIABLE, "soon")
    with pytest.raises(ValueError, match=f"{TIMEOUT_VARIABLE} must be a number of seconds > 0, got 'soon'"):
        joined("cpu").__enter__()


@pytest.mark.slow
def test_averages_by_hand(tmp_path):
    """Two ranks with gradients 1 and 3, and a loss that is not finite on one of them alone."""
    code = textwrap.dedent(
        """
        import math, os, torch
        from unghost.prior.training.distributed import joined
        with joined("cpu") as group:
            layer = torch.nn.Linear(2, 1)
            layer.weight.grad = torch.full_like(layer.weight, 1.0 + 2.0 * group.rank)
            assert float(group.average(layer, torch.tensor(5.0 + group.rank))) == 5.5
            assert layer.weight.grad.tolist() == [[2.0, 2.0]] and layer.bias.grad is None
            assert math.isnan(float(group.average(layer, torch.tensor(math.nan if group.rank else 0.0))))
            assert group.agree(10.0 + group.rank) == 10.0
        """
    )
    settings = {"WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free_port()), "OMP_NUM_THREADS": "1"}
    ranks = [
        subprocess.Popen([sys.executable, "-c", code], env=os.environ | settings | {"RANK": str(rank)})
        for rank in range(2)
    ]
    assert [rank.wait(timeout=200) for rank in ranks] == [0, 0]
