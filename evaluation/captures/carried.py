"""Keys of a ``transforms.json`` that are not read here and go along when a capture is written again."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from .photos import find_photos
from .splits import FILE_LISTS
from .transforms import DISTORTION_KEYS, LENS_KEYS, clean_name

STATED_ANEW = (  # by write_transforms, or worth nothing beside what it states
    *("camera_model", "is_fisheye", "w", "h", "frames", "file_path", "transform_matrix"),
    *("camera_angle_x", "camera_angle_y", *LENS_KEYS, *DISTORTION_KEYS, *FILE_LISTS),
)
FOLDERS = {"mask_path": "masks", "depth_file_path": "depths", "image_path": "image_files"}  # others: by their key
PATH = "_path"


def carried_keys(keys: Mapping[str, Any]) -> dict[str, Any]:
    """What a file, or a frame, says beside poses, lenses and lists.

    Example:
        >>> carried_keys({"fl_x": 60.0, "applied_scale": 1.0, "mask_path": "masks/a.png"})
        {'applied_scale': 1.0, 'mask_path': 'masks/a.png'}
    """
    return {key: value for key, value in keys.items() if key not in STATED_ANEW}


def carry_frames(frames: Sequence[Mapping[str, Any]], folder: Path) -> tuple[list[dict[str, Any]], dict[str, Path]]:
    """Further keys of frames, paths among them (``mask_path``, ``depth_file_path``, …) renamed for a new folder.

    Args:
        frames: as they stand in the file.
        folder: that the paths start from.

    Returns:
        Keys per frame, and of the files to be put into the new folder: name there -> where it is. A warning counts the
        paths that lead to no file, which are left out.
    """
    carried = [carried_keys(frame) for frame in frames]
    files: dict[str, Path] = {}
    for key in sorted({key for each in carried for key, value in each.items() if _is_path(key, value)}):
        having = [number for number, each in enumerate(carried) if _is_path(key, each.get(key))]
        found, _ = find_photos([clean_name(carried[number][key]) for number in having], folder)
        below = FOLDERS.get(key, f"{key.removesuffix(PATH).removesuffix('_file')}s")
        times = Counter(path.name for path in set(found) if path is not None)
        _warn_of_lost(key, sum(path is None for path in found), f"{len(having)} frames")
        for number, path in zip(having, found):
            if path is None:
                del carried[number][key]
                continue
            name = f"{below}/{path.name}" if times[path.name] == 1 else f"{below}/{number:05d}_{path.name}"
            carried[number][key] = name
            files[name] = path
    return carried, files


def carry_file_keys(meta: Mapping[str, Any], folder: Path) -> tuple[dict[str, Any], dict[str, Path]]:
    """Further keys of the file, as :func:`carry_frames` does: ``ply_file_path`` keeps its file name."""
    carried, files = carried_keys(meta), {}
    for key in [key for key, value in carried.items() if _is_path(key, value)]:
        (path,), _ = find_photos([clean_name(carried[key])], folder)
        if path is None:
            del carried[key]
            _warn_of_lost(key, 1, "1 file")
        else:
            carried[key] = path.name
            files[path.name] = path
    return carried, files


def _is_path(key: str, value: Any) -> bool:
    return key.endswith(PATH) and isinstance(value, str)


def _warn_of_lost(key: str, count: int, whole: str) -> None:
    if count:
        warnings.warn(
            f"write_nerfstudio: {key} leads to no file in {count} of {whole} and is left out there", stacklevel=4
        )
