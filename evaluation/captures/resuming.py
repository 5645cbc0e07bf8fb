"""What :func:`make_capture` has computed so far, in a folder that the same call finds again."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ...core.errors import InvalidArgument, InvalidFile, MissingFile
from ...core.io import read_json, write_json
from .frames import Extraction
from .posing import NotJoinedError, PosingSettings

IMAGES, EXTRACTION, ENDING = "images", "extraction.json", ".work"
NOT_OF_THE_RESULT = ("minimum_share", "threads")  # settings of the posing that do not change what is computed


@contextmanager
def work_folder(out: Path, sources: Mapping[str, Path], frames: int, settings: PosingSettings) -> Iterator[Path]:
    """A folder ``OUT.xxxxxxxx.work`` beside ``out``, named after the request: the same call gets the same one.

    It goes when the block ends, and with an error that the same call would only give again (a wrong argument or file).
    With any other error, and when the process is killed, it stays; so it does where another minimum share would do.
    """
    request = {
        "sources": {sweep: _fingerprint(source) for sweep, source in sources.items()},
        "frames": frames,
        "settings": {k: v for k, v in dataclasses.asdict(settings).items() if k not in NOT_OF_THE_RESULT},
    }
    digest = hashlib.sha256(json.dumps(request, sort_keys=True).encode()).hexdigest()[:8]
    work = out.with_name(f"{out.name}.{digest}{ENDING}")
    work.mkdir(parents=True, exist_ok=True)
    try:
        yield work
    except NotJoinedError:
        raise
    except (InvalidArgument, InvalidFile, MissingFile):
        shutil.rmtree(work, ignore_errors=True)
        raise
    shutil.rmtree(work, ignore_errors=True)


def _fingerprint(source: Path) -> list[tuple[str, int, int]]:
    """Names, sizes and times of a video, or of the files of a folder."""
    files = [source] if source.is_file() else sorted(path for path in source.iterdir() if path.is_file())
    return [(str(path.resolve()), path.stat().st_size, path.stat().st_mtime_ns) for path in files]


def read_extractions(work: Path) -> dict[str, Extraction] | None:
    """The photos that an earlier call has extracted, by sweep; None if it did not finish that."""
    if not (work / EXTRACTION).is_file():
        return None
    stored = read_json(work / EXTRACTION, caller="make_capture")
    return {
        sweep: Extraction(
            tuple(work / IMAGES / name for name in each["names"]),
            tuple(each["sources"]),
            each["seen"],
            (each["size"][0], each["size"][1]),
        )
        for sweep, each in stored.items()
    }


def write_extractions(work: Path, taken: Mapping[str, Extraction]) -> None:
    """Store what :func:`read_extractions` gives back."""
    content: dict[str, Any] = {
        sweep: {
            "names": [path.name for path in each.paths],
            "sources": list(each.sources),
            "seen": each.seen,
            "size": list(each.size),
        }
        for sweep, each in taken.items()
    }
    write_json(work / EXTRACTION, content)
