"""Sweeps of a capture: which of its photos belong together, from lists in files or from the photos' names alone."""

from __future__ import annotations

import posixpath
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.errors import InvalidArgument
from .transforms import clean_name, first_twice, read_object

FILE_LISTS = {"train_filenames": "train", "val_filenames": "val", "test_filenames": "test"}
TRAIN_NAMES, EVAL_NAMES = ("train",), ("eval", "test", "val")  # sweeps that are meant if none is named
Splits = Mapping[str, Sequence[str]] | str | Path


def resolve_splits(
    names: Sequence[str],
    *,
    meta: Mapping[str, Any],
    folder: Path,
    given: Splits | None = None,
    dropped: Sequence[str] = (),
) -> dict[str, NDArray[np.int64]]:
    """Which photos each sweep has, from the first of these that says so.

    1. ``given``: lists, or a JSON file of them. 2. ``splits.json`` in the folder. 3. nerfstudio's lists in
    ``transforms.json``. 4. The names: the released Nerfbusters captures (``frame_00001`` train, ``frame_1_00001``
    eval); nerfstudio's ``--eval-mode filename`` (every name has "train" or "eval" in it); a sweep a folder, if the
    photos lie in several.

    Args:
        names: of all photos.
        meta: the object of ``transforms.json``.
        folder: where ``splits.json`` may be.
        given: sweep -> file names; a text in place of a list is a note. A file may be named by the end of its path.
        dropped: photos that are known and not there: silently left out of every sweep.

    Returns:
        sweep -> positions in ``names``; empty if nothing tells.

    Raises:
        ValueError: a list that is none or is empty, or names what is in no frame, or in two, or twice.
    """
    if given is not None:
        named: Mapping[str, Any] = read_object(Path(given)) if isinstance(given, (str, Path)) else given
    elif (folder / "splits.json").exists():
        named = read_object(folder / "splits.json")
    else:
        named = {split: meta[key] for key, split in FILE_LISTS.items() if key in meta} or by_name(names)
    position = {name: number for number, name in enumerate(names)}
    result: dict[str, NDArray[np.int64]] = {}
    for split, files in named.items():
        if isinstance(files, str):
            continue  # a note for people
        if isinstance(files, Mapping) or not isinstance(files, Sequence) or not files:
            raise InvalidArgument(f"load_capture: split {split!r} must be a list of file names with at least one")
        if not all(isinstance(file, str) for file in files):
            raise InvalidArgument(f"load_capture: split {split!r} must be a list of file names, got {list(files)[:3]}")
        found = [_the_one(file, position, dropped, split) for file in files]
        kept = [name for name in found if name in position]
        if len(set(found)) != len(found):
            raise InvalidArgument(f"load_capture: split {split!r} lists {first_twice(found)!r} twice")
        if not kept:
            raise InvalidArgument(f"load_capture: none of the {len(found)} photos of split {split!r} is there")
        result[split] = np.array([position[name] for name in kept], dtype=np.int64)
    return result


def _the_one(file: str, position: Mapping[str, int], dropped: Sequence[str], split: str) -> str:
    """The photo that a list means: its name, or one that alone ends in it."""
    name = clean_name(file)
    if name in position or name in dropped:
        return name
    ends = [each for each in (*position, *dropped) if each.endswith(f"/{name}")]
    if len(ends) != 1:
        number = "no frame" if not ends else f"{len(ends)} frames ({', '.join(ends[:3])})"
        raise InvalidArgument(f"load_capture: split {split!r} names {name!r}, which is in {number}")
    return ends[0]


def by_name(names: Sequence[str]) -> dict[str, list[str]]:
    """Sweeps told from file names alone; empty if they do not tell (see :func:`resolve_splits`)."""
    for rule, every in ((_released, False), (_train_or_eval, True), (_folder, True)):
        sweeps: dict[str, list[str]] = {}
        for name in names:
            label = rule(name)
            if label is not None:
                sweeps.setdefault(label, []).append(name)
        if len(sweeps) > 1 and (not every or sum(map(len, sweeps.values())) == len(names)):
            return sweeps
    return {}


def _stem(name: str) -> str:
    return posixpath.splitext(posixpath.basename(name))[0]


def _released(name: str) -> str | None:
    """Two videos: ``frame_00001`` and ``frame_1_00001``."""
    found = re.fullmatch(r"frame_(1_)?\d+", _stem(name))
    return None if found is None else "eval" if found[1] else "train"


def _train_or_eval(name: str) -> str | None:
    return next((label for label in ("train", "eval") if label in _stem(name)), None)


def _folder(name: str) -> str | None:
    return posixpath.dirname(name).removeprefix("images/") or None


def choose_split(
    splits: Mapping[str, Any], named: str | None, usual: Sequence[str], option: str, *, whole: bool = False
) -> str:
    """The sweep that is meant: the one named, else the first of the usual names that there is.

    Args:
        splits: of a capture, by name.
        named: by the user; whether it is there, :meth:`~.loading.Capture.split` says.
        usual: ``TRAIN_NAMES`` or ``EVAL_NAMES``.
        option: for the message.
        whole: a capture without any sweeps means all of it.

    Raises:
        ValueError: nothing is named, and none of the usual names is there.
    """
    if named is not None:
        return named
    found = next((name for name in usual if name in splits), None)
    if found is not None:
        return found
    if whole and not splits:
        return "all"
    known = ", ".join(splits) or "none: --splits can name them, or --train-split all --every 8"
    raise InvalidArgument(f"{option} must say which sweep is meant; the capture has {known}")
