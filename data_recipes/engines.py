"""Where the work of a recipe is done: in this process, in a pool of processes, or on a Ray cluster.

An engine takes calls that depend on their arguments alone and gives their results in order, so that what comes
out does not depend on where it was made. A worker that dies (killed, out of memory, a lost machine) is replaced
and its calls are made again.
"""

from __future__ import annotations

import itertools
import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import connection
from types import TracebackType
from typing import Any, Protocol, TypeVar

from ..core.errors import InvalidArgument, MissingExtra, UnghostError

Result = TypeVar("Result")
Task = tuple[Any, ...]

MAX_DEATHS = 3  # of workers over one and the same call
WATCH_SECONDS = 1.0  # between looks at whether all workers live, while a result is waited for


class WorkerDied(UnghostError, ChildProcessError):
    """A worker died whenever it made a certain call; the message names it."""


class Engine(Protocol):
    """Makes calls and gives their results in order; a context manager that ends its workers."""

    def __enter__(self) -> Engine: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    def ordered(self, call: Callable[..., Result], tasks: Iterable[Task]) -> Generator[Result, None, None]:
        """``call(*task)`` for each task, in order; ``tasks`` may be endless, a few are under way at a time.

        Raises:
            WorkerDied: a call that no worker survives.
            Exception: what a call raised, when its turn comes.
        """
        ...


def _describe(call: Callable[..., Any], task: Task) -> str:
    numbers = ", ".join(str(value) for value in task if isinstance(value, int))
    return f"{getattr(call, '__name__', 'call')}({numbers})"


def _died(call: Callable[..., Any], task: Task) -> WorkerDied:
    return WorkerDied(
        f"engines: {MAX_DEATHS} workers in a row died over {_describe(call, task)} (killed, or out of memory?)"
    )


def _end_with_parent() -> None:
    """In a new worker: leave interrupts to the parent, and do not outlive it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        connection.wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=watch, name="watch-parent", daemon=True).start()


class LocalEngine:
    """This process (``workers=1``) or a pool of spawned ones, which end with it, however it ends.

    A script that asks for more than one needs the usual ``if __name__ == "__main__"``.

    Args:
        workers: >= 1.
        ahead: calls that are under way or done before their turn, at most; twice the workers unless told.
        apart: spawn one worker, too, rather than make its calls in this process.
    """

    def __init__(self, workers: int, *, ahead: int | None = None, apart: bool = False) -> None:
        _check_workers(workers)
        self.workers, self.spawns = workers, apart or workers > 1
        self.ahead = 2 * workers if ahead is None else max(1, ahead)
        self._pool: ProcessPoolExecutor | None = None

    def __enter__(self) -> LocalEngine:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._end_pool(now=kind is not None and not issubclass(kind, GeneratorExit))

    def _end_pool(self, *, now: bool = False) -> None:
        """``now`` ends calls that are under way, too: after an interrupt nobody waits for them."""
        if self._pool is not None:
            for process in self._processes() if now else ():
                process.terminate()
            self._pool.shutdown(wait=True, cancel_futures=True)
            self._pool = None

    def _processes(self) -> list[Any]:
        return list((getattr(self._pool, "_processes", None) or {}).values())

    def _submit(self, call: Callable[..., Result], task: Task) -> Future[Result]:
        if self._pool is None:
            os.environ.setdefault("OMP_NUM_THREADS", "1")  # linear algebra in threads would fight over the cores
            self._pool = ProcessPoolExecutor(
                self.workers, mp_context=multiprocessing.get_context("spawn"), initializer=_end_with_parent
            )
        return self._pool.submit(call, *task)

    def _result(self, future: Future[Result]) -> Result:
        """The result of a call that was submitted.

        A pool finds out by itself that a worker died, but for one that is killed in the middle of sending a result:
        then it waits for the rest, which the other workers' open ends of the pipe never let end.
        """
        missed = False
        while True:
            wait([future], timeout=WATCH_SECONDS)
            if future.done():
                return future.result()
            dead = any(process.exitcode is not None for process in self._processes())
            if dead and missed:  # the pool had all the time between two looks
                break
            missed = dead
        for process in self._processes():
            process.kill()
            process.join()
        writer = getattr(getattr(self._pool, "_result_queue", None), "_writer", None)
        if writer is not None:
            writer.close()  # the last open end: what the pool waits for ends here
        raise BrokenProcessPool("a worker died while it sent a result")

    def ordered(self, call: Callable[..., Result], tasks: Iterable[Task]) -> Generator[Result, None, None]:
        """See :meth:`Engine.ordered`."""
        if not self.spawns:
            yield from itertools.starmap(call, tasks)
            return
        source = iter(tasks)
        waiting: deque[Task] = deque()
        pending: deque[Future[Result]] = deque()  # of the first ones of `waiting`
        deaths = 0
        while True:
            waiting.extend(itertools.islice(source, self.ahead - len(waiting)))
            if not waiting:
                return
            try:
                for task in itertools.islice(waiting, len(pending), self.ahead if not deaths else 1):
                    pending.append(self._submit(call, task))
                result = self._result(pending[0])
            except BrokenProcessPool:
                deaths += 1  # every call under way is lost; alone, the next one shows whether it is to blame
                self._end_pool()
                pending.clear()
                if deaths > MAX_DEATHS:
                    raise _died(call, waiting[0]) from None
                continue
            pending.popleft()
            waiting.popleft()
            deaths = 0
            yield result


class RayEngine:
    """A Ray cluster: the one that is running (``RAY_ADDRESS``), or else one of ``workers`` processes on this machine.

    Every machine of the cluster needs the same version of this package, and the same folder of meshes at the
    same place. Ray itself makes the calls of a lost worker anew.
    """

    def __init__(self, workers: int, *, ahead: int | None = None) -> None:
        _check_workers(workers)
        self.workers = workers
        self.ahead = 2 * workers if ahead is None else max(1, ahead)
        self._started = False

    def __enter__(self) -> RayEngine:
        try:
            import ray
        except ImportError as error:
            raise MissingExtra("engines: the engine ray needs Ray: pip install unghost[scale]") from error
        if not ray.is_initialized():
            try:
                ray.init(address="auto", log_to_driver=False, logging_level="error")
            except ConnectionError:
                ray.init(num_cpus=self.workers, include_dashboard=False, log_to_driver=False, logging_level="error")
            self._started = True
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._started:
            import ray

            ray.shutdown()
            self._started = False

    def ordered(self, call: Callable[..., Result], tasks: Iterable[Task]) -> Generator[Result, None, None]:
        """See :meth:`Engine.ordered`."""
        import ray
        from ray.exceptions import RayTaskError, WorkerCrashedError

        remote = ray.remote(call).options(num_cpus=1, max_retries=MAX_DEATHS)
        source = iter(tasks)
        pending: deque[tuple[Task, Any]] = deque()
        try:
            while True:
                for task in itertools.islice(source, self.ahead - len(pending)):
                    pending.append((task, remote.remote(*task)))
                if not pending:
                    return
                task, reference = pending[0]
                try:
                    result = ray.get(reference)
                except RayTaskError as error:
                    raise error.cause from error
                except WorkerCrashedError as error:
                    raise _died(call, task) from error
                pending.popleft()
                yield result
        finally:
            for _, reference in pending:
                ray.cancel(reference, force=True)


ENGINES: dict[str, Callable[[int], Engine]] = {"local": LocalEngine, "ray": RayEngine}


def _check_workers(workers: int) -> None:
    if workers < 1:
        raise InvalidArgument(f"engines: workers must be >= 1, got {workers}")


def open_engine(name: str, workers: int) -> Engine:
    """An engine by name, to be used in a ``with``.

    Args:
        name: ``"local"`` or ``"ray"``.
        workers: >= 1, processes at work at a time.

    Raises:
        ValueError: another name, or no workers.
        ImportError: on entering ``"ray"`` without Ray.
    """
    if name not in ENGINES:
        raise InvalidArgument(f"open_engine: engine must be one of {', '.join(ENGINES)}, got {name!r}")
    return ENGINES[name](workers)


def spans(start: int, stop: int | None, length: int) -> Iterator[tuple[int, int]]:
    """``[start, stop)`` cut into pieces of ``length``; without end if ``stop`` is None."""
    for low in itertools.count(start, length):
        if stop is not None and low >= stop:
            return
        yield low, low + length if stop is None else min(low + length, stop)
