"""One run at a time in a folder, by a lock that ends with the process that holds it."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from filelock import BaseFileLock

NAME = ".lock"


@contextmanager
def locked(folder: str | Path, *, verb: str) -> Iterator[None]:
    """Make the folder if it is absent, and keep other runs out of it for the length of a ``with``.

    A folder that was made here and in which nothing was written is removed at the end.

    The lock is the system's (by ``filelock``) on ``folder/.lock``: it ends with the process that holds it, however
    that ends. A killed run leaves the file behind, which means nothing and is used and removed by the next one.

    Where there is no such lock (a file system or a platform without locks; a folder that may not be written) there is
    none, and two runs at once are the caller's to avoid: they would undo each other's unfinished shards. A shard that
    they spoil does not match its hashes, so that the next run refuses it. Without ``filelock`` (extras ``recipes``
    and ``torch``) there is none either, and a warning says so.

    Args:
        folder: its parents may be absent too.
        verb: of the message, ``curate`` or ``harvest``.

    Raises:
        BlockingIOError: another run holds it.
        OSError: the folder cannot be made.
    """
    path, absent = Path(folder) / NAME, not Path(folder).exists()
    path.parent.mkdir(parents=True, exist_ok=True)
    lock = _lock(path, verb)
    try:
        yield
    finally:
        if lock is not None:
            _remove(path)  # before the lock ends, so that no other run's file is removed
            lock.release()
            if os.name == "nt":  # an open file cannot be removed there, another run's neither
                _remove(path)
        if absent:
            with suppress(OSError):
                path.parent.rmdir()  # if it is still empty


def _lock(path: Path, verb: str) -> BaseFileLock | None:
    """A lock that is held; None where the system has none."""
    try:
        from filelock import FileLock, SoftFileLock, Timeout
    except ImportError:
        warnings.warn(
            f"{verb}: filelock is not installed, so a second run in {path.parent} would not be refused: "
            "pip install unghost[recipes]",
            stacklevel=4,
        )
        return None
    if FileLock is SoftFileLock:  # filelock's substitute where there is no flock: it outlives a killed run
        return None
    lock = FileLock(path, preserve_lock_file=True, fallback_to_soft=False)
    try:
        lock.acquire(blocking=False)
    except Timeout:
        holder = _holder(path)
        raise BlockingIOError(
            f"{verb}: another run is at work in {path.parent}{f' (process {holder})' if holder else ''}: "
            "wait for its end, or choose another out folder"
        ) from None
    except PermissionError:  # a folder that may not be written, or another user's file in it
        return None
    except OSError:  # a file system without locks
        _remove(path)
        return None
    with suppress(OSError):  # a full disk, say: who holds it is only for the message
        path.write_text(str(os.getpid()), encoding="ascii")
    return lock


def _holder(path: Path) -> str:
    with suppress(OSError):
        return path.read_bytes()[:20].decode("ascii", "replace")
    return ""


def _remove(path: Path) -> None:
    with suppress(OSError):
        path.unlink()
