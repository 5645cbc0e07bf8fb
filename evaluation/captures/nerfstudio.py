"""Writing a capture as a folder that stock nerfstudio (1.1.5) reads: photos, poses, and lists of who trains."""

from __future__ import annotations

import posixpath
import shutil
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.errors import InvalidArgument
from ...core.io import new_folder, write_json
from .carried import carry_file_keys, carry_frames
from .loading import Capture
from .photos import HEIC_ENDINGS, store_photo, stored_name
from .transforms import write_transforms

PHOTOS = ("copy", "link")


def file_lists(train: Sequence[str], evaluation: Sequence[str]) -> dict[str, list[str]]:
    """nerfstudio's three lists: it wants all of them as soon as there is one, and they override its ``--eval-mode``."""
    return {"train_filenames": [*train], "val_filenames": [*evaluation], "test_filenames": [*evaluation]}


def write_splits(path: str | Path, sweeps: Mapping[str, Sequence[str]]) -> None:
    """``splits.json``: sweep -> names of its photos."""
    write_json(path, {sweep: list(names) for sweep, names in sweeps.items()}, parents=False)


def write_nerfstudio(
    capture: Capture,
    out: str | Path,
    *,
    train: Iterable[int] | NDArray[np.integer[Any]],
    evaluation: Iterable[int] | NDArray[np.integer[Any]],
    photos: str = "copy",
) -> None:
    """Write ``transforms.json`` with file lists, ``splits.json`` and the photos of two sweeps into a new folder.

    Photos of neither sweep are left out: nerfstudio scales the poses of *all* frames in the file to +-1, so that these
    are the two sweeps together, as the paper has it. Photos lie in ``images`` under their own names (with their
    folders' where two have the same), as nerfstudio's downscaled copies need. HEIC photos, and those that were read
    turned as their EXIF tags say, are stored anew, because nerfstudio would not read them so.

    What else the capture's ``transforms.json`` and its frames say goes along: the files of ``mask_path``,
    ``depth_file_path`` and ``ply_file_path`` (any key that ends in ``_path``) are put into the new folder, too.

    Args:
        capture: read with ``downscale=1, normalize=False``.
        out: must not exist, or be empty. Written whole or not at all.
        train, evaluation: positions in the capture. Order does not matter to nerfstudio, which sorts.
        photos: ``"copy"``, or ``"link"``: symbolic links to where they are.

    Raises:
        ValueError: an empty sweep, a capture that was scaled, or a folder that is in use.
    """
    target, sweeps = Path(out), {"train": [int(k) for k in train], "eval": [int(k) for k in evaluation]}
    if photos not in PHOTOS:
        raise InvalidArgument(f"write_nerfstudio: photos must be one of {', '.join(PHOTOS)}, got {photos!r}")
    if not all(sweeps.values()):
        raise InvalidArgument(
            f"write_nerfstudio: both sweeps need photos, got {len(sweeps['train'])} and {len(sweeps['eval'])}"
        )
    if (capture.transform != np.eye(4)).any() or capture.photo_size(0) != capture.cameras.size(0):
        raise InvalidArgument("write_nerfstudio: capture must be read with downscale=1 and normalize=False")
    with new_folder(target) as partial:
        chosen = sorted({*sweeps["train"], *sweeps["eval"]})
        names = dict(zip(chosen, _flat_names([capture.paths[k] for k in chosen], [capture.names[k] for k in chosen])))
        (partial / "images").mkdir()
        for index, name in names.items():
            source, turned = capture.paths[index].resolve(), index in capture.upright
            if photos == "link" and not turned and source.suffix.lower() not in HEIC_ENDINGS:
                (partial / name).symlink_to(source)
            else:
                store_photo(source, partial / name, upright=turned)
        frame_keys, beside = carry_frames([capture.frames[k] for k in chosen] if capture.frames else [], capture.folder)
        file_keys, more = carry_file_keys(capture.meta, capture.folder)
        for name, source in {**beside, **more}.items():
            (partial / name).parent.mkdir(exist_ok=True)
            if photos == "link":
                (partial / name).symlink_to(source.resolve())
            else:
                shutil.copyfile(source, partial / name)
        lists = {sweep: [names[k] for k in indices] for sweep, indices in sweeps.items()}
        write_transforms(
            partial / "transforms.json",
            capture.cameras.select(chosen),
            [names[k] for k in chosen],
            file_lists(lists["train"], lists["eval"]),
            frame_keys or None,
            **file_keys,
        )
        write_splits(partial / "splits.json", lists)


def _flat_names(paths: Sequence[Path], names: Sequence[str]) -> list[str]:
    """``images/<file>``, with the folders of the photo's name before it where files are called alike."""
    files = [stored_name(path.name) for path in paths]
    if len(set(files)) == len(files):
        return [f"images/{file}" for file in files]
    parts = [posixpath.dirname(name).removeprefix("images").split("/") for name in names]
    folders = ["_".join(part for part in each if part not in ("", "..")) for each in parts]
    flat = [f"{folder}_{file}" if folder else file for folder, file in zip(folders, files)]
    if len(set(flat)) != len(flat):
        flat = [f"{number:05d}_{file}" for number, file in enumerate(files)]
    return [f"images/{file}" for file in flat]
