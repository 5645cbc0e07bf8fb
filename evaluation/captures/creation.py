"""A capture from two videos or two folders of photos, as the paper has it: one to train on, one to be scored on."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path
from typing import Any

from ...core.errors import InvalidArgument, MissingFile
from ...core.io import new_folder, write_json
from .colmap import import_pycolmap
from .frames import Extraction, extract_frames, import_libraries
from .loading import load_capture
from .nerfstudio import file_lists, write_splits
from .posing import NotJoinedError, Posing, PosingSettings, Progress, check_pycolmap, pose_jointly
from .resuming import IMAGES, read_extractions, work_folder, write_extractions
from .transforms import write_transforms

PREFIXES = {"train": "frame_", "eval": "frame_1_"}  # the names of the released Nerfbusters captures
MODEL = "sparse/0"


def make_capture(
    train: str | Path,
    evaluation: str | Path,
    out: str | Path,
    *,
    frames: int = 100,
    settings: PosingSettings | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Extract the sharpest frames of two sweeps, pose them jointly, and write a folder that ``load_capture`` reads.

    So does stock nerfstudio: ``transforms.json`` has its file lists. Photos are named as in the released Nerfbusters
    captures, ``images/frame_00001.jpg`` and ``images/frame_1_00001.jpg``; those without a pose lie there too. COLMAP's
    model and its points are in ``sparse/0``, in the same world: COLMAP's, of which neither the unit nor "up" is known.

    Args:
        train, evaluation: a video, or a folder of photos, each. All pictures must have one size.
        out: must not exist, or be empty. Written whole or not at all. Until then, frames, features, matches and
            models are in ``OUT.xxxxxxxx.work`` beside it: after a crash, the same call goes on from there.
        frames: at most so many are kept of each sweep.
        settings: of the posing.
        progress: as in :func:`~unghost.evaluation.captures.posing.pose_jointly`.

    Returns:
        what ``capture.json`` in the folder says: per sweep its ``source``, how many pictures it ``seen`` had, were
        ``kept`` and ``posed``; ``unposed`` names, ``reprojection_error`` in pixels, ``points``, ``mapping`` (which of
        COLMAP's the poses are from), ``frames`` (what each photo was in its source), ``versions`` and ``seed``.

    Raises:
        FileNotFoundError, ValueError, ImportError: of the steps.
    """
    how = settings or PosingSettings()
    if frames < 1:
        raise InvalidArgument(f"make_capture: frames must be >= 1, got {frames}")
    sources = {"train": Path(train), "eval": Path(evaluation)}
    for sweep, source in sources.items():
        if not source.exists():
            purpose = "to train on" if sweep == "train" else "to be scored on"
            raise MissingFile(f"make_capture: no video or folder {source} {purpose}")
    _check_libraries(sources)
    with new_folder(Path(out)) as partial, work_folder(Path(out), sources, frames, how) as work:
        images, stored = work / IMAGES, read_extractions(work)
        if stored is None:
            shutil.rmtree(images, ignore_errors=True)
            taken = {
                sweep: extract_frames(source, images, prefix=PREFIXES[sweep], count=frames)
                for sweep, source in sources.items()
            }
            write_extractions(work, taken)
        else:
            taken = stored
        sizes = {sweep: f"{found.size[0]} x {found.size[1]}" for sweep, found in taken.items()}
        if len(set(sizes.values())) > 1:
            raise InvalidArgument(
                f"make_capture: both sweeps must have pictures of one size, got train {sizes['train']}, eval "
                f"{sizes['eval']}; record both alike, or resize one"
            )
        names = {sweep: [path.name for path in found.paths] for sweep, found in taken.items()}
        try:
            posing = pose_jointly(images, names, out=partial / MODEL, settings=how, progress=progress, work=work)
        except NotJoinedError as error:
            raise NotJoinedError(
                f"{error}; what was computed is kept in {work}: the same call with a smaller minimum_share goes on "
                "from there"
            ) from None
        except ValueError as error:
            kept = {
                source: _keep_frames(images, names[sweep], Path(f"{out}.{sweep}"))
                for sweep, source in sources.items()
                if source.is_file()
            }
            if not kept:
                raise
            said = " and ".join(f"those of {source} in {folder}" for source, folder in kept.items())
            raise InvalidArgument(
                f"{error}; the frames are kept, {said}: a folder can be given in a video's place"
            ) from None
        shutil.copytree(images, partial / "images")
        sweeps = {sweep: [f"images/{name}" for name in found] for sweep, found in posing.posed.items()}
        capture = load_capture(partial, downscale=1, normalize=False, splits=sweeps)
        write_transforms(
            partial / "transforms.json",
            capture.cameras,
            capture.names,
            file_lists(sweeps["train"], sweeps["eval"]),
            ply_file_path=f"{MODEL}/points3D.ply",
        )
        write_splits(partial / "splits.json", sweeps)
        told = _told(sources, taken, posing, how)
        write_json(partial / "capture.json", told)
    return told


def _check_libraries(sources: dict[str, Path]) -> dict[str, str]:
    """The versions of what is needed, before minutes of work.

    Raises:
        ImportError: a library is missing, does not load, or is too old; names the extra or the reason.
    """
    videos = any(source.is_file() for source in sources.values())
    names = ("av", "PIL.Image") if videos else ("PIL.Image",)
    modules = {"pycolmap": check_pycolmap(import_pycolmap("make_capture"), caller="make_capture")}
    modules |= dict(zip(names, import_libraries(*names)))
    return {name: str(getattr(modules[name], "__version__", "?")) for name in ("pycolmap", "av") if name in modules}


def _keep_frames(images: Path, names: list[str], beside: Path) -> Path:
    """Move the frames of a video, minutes of work, into a new folder."""
    kept = Path(tempfile.mkdtemp(prefix=f"{beside.name}.", dir=beside.parent))
    for name in names:
        shutil.move(images / name, kept / name)
    return kept


def _told(
    sources: dict[str, Path], taken: dict[str, Extraction], posing: Posing, how: PosingSettings
) -> dict[str, Any]:
    """How the capture came about; names of files only, not where they lay."""
    return {
        **{
            sweep: {
                "source": source.name,
                "seen": taken[sweep].seen,
                "kept": len(taken[sweep].paths),
                "posed": len(posing.posed[sweep]),
            }
            for sweep, source in sources.items()
        },
        "unposed": list(posing.unposed),
        "reprojection_error": posing.reprojection_error,
        "points": posing.points,
        "mapping": posing.mapping,
        "seed": how.seed,
        "versions": _check_libraries(sources),
        "frames": {path.name: was for each in taken.values() for path, was in zip(each.paths, each.sources)},
    }
