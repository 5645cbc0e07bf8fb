"""Reading mesh files that may be hostile: in another process, with a limit of time and memory for each file.

One reader process serves file after file (importing trimesh takes about a second); it is started again after it
has died, hung or run out of memory. A bad file costs itself:

    with MeshGuard("meshes") as guard:
        outcome = guard.read("chair.glb")        # outcome.status: "loaded", "empty" or "rejected"

    for outcome in read_folder("meshes"):        # goes on after every bad file
        ...

Limits are enforced by the system where it can: time on every POSIX system, memory on Linux
(``MeshGuard.memory_capped`` says so). The first limit of time counts computing only, so that a busy machine reads
the same files as an idle one.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection, Pipe
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from ...core.errors import InvalidArgument, MissingExtra
from .files import MeshFile, mesh_suffixes
from .reading import MOST_TRIANGLES, Array
from .repair import RepairOptions

LOADED, EMPTY, REJECTED = "loaded", "empty", "rejected"
_MOST_RECORD = 1 << 20
_START = (
    "import sys, json; sys.path[:] = json.loads(sys.argv[1]); "
    "from unghost.data_recipes.meshes.worker import main; main(int(sys.argv[2]), int(sys.argv[3]))"
)


@dataclass(frozen=True)
class GuardLimits:
    """What one file may cost.

    Attributes:
        cpu_seconds: computing, > 0; how busy the machine is does not change which files are read.
        wall_seconds: in all, > 0; for a reader that waits instead of computing.
        memory_megabytes: by which the reader may grow, at least 64.
        startup_seconds: starting the reader, which is no fault of the file.

    Raises:
        ValueError: a limit outside its range.
    """

    cpu_seconds: float = 30.0
    wall_seconds: float = 240.0
    memory_megabytes: int = 2048
    startup_seconds: float = 600.0

    def __post_init__(self) -> None:
        for name, least in (("cpu_seconds", 0), ("wall_seconds", 0), ("startup_seconds", 0), ("memory_megabytes", 63)):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > least):
                raise InvalidArgument(f"GuardLimits: {name} must be finite and > {least}, got {value}")


@dataclass(frozen=True)
class MeshOutcome:
    """How one file ended.

    Attributes:
        path: as it was asked for.
        status: ``"loaded"``, ``"empty"`` (sound, without a triangle) or ``"rejected"``.
        reason: why it was not loaded; empty where it was.
        mesh: what was read, where it was loaded.
        seconds: from asking to having the answer; starting the reader does not count.
    """

    path: Path
    status: str
    reason: str
    mesh: MeshFile | None
    seconds: float


class _ReaderDied(Exception):
    """The reader process ended or was ended; the message says why."""


class MeshGuard:
    """A reader of the mesh files of one folder that survives them; a context manager.

    Args:
        root: the folder that no file, and nothing a file refers to, may leave.
        limits: what one file may cost, its repair included.
        repair: how to repair what is loaded; not at all unless given.

    Raises:
        NotADirectoryError: no such folder.
    """

    def __init__(
        self, root: str | Path, *, limits: GuardLimits | None = None, repair: RepairOptions | None = None
    ) -> None:
        self.root = Path(root)
        if not self.root.is_dir():
            raise NotADirectoryError(f"MeshGuard: {self.root} is not a folder")
        self.limits = limits or GuardLimits()
        self.repair = repair
        self.memory_capped: bool | None = None
        self.starts = 0
        self._process: subprocess.Popen[bytes] | None = None
        self._connection: Connection | None = None

    @property
    def pid(self) -> int | None:
        """The reader's process number while there is one."""
        return self._process.pid if self._process is not None else None

    def read(self, path: str | Path) -> MeshOutcome:
        """Read one file, named from the guard's folder (an absolute path within it will do).

        Raises:
            ImportError: trimesh is not installed.
            RuntimeError: the reader process cannot be started.
        """
        for fresh in (False, True):  # a reader that was found dead before it read anything is no fault of the file
            try:
                self._start()
                self._send(self.root / path)
                self._receive(_MOST_RECORD, self.limits.startup_seconds)
                begun = time.perf_counter()
                break
            except _ReaderDied:
                self.close()
                if fresh:
                    raise RuntimeError("MeshGuard: the reader process dies as soon as it is started") from None
        try:
            record = json.loads(self._receive(_MOST_RECORD, self._seconds))
            mesh = self._mesh(record) if record["status"] == LOADED else None
        except _ReaderDied as death:
            self.close()
            return MeshOutcome(Path(path), REJECTED, str(death), None, time.perf_counter() - begun)
        if not record["again"]:
            self.close()
        return MeshOutcome(Path(path), record["status"], record["reason"], mesh, time.perf_counter() - begun)

    def close(self) -> None:
        """End the reader process, if there is one; the next :meth:`read` starts another."""
        if self._connection is not None:
            self._connection.close()
        if self._process is not None:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()
        self._process, self._connection = None, None

    def __enter__(self) -> MeshGuard:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close()

    @property
    def _seconds(self) -> float:
        return self.limits.wall_seconds

    def _start(self) -> None:
        """Start the reader unless it runs, and wait until it is ready."""
        if self._process is not None and self._process.poll() is None:
            return
        self.close()
        ours, theirs = Pipe(duplex=True)
        paths = [path or os.getcwd() for path in sys.path]
        arguments = [json.dumps(paths), str(theirs.fileno()), str(self.limits.memory_megabytes)]
        self._process = subprocess.Popen(
            [sys.executable, "-I", "-c", _START, *arguments],
            pass_fds=(theirs.fileno(),),
            start_new_session=True,
            env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        theirs.close()
        self._connection = ours
        self.starts += 1
        try:
            ready = json.loads(self._receive(_MOST_RECORD, self.limits.startup_seconds))
        except _ReaderDied as death:
            self.close()
            raise RuntimeError(f"MeshGuard: the reader process did not start ({death})") from None
        if "missing" in ready:
            self.close()
            raise MissingExtra("MeshGuard: reading meshes needs trimesh: pip install unghost[recipes]")
        self.memory_capped = bool(ready["capped"])

    def _send(self, path: Path) -> None:
        assert self._connection is not None
        request = {
            "path": str(path),
            "root": str(self.root),
            "seconds": self._seconds,
            "cpu": self.limits.cpu_seconds,
            "repair": None if self.repair is None else dataclasses.asdict(self.repair),
        }
        try:
            self._connection.send_bytes(json.dumps(request).encode())
        except OSError:
            raise _ReaderDied("the reader was gone") from None

    def _receive(self, most: int, seconds: float) -> bytes:
        """One message of at most ``most`` bytes within ``seconds``."""
        assert self._connection is not None
        assert self._process is not None
        try:
            if not self._connection.poll(seconds):
                raise _ReaderDied(f"it took longer than {seconds:g} s")
            return self._connection.recv_bytes(most)
        except (EOFError, OSError):
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(1.0)
            raise _ReaderDied(_death(self._process.poll(), self.limits)) from None

    def _mesh(self, record: dict[str, Any]) -> MeshFile:
        """The mesh that follows a record; what does not add up counts as a reader gone wrong."""
        try:
            shape = [int(n) for n in record["shape"]]
            if len(shape) != 3 or shape[1:] != [3, 3] or not 0 < shape[0] <= MOST_TRIANGLES:
                raise ValueError
            raw = self._receive(72 * shape[0], self._seconds)
            triangles: Array = np.frombuffer(raw, dtype=np.float64).reshape(shape).copy()
            center = np.array(record["center"], dtype=np.float64).reshape(3)
            sides = tuple((str(name), str(digest)) for name, digest in record["side_files"])
            extent, dropped = float(record["extent"]), int(record["dropped"])
            if not np.isfinite(triangles).all():
                raise ValueError
        except (KeyError, ValueError, TypeError):
            raise _ReaderDied("the reader gave an answer that does not add up") from None
        return MeshFile(triangles, center, extent, dropped, str(record["sha256"]), sides)


def _death(code: int | None, limits: GuardLimits) -> str:
    """What an exit status says of a reader's end."""
    if code == -signal.SIGPROF:  # of the clock that the worker sets itself
        return f"it computed for longer than {limits.cpu_seconds:g} s"
    if code is None or code >= 0:
        return f"the reader died of it ({'no word' if code is None else f'exit status {code}'})"
    name = signal.Signals(-code).name if -code in {s.value for s in signal.Signals} else f"signal {-code}"
    return f"the reader died of it ({name})"


def mesh_paths(root: str | Path) -> list[Path]:
    """The files below a folder whose suffix is a mesh format's, relative to it, in the order of their names.

    Folders behind links are not entered.
    """
    suffixes = set(mesh_suffixes())
    found = []
    for folder, _, names in os.walk(root):
        found += [Path(folder, name).relative_to(root) for name in names if Path(name).suffix[1:].lower() in suffixes]
    return sorted(found, key=lambda path: path.as_posix())


def read_folder(
    root: str | Path,
    paths: Iterable[str | Path] | None = None,
    *,
    limits: GuardLimits | None = None,
    repair: RepairOptions | None = None,
) -> Iterator[MeshOutcome]:
    """Read the mesh files of a folder, one outcome each, whatever they hold.

    Args:
        root: the folder.
        paths: which files, from the folder (a manifest's, say); all of :func:`mesh_paths` unless given. One that is
            not there is rejected like any other.
        limits: what one file may cost.
        repair: how to repair what is loaded; not at all unless given.

    Raises:
        ImportError: trimesh is not installed.
        NotADirectoryError: no such folder.
    """
    with MeshGuard(root, limits=limits, repair=repair) as guard:
        for path in mesh_paths(root) if paths is None else paths:
            yield guard.read(path)
