import itertools
import multiprocessing
import os
import signal
import subprocess
import sys
import textwrap
import time
from contextlib import closing
from pathlib import Path

import pytest

from unghost.data_recipes import curation as curate_module
from unghost.data_recipes.curation import curate
from unghost.data_recipes.engines import ENGINES, LocalEngine, WorkerDied, open_engine, spans
from unghost.data_recipes.recipe import Recipe

RECIPE = Recipe(parts=(1, 2))
ROOT = Path(__file__).resolve().parents[2]
TASKS = """
    import os, signal, struct, sys, time
    from pathlib import Path
    from unghost.data_recipes.pairs import make_chunk

    FOLDER = Path({folder!r})

    def identity(number):
        return number, os.getpid()

    def slowly(number):
        time.sleep(0.05)
        return number

    def endlessly(number):
        time.sleep(0 if number == 0 else 300)

    def die_once(number):
        marker = FOLDER / "died"
        if number == 3 and not marker.exists():
            marker.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return number

    def die_while_sending(number):
        marker = FOLDER / "died-sending"
        if number == 3 and not marker.exists():
            marker.touch()
            frame = sys._getframe()
            while "result_queue" not in frame.f_locals:  # of the pool's loop in this worker
                frame = frame.f_back
            os.write(frame.f_locals["result_queue"]._writer.fileno(), struct.pack("!i", 1 << 20) + b"the beginning")
            os.kill(os.getpid(), signal.SIGKILL)
        return number

    def die_of_seven(number):
        if number == 7:
            os.kill(os.getpid(), signal.SIGKILL)
        return number

    def fail_at_five(number):
        if number == 5:
            raise KeyError("five")
        return number

    def deadly_chunk(recipe, seed, mesh_root, start, stop):
        marker = FOLDER / "chunk-died"
        if start > 0 and not marker.exists():
            marker.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return make_chunk(recipe, seed, mesh_root, start, stop)
"""


@pytest.fixture(scope="module")
def tasks_folder(tmp_path_factory):
    """Holds a module that every worker can import: it is on ``PYTHONPATH`` before any of them starts."""
    folder = tmp_path_factory.mktemp("tasks")
    (folder / "engine_tasks.py").write_text(textwrap.dedent(TASKS).format(folder=str(folder)), encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        patch.setenv("PYTHONPATH", os.pathsep.join([str(folder), str(ROOT), os.environ.get("PYTHONPATH", "")]))
        yield folder
    sys.modules.pop("engine_tasks", None)


@pytest.fixture
def tasks(tasks_folder):
    import engine_tasks

    for marker in tasks_folder.glob("*died"):
        marker.unlink()
    return engine_tasks


@pytest.fixture(scope="module")
def _cluster(tasks_folder):
    """One local Ray cluster for all tests here; an engine that finds one running leaves it running."""
    ray = pytest.importorskip("ray")
    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False, logging_level="error")
    yield
    ray.shutdown()


@pytest.fixture(params=["local", "ray"])
def engine(request):
    if request.param == "ray":
        request.getfixturevalue("_cluster")
    return request.param


def numbers(stop=None):
    return ((number,) for number in (range(stop) if stop is not None else itertools.count()))


def shard_bytes(folders):
    return {path.relative_to(folders[0].parent): path.read_bytes() for f in folders for path in sorted(f.iterdir())}


def test_pieces_by_hand():
    assert list(spans(3, 10, 4)) == [(3, 7), (7, 10)]
    assert list(spans(0, 8, 4)) == [(0, 4), (4, 8)]
    assert list(spans(5, 5, 4)) == []
    assert list(itertools.islice(spans(1, None, 2), 3)) == [(1, 3), (3, 5), (5, 7)]


def test_results_come_in_order_from_other_processes(engine, tasks):
    with open_engine(engine, 2) as opened, closing(opened.ordered(tasks.identity, numbers(20))) as results:
        found = list(results)
    assert [number for number, _ in found] == list(range(20))
    assert os.getpid() not in {worker for _, worker in found}


def test_one_local_worker_is_this_process(tasks):
    with open_engine("local", 1) as opened:
        assert {worker for _, worker in opened.ordered(tasks.identity, numbers(3))} == {os.getpid()}


def test_one_local_worker_can_be_apart(tasks):
    with LocalEngine(1, apart=True) as opened, closing(opened.ordered(tasks.identity, numbers(3))) as results:
        workers = {worker for _, worker in results}
    assert len(workers) == 1
    assert os.getpid() not in workers


def test_an_interrupt_waits_for_nobody(tasks):
    def interrupted():
        with LocalEngine(2) as opened, closing(opened.ordered(tasks.endlessly, numbers())) as results:
            next(results)
            raise KeyboardInterrupt

    start = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert time.monotonic() - start < 120
    assert multiprocessing.active_children() == []


def test_endless_work_runs_a_few_tasks_ahead_only(engine, tasks):
    taken = []
    source = (taken.append(number) or (number,) for number in itertools.count())
    with open_engine(engine, 2) as opened, closing(opened.ordered(tasks.identity, source)) as results:
        assert [next(results)[0] for _ in range(5)] == [0, 1, 2, 3, 4]
    assert len(taken) <= 5 + 4


def test_an_error_keeps_its_type_and_waits_for_its_turn(engine, tasks):
    with open_engine(engine, 2) as opened, closing(opened.ordered(tasks.fail_at_five, numbers())) as results:
        assert [next(results) for _ in range(5)] == [0, 1, 2, 3, 4]
        with pytest.raises(KeyError, match="five"):
            next(results)


def test_a_worker_that_dies_costs_only_time(engine, tasks, tasks_folder):
    with open_engine(engine, 2) as opened, closing(opened.ordered(tasks.die_once, numbers(12))) as results:
        assert list(results) == list(range(12))
    assert (tasks_folder / "died").exists()


@pytest.mark.slow
def test_a_worker_killed_while_it_sends_its_result_costs_only_time(tasks):
    with LocalEngine(2) as engine:
        assert list(engine.ordered(tasks.die_while_sending, numbers(8))) == list(range(8))


@pytest.mark.slow
def test_a_call_that_no_worker_survives_is_named(engine, tasks):
    with open_engine(engine, 2) as opened, closing(opened.ordered(tasks.die_of_seven, numbers(9))) as results:
        assert [next(results) for _ in range(7)] == list(range(7))
        with pytest.raises(WorkerDied, match=r"3 workers in a row died over die_of_seven\(7\)"):
            next(results)


@pytest.mark.slow
@pytest.mark.parametrize("victim", [0, 1])
def test_a_worker_killed_from_outside_costs_only_time(tasks, victim):
    with LocalEngine(2) as opened, closing(opened.ordered(tasks.slowly, numbers(20))) as results:
        found = [next(results) for _ in range(4)]
        os.kill(multiprocessing.active_children()[victim].pid, signal.SIGKILL)
        assert found + list(results) == list(range(20))


def test_leaving_ends_the_workers(tasks):
    with LocalEngine(2) as opened, closing(opened.ordered(tasks.slowly, numbers())) as results:
        next(results)
        assert len(multiprocessing.active_children()) == 2
    assert multiprocessing.active_children() == []


def test_workers_do_not_outlive_a_killed_parent(tasks, tmp_path):
    script = tmp_path / "parent.py"
    script.write_text(
        "import itertools, multiprocessing\nfrom engine_tasks import slowly\n"
        "from unghost.data_recipes.engines import LocalEngine\n"
        "if __name__ == '__main__':\n"
        "    with LocalEngine(2) as opened:\n"
        "        for _ in opened.ordered(slowly, ((n,) for n in itertools.count())):\n"
        "            print(*(child.pid for child in multiprocessing.active_children()), flush=True)\n",
        encoding="utf-8",
    )
    with subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True) as parent:
        workers = [int(word) for word in parent.stdout.readline().split()]
        assert len(workers) == 2
        assert all(alive(worker) for worker in workers)
        parent.kill()
    deadline = time.monotonic() + 60
    while any(alive(worker) for worker in workers) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not any(alive(worker) for worker in workers)


def alive(process):
    """Whether a process runs; one that only waits for its status to be read does not."""
    try:
        return Path(f"/proc/{process}/stat").read_text(encoding="ascii").rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.slow
def test_a_recipe_gives_the_same_bytes_on_every_engine(engine, tmp_path):
    here = curate(RECIPE, tmp_path / "here", count=40, seed=5, shard_length=24)
    there = curate(RECIPE, tmp_path / "there", count=40, seed=5, shard_length=24, workers=2, engine=engine)
    assert shard_bytes(here) == shard_bytes(there)


@pytest.mark.slow
def test_a_recipe_whose_worker_is_killed_gives_the_same_bytes(engine, tasks, tasks_folder, tmp_path, monkeypatch):
    here = curate(RECIPE, tmp_path / "here", count=48, seed=5, shard_length=24)
    monkeypatch.setattr(curate_module, "make_chunk", tasks.deadly_chunk)
    there = curate(RECIPE, tmp_path / "there", count=48, seed=5, shard_length=24, workers=2, engine=engine)
    assert (tasks_folder / "chunk-died").exists()
    assert shard_bytes(here) == shard_bytes(there)


def test_ray_starts_its_own_cluster_and_ends_it(tmp_path):
    """In a process of its own, where none is running."""
    pytest.importorskip("ray")
    script = (
        "import ray\nfrom pathlib import Path\nfrom unghost.data_recipes.curation import curate\n"
        "from unghost.data_recipes.recipe import Recipe\n"
        f"curate(Recipe(parts=(1, 2)), {str(tmp_path / 'out')!r}, count=9, seed=1, workers=2, engine='ray')\n"
        "assert not ray.is_initialized()\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "RAY_ADDRESS": ""}
    subprocess.run([sys.executable, "-c", script], check=True, env=environment, timeout=120)
    here = curate(RECIPE, tmp_path / "here", count=9, seed=1)
    assert shard_bytes(here) == shard_bytes([tmp_path / "out" / "shard-00000"])


def test_without_ray_the_extra_is_named(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ImportError, match=r"pip install unghost\[scale\]"):
        curate(RECIPE, tmp_path / "out", count=2, seed=0, engine="ray")
    assert not (tmp_path / "out").exists()


def test_unknown_engines_and_no_workers_are_refused():
    with pytest.raises(ValueError, match="engine must be one of local, ray, got 'dask'"):
        open_engine("dask", 1)
    for name in ENGINES:
        with pytest.raises(ValueError, match="workers must be >= 1, got 0"):
            open_engine(name, 0)
