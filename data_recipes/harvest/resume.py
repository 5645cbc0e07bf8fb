"""Which scenes of a harvest are there already, whole, and its own."""

from __future__ import annotations

from pathlib import Path

from ...core.config import to_dict
from ...core.errors import InvalidArgument
from ...core.shards.storage import read_shard
from .config import HarvestConfig


def scene_folder(folder: str | Path, index: int) -> Path:
    """Where scene ``index`` of a harvest is stored."""
    return Path(folder) / f"scene-{index:05d}"


def finished(
    folder: str | Path, seed: int, index: int, config: HarvestConfig, *, fit: bool = True, meshes: bool = False
) -> bool:
    """Whether a scene is stored, its hashes checked.

    Args:
        seed, index, config, fit: of the harvest, as :func:`.run.harvest` has them.
        meshes: whether it has a folder of meshes.

    Raises:
        ValueError: the shard is damaged, or another harvest's.
    """
    target = scene_folder(folder, index)
    if not target.exists():
        return False
    told = read_shard(target, verify=True).provenance
    settings = told.get("config") or {}
    wanted = {"recipe": "harvest" if fit else "rooms", "seed": seed, "scene": index}
    given = {key: value for key, value in to_dict(config).items() if key in settings}
    differing = [f"{key}: {told.get(key)!r}, not {value!r}" for key, value in wanted.items() if told.get(key) != value]
    differing += [f"{key}: {settings[key]!r}, not {value!r}" for key, value in given.items() if settings[key] != value]
    if told.get("meshes") and not meshes:
        differing.append("meshes: some, not none")
    if differing:
        raise InvalidArgument(
            f"harvest: {target} is of another harvest ({'; '.join(differing)}): choose another out folder or remove it"
        )
    return True
