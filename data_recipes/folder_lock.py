"""One run at a time in a folder, by a lock that ends with the process that holds it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

NAME = ".lock"


@contextmanager
def locked(folder: str | Path, *, verb: str) -> Iterator[None]:
    """Make the folder if it is absent, and keep other runs out of it for the length of a ``with``.

    A folder that was made here and in which nothing was written is removed at the end.

    The lock is the system's (``flock``) on ``folder/.lock``: it ends with the process that holds it, however that
    ends. A killed run leaves the file behind, which means nothing and is used and removed by the next one.

    Where there is no such lock (no ``fcntl``, as on Windows; a file system without locks; a folder that may not be
    written) there is none, and two runs at once are the caller's to avoid: they would undo each other's unfinished
    shards. A shard that they spoil does not match its hashes, so that the next run refuses it.

    Args:
        folder: its parents may be absent too.
        verb: of the message, ``curate`` or ``harvest``.

    Raises:
        BlockingIOError: another run holds it.
        OSError: the folder cannot be made.
    """
    path, absent = Path(folder) / NAME, not Path(folder).exists()
    path.parent.mkdir(parents=True, exist_ok=True)
    handle = _lock(path, verb)
    try:
        yield
    finally:
        if handle is not None:
            with suppress(OSError):
                path.unlink()  # before the lock ends, so that nobody else's is removed
            os.close(handle)
        if absent:
            with suppress(OSError):
                path.parent.rmdir()  # if it is still empty


def _lock(path: Path, verb: str) -> int | None:
    """An open file that is locked and still the one at ``path``; None where that cannot be had."""
    try:
        import fcntl
    except ImportError:
        return None
    while True:
        try:
            handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        except OSError:
            return None
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.read(handle, 20).decode("ascii", "replace")
            os.close(handle)
            raise BlockingIOError(
                f"{verb}: another run is at work in {path.parent}{f' (process {holder})' if holder else ''}: "
                "wait for its end, or choose another out folder"
            ) from None
        except OSError:  # a file system without locks
            os.close(handle)
            with suppress(OSError):
                path.unlink()
            return None
        if _is_at(handle, path):
            with suppress(OSError):  # a full disk, say: who holds it is only for the message
                os.ftruncate(handle, 0)
                os.write(handle, str(os.getpid()).encode("ascii"))
            return handle
        os.close(handle)  # its holder ended, and removed it, a moment ago


def _is_at(handle: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(handle), path.stat())
    except OSError:
        return False
