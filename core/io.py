"""Atomic writes of files and folders, and JSON files.

A file is written as ``NAME.partial`` beside its target and moved into place with ``os.replace``: a reader sees the old
file or the whole new one, and an error leaves nothing behind.
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import ArrayLike

from .errors import InvalidArgument, InvalidFile, MissingFile

PARTIAL = ".partial"


@contextmanager
def atomic_file(path: str | Path, *, parents: bool = True, fsync: bool = False) -> Iterator[BinaryIO]:
    """Open a binary stream whose contents become the file ``path`` at the end of the block, or vanish on an error.

    Args:
        path: a new file, or one to be replaced.
        parents: create the folder of ``path`` where it is missing.
        fsync: flush the contents to the disk before the file takes its name, so that a power cut cannot leave it empty.

    Raises:
        OSError: the file cannot be written; one that was there stays.

    Example:
        >>> folder = Path(tempfile.mkdtemp())
        >>> with atomic_file(folder / "a.bin") as stream:
        ...     _ = stream.write(b"whole")
        >>> [path.name for path in folder.iterdir()]
        ['a.bin']
    """
    target = Path(path)
    if parents:
        target.parent.mkdir(parents=True, exist_ok=True)
    partial = target.with_name(target.name + PARTIAL)
    try:
        with partial.open("wb") as stream:
            yield stream
            if fsync:
                stream.flush()
                os.fsync(stream.fileno())
        os.replace(partial, target)
    except BaseException:
        with suppress(OSError):  # the first error is the one to show
            partial.unlink(missing_ok=True)
        raise


def write_bytes(path: str | Path, data: bytes, *, parents: bool = True, fsync: bool = False) -> None:
    """Write a file atomically; arguments and errors as for :func:`atomic_file`.

    Example:
        >>> path = Path(tempfile.mkdtemp()) / "a.bin"
        >>> write_bytes(path, b"whole")
        >>> path.read_bytes()
        b'whole'
    """
    with atomic_file(path, parents=parents, fsync=fsync) as stream:
        stream.write(data)


def write_text(path: str | Path, text: str, *, parents: bool = True) -> None:
    """Write a UTF-8 text file atomically, line ends as they are in ``text``.

    Example:
        >>> path = Path(tempfile.mkdtemp()) / "new folder" / "a.txt"
        >>> write_text(path, "one line\\n")
        >>> path.read_text(encoding="utf-8")
        'one line\\n'
    """
    write_bytes(path, text.encode("utf-8"), parents=parents)


def write_json(path: str | Path, value: Any, *, parents: bool = True) -> None:
    """Write a JSON file atomically: UTF-8, indented by one space, a line end at the end.

    Raises:
        ValueError: a number is NaN or infinite, which JSON does not have.
        TypeError: a value has no JSON form.

    Example:
        >>> path = Path(tempfile.mkdtemp()) / "a.json"
        >>> write_json(path, {"rows": [1, 2]})
        >>> read_json(path, caller="example")
        {'rows': [1, 2]}
    """
    write_text(path, json.dumps(value, indent=1, allow_nan=False) + "\n", parents=parents)


def read_json(path: str | Path, *, caller: str) -> Any:
    """Read a JSON file (UTF-8, or UTF-16 or -32 with a byte order mark); ``caller`` begins the message of an error.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is not JSON.

    Example:
        >>> read_json("absent.json", caller="example")  # doctest: +IGNORE_EXCEPTION_DETAIL
        Traceback (most recent call last):
        MissingFile: example: no file absent.json
    """
    source = Path(path)
    try:
        return json.loads(source.read_bytes())  # bytes: a byte order mark, which Windows editors write, is understood
    except (FileNotFoundError, NotADirectoryError):
        raise MissingFile(f"{caller}: no file {source}") from None
    except (json.JSONDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InvalidFile(f"{caller}: {source} is not JSON ({error})") from None


def write_npz(path: str | Path, *, parents: bool = True, **arrays: ArrayLike) -> None:
    """Write a compressed ``.npz`` file atomically, under exactly the name ``path``.

    Example:
        >>> path = Path(tempfile.mkdtemp()) / "a.npz"
        >>> write_npz(path, weights=np.ones(3))
        >>> np.load(path)["weights"].tolist()
        [1.0, 1.0, 1.0]
    """
    with atomic_file(path, parents=parents) as stream:
        np.savez_compressed(stream, **arrays)  # type: ignore[arg-type]


@contextmanager
def new_folder(path: str | Path, *, unique: bool = True) -> Iterator[Path]:
    """Create a folder to write into, which becomes ``path`` at the end of the block, or vanishes on an error.

    Args:
        path: must not exist, or be an empty folder. Its parent is created where it is missing.
        unique: write into a folder with a random name beside ``path``, so that no other one is touched; False for
            ``NAME.partial``, which replaces what an interrupted run has left under that name.

    Raises:
        ValueError: ``path`` exists and is not an empty folder.

    Example:
        >>> target = Path(tempfile.mkdtemp()) / "capture"
        >>> with new_folder(target) as partial:
        ...     _ = (partial / "a.txt").write_text("whole")
        >>> [path.name for path in target.iterdir()]
        ['a.txt']
    """
    target = Path(path)
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise InvalidArgument(
            f"new_folder: {target} is there already and not empty: choose another folder, or remove it"
        )
    target.parent.mkdir(parents=True, exist_ok=True)
    if unique:
        partial = Path(tempfile.mkdtemp(prefix=f"{target.name}.", suffix=PARTIAL, dir=target.parent))
        partial.chmod(0o777 & ~_umask())  # mkdtemp's are for nobody else
    else:
        partial = target.with_name(target.name + PARTIAL)
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir()
    try:
        yield partial
        if target.exists():
            target.rmdir()
        os.replace(partial, target)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _umask() -> int:
    """Permissions that the user takes away from new folders."""
    mask = os.umask(0)
    os.umask(mask)
    return mask
