"""The one JSON shape for everything measured."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .errors import InvalidArgument
from .io import write_json

REPORTED_PACKAGES = ("numpy", "onnxruntime", "torch", "scipy", "scikit-image", "open3d-cpu", "trimesh")


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that are installed, without importing them."""
    found = {"python": platform.python_version()}
    for name in REPORTED_PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def commit() -> str:
    """The checkout's commit, ``-dirty`` appended if tracked files differ; ``unknown`` outside a checkout.

    What lies under ``docs`` does not count: it is written by the programs whose results are recorded.
    """
    folder = Path(__file__).resolve().parents[1]

    def git(*words: str) -> str:
        return subprocess.run(
            ["git", *words], cwd=folder, capture_output=True, text=True, timeout=10, check=True
        ).stdout.strip()

    try:
        name = git("rev-parse", "--short=12", "HEAD")
        changed = git("status", "--porcelain", "--untracked-files=no", "--", ".", ":!docs")
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return f"{name}-dirty" if changed else name


def machine() -> dict[str, Any]:
    """Processor architecture and cores; nothing that names the host."""
    return {"architecture": platform.machine(), "system": platform.system(), "cores": os.cpu_count()}


def build_results(
    rows: Sequence[Mapping[str, Any]], *, command: str | None = None, seeds: Sequence[int] = (), **extra: Any
) -> dict[str, Any]:
    """Assemble the results object; every row must have a ``method``."""
    for row in rows:
        if "method" not in row:
            raise InvalidArgument(f"build_results: every row needs a 'method', got keys {sorted(row)}")
    if command is None:
        command = " ".join(["python", Path(sys.argv[0]).name, *sys.argv[1:]])
    return {
        "command": command,
        "commit": commit(),
        "versions": versions(),
        "machine": machine(),
        "seeds": list(seeds),
        **extra,
        "rows": [dict(row) for row in rows],
    }


def write_results(path: str | Path, results: Mapping[str, Any]) -> None:
    """Write a results file atomically (:func:`unghost.core.io.write_json`)."""
    write_json(path, results)


def json_ready(value: Any) -> Any:
    """A copy in which NaN and infinities are None (JSON null) and numpy numbers are Python's."""
    if isinstance(value, Mapping):
        return {key: json_ready(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [json_ready(each) for each in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not np.isfinite(value) else value
