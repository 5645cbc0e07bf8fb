"""Cache of fitted fields and renderings on disk, shared by the long measurements."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors.torch import load_file, save

import unghost.fields
from unghost.core.io import atomic_file, write_bytes, write_text
from unghost.fields.radiance import RadianceConfig, RadianceField

from .progress import say

Views = dict[str, NDArray[Any]]


def training_hooks(regularizer: Any) -> dict[str, Any]:
    """What ``train_field`` is to be told of a :class:`DensityRegularizer`: its losses, and what it may observe."""
    return {
        "regularizer": lambda field, step: sum(regularizer(field.density_fn).values()),
        "observer": regularizer.observe,
    }


def file_hash(path: str | Path) -> str:
    """SHA-256 of a file; ``unknown`` if there is none."""
    source = Path(path)
    return hashlib.sha256(source.read_bytes()).hexdigest() if source.is_file() else "unknown"


def code_hash(*packages: Any) -> str:
    """Of every module in the packages' folders."""
    files = [file for package in packages for file in sorted(Path(package.__file__).parent.rglob("*.py"))]
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()[:16]


class FitCache:
    """Fields and renderings under the hash of what made them; each is there whole or not at all."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)

    def _path(self, name: str, key: dict[str, Any], suffix: str) -> Path:
        digest = hashlib.sha256(json.dumps(key, sort_keys=True).encode()).hexdigest()[:16]
        return self.folder / f"{name}-{digest}{suffix}"

    def field(
        self, name: str, key: dict[str, Any], config: RadianceConfig, fit: Callable[[RadianceField], dict[str, Any]]
    ) -> tuple[RadianceField, dict[str, Any]]:
        """The field that ``fit`` made, and its record: what ``fit`` returned, ``code`` and ``sha256``.

        Args:
            name: for people.
            key: all that the fit depends on besides ``config`` and the code. Code that has changed since
                is told, and stands in the record, but does not discard hours of fitting.
            config: of the field.
            fit: trains the fresh field that it is given.
        """
        path = self._path(name, {**key, "config": dataclasses.asdict(config)}, ".safetensors")
        field = RadianceField(config)
        note = path.with_suffix(".json")
        if note.exists():
            record = json.loads(note.read_text(encoding="utf-8"))
            state = load_file(path)
            field.resample(*(round(len(state[table]) ** (1 / 3)) for table in ("density_table", "color_table")))
            field.load_state_dict(state)
            stale = "" if record["code"] == code_hash(unghost.fields) else " (fields/ has changed since)"
            say(f"    from the cache{stale}")
            return field, record
        record = {**fit(field), "code": code_hash(unghost.fields)}
        write_bytes(path, save({entry: value.detach().contiguous() for entry, value in field.state_dict().items()}))
        record["sha256"] = file_hash(path)
        write_text(note, json.dumps(record))
        return field, record

    def views(self, name: str, key: dict[str, Any], make: Callable[[], Views]) -> Views:
        """The arrays that ``make`` returned; ``key`` is all that they depend on, the code's hash included."""
        path = self._path(name, key, ".npz")
        if path.exists():
            with np.load(path) as stored:
                return dict(stored)
        made = make()
        with atomic_file(path) as stream:
            np.savez(stream, **made)  # type: ignore[arg-type]
        return made
