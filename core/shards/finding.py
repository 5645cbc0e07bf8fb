"""Find shards on disk: one, the shards of a folder, or a weighted choice of them."""

from __future__ import annotations

from pathlib import Path

from ..errors import InvalidArgument
from .storage import read_shard


def find_shards(folder: str | Path) -> list[Path]:
    """List the shard ``folder``, or the shards in it, in order of their names; unfinished ones are left out.

    Raises:
        ValueError: neither a shard nor a folder with one.

    Example:
        >>> find_shards("absent")
        Traceback (most recent call last):
        ...
        unghost.core.errors.InvalidArgument: find_shards: absent is not a shard and holds none
    """
    root = Path(folder)
    if (root / "manifest.json").is_file():
        return [root]
    found = sorted(path.parent for path in root.glob("*/manifest.json") if path.parent.suffix != ".partial")
    if not found:
        raise InvalidArgument(f"find_shards: {root} is not a shard and holds none")
    return found


def expand_shards(spec: str) -> list[tuple[Path, float]]:
    """Turn ``FOLDER`` or ``FOLDER=WEIGHT`` into shards and their weights.

    The shards of a folder share its weight by their length.

    Raises:
        ValueError: the weight is not a number > 0, or there is no shard.

    Example:
        >>> expand_shards("absent=-1")
        Traceback (most recent call last):
        ...
        unghost.core.errors.InvalidArgument: expand_shards: the weight in 'absent=-1' must be finite and > 0
    """
    name, separator, number = spec.rpartition("=")
    folder = Path(name if separator else spec)
    try:
        weight = float(number) if separator else 1.0
    except ValueError:
        raise InvalidArgument(f"expand_shards: {spec!r} must be FOLDER or FOLDER=WEIGHT, the weight a number") from None
    if not 0 < weight < float("inf"):
        raise InvalidArgument(f"expand_shards: the weight in {spec!r} must be finite and > 0")
    found = find_shards(folder)
    if found == [folder]:
        return [(folder, weight)]
    lengths = [len(read_shard(path)) for path in found]
    return [(path, weight * length / sum(lengths)) for path, length in zip(found, lengths)]
