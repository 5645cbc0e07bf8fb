"""The verb that cleans files. Its signature is the command line; heavy imports wait for it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, UseAppendAction, arg

from ..cleaning.pipeline import CleanSettings
from ..core.errors import InvalidArgument
from ..core.progress import StagedProgress
from .options import given, options_of
from .prior import Threads

if TYPE_CHECKING:
    from ..cleaning.keep_mask import KeepMask

    CleanOptions = CleanSettings
else:
    _ELSEWHERE = "strength", "keep_boxes", "resolution"  # options of the verb itself, with their own spelling
    _NEEDS_A_FIELD = "field_pitch", "rule", "soft", "skip_empty", "backend", "chunk"
    CleanOptions = options_of(CleanSettings, leave_out=(*_ELSEWHERE, *_NEEDS_A_FIELD))

Box = tuple[float, float, float, float, float, float]


def clean(
    source: Positional[Path],
    out: Annotated[Path | None, arg(aliases=["-o"])] = None,
    keep: Path | None = None,
    preview: Path | None = None,
    mask: Path | None = None,
    keep_box: UseAppendAction[tuple[Box, ...]] = (),
    cameras: Path | None = None,
    denoiser: str = "default",
    strength: float = 0.5,
    resolution: int | None = None,
    reach: float | None = None,
    scores_only: bool = False,
    threads: Threads = 0,
    options: Annotated[CleanOptions, arg(name="")] = CleanOptions(),  # noqa: B008 (frozen)
) -> None:
    """Clean a density grid (.npz) or 3D Gaussians (.ply); writes a cleaned copy and the mask of what stays.

    A grid file has density (X, Y, Z) per scene unit and aabb (2, 3); its cells are cubes.

    Args:
        source: the file to clean; it is not changed.
        out: the cleaned grid or splats; NAME-clean beside it if not given. Every property of a splat that stays is kept
            byte for byte, and keep_score is added.
        keep: the mask of what was kept, with which --mask repeats the cleaning; NAME-keep.npz if not given
            (with --mask: none).
        preview: a PNG to write instead of all that: what would stay and what would go, from three sides; the regions
            that would go are listed.
        mask: a keep mask of an earlier cleaning, applied as it is instead of judging anew.
        keep_box: x0 y0 z0 x1 y1 z1, scene units: nothing in this box is removed; may be given several times. With
            --mask, takes back what that removed there (the boxes of the preview's table, say).
        cameras: of the training photos, in the file's own world: transforms.json (nerfstudio's), cameras.json
            (Inria's) or a COLMAP model; where few or none of them look, ghosts are likelier. The photos are not needed.
            A dataparser_transforms.json (nerfstudio's) beside either file is applied.
        denoiser: a shipped name or an .onnx file.
        strength: 0 removes nothing, 0.5 what the denoiser advises, 1 everything.
        resolution: of splats, cells along the longest side of the box; by the splats' sizes if not given.
        reach: of splats, how many times the scene's core (98 % of the opacity) is cleaned (twice if not given); what
            is beyond stays.
        scores_only: of splats, write all of them with their keep_score, and remove none.
        threads: of onnxruntime; 0 leaves the choice to it.
    """
    from ..cleaning.keep_mask import KeepMask

    splats = source.suffix == ".ply"
    target = None if preview else out or source.with_name(f"{source.stem}-clean{source.suffix}")
    keep = None if preview or (mask and keep is None) else keep or source.with_name(f"{source.stem}-keep.npz")
    _check_distinct(source=source, out=target, keep=keep, preview=preview, mask=mask)
    if not splats and (resolution is not None or reach is not None or scores_only):
        raise InvalidArgument(
            f"clean: --resolution, --reach and --scores-only are for splats (.ply); {source.name} is a grid"
        )
    boxes = [[box[:3], box[3:]] for box in keep_box]
    settings = given(options)
    how: dict[str, Any] = {}
    if mask is not None:
        if settings:
            raise InvalidArgument(f"clean: --mask repeats a cleaning as it was; leave out {', '.join(settings)}")
        how = {"mask": KeepMask.load(mask).restored(boxes)}
    else:
        how = {"keep_boxes": tuple(boxes), **_judging(denoiser, threads, strength, cameras, source)}
        how |= {"settings": CleanSettings(**settings)} if settings else {}
        how |= {"resolution": resolution} if splats else {}
        how |= {} if reach is None else {"reach": reach}
    how |= {"scores_only": scores_only} if splats else {}
    found, density_fn = (_clean_splats if splats else _clean_grid)(source, target, **how)
    if preview:
        from .removal_preview import region_table, write_preview

        write_preview(preview, found, density_fn)
        print(f"{region_table(found)}\nlook at {preview}; nothing was changed")
        return
    if keep is not None:
        keep.parent.mkdir(parents=True, exist_ok=True)
        found.save(keep)
    summary = found.summary()
    back = f", what lay in {len(summary['restored'])} boxes taken back" if "restored" in summary else ""
    print(
        f"removed {summary['removed']} of {summary['occupied']} occupied cells ({summary['removed_share']:.1%}){back}"
    )
    print(f"cleaned: {target}" + (f"\nkeep mask: {keep}" if keep else ""))


def _judging(denoiser: str, threads: int, strength: float, cameras: Path | None, source: Path) -> dict[str, Any]:
    """What ``clean`` is given to judge with."""
    from ..denoisers import load_denoiser
    from ..evaluation.captures.loading import load_cameras

    return {
        "denoiser": load_denoiser(denoiser, backend="onnx", threads=threads or None),
        "strength": strength,
        "cameras": None if cameras is None else load_cameras(cameras, scene=source),
        "progress": StagedProgress("cube"),
    }


def _check_distinct(**files: Path | None) -> None:
    """No file is written over another: neither over the one to clean nor over what is written beside it."""
    named = [(name, path.resolve()) for name, path in files.items() if path is not None]
    for index, (name, path) in enumerate(named):
        for other, same in named[:index]:
            if path == same or (path.exists() and same.exists() and path.samefile(same)):
                raise InvalidArgument(f"clean: {name} and {other} are the same file, {path.name}; write to another")


def _clean_grid(
    source: Path, target: Path | None, mask: KeepMask | None = None, **options: Any
) -> tuple[KeepMask, Callable[[Any], Any]]:
    from ..facade import clean
    from ..fields.adapters.grids import cell_pitch, grid_density_fn, load_grid, save_grid

    density, aabb = load_grid(source)
    density_fn = grid_density_fn(density, aabb)
    if mask is None:
        mask = clean(density_fn, aabb, field_pitch=cell_pitch(aabb, density.shape, caller="clean"), **options)
    elif abs(mask.aabb - aabb).max() > 1e-4 * float((aabb[1] - aabb[0]).max()):
        raise InvalidArgument(
            f"clean: the mask's box must be {source.name}'s {aabb.tolist()}, got {mask.aabb.tolist()}"
        )
    if target is not None:
        save_grid(target, mask.apply_grid(density), aabb)
    return mask, density_fn


def _clean_splats(source: Path, target: Path | None, **options: Any) -> tuple[KeepMask, Callable[[Any], Any]]:
    from ..facade import clean_ply

    found = clean_ply(source, target, **options)
    gone = int((~found.keep).sum())
    print(f"{gone} of {len(found.keep)} Gaussians ({gone / max(len(found.keep), 1):.1%}) are ghosts")
    return found.mask, found.field.density_fn
