"""The verb that cleans files. Its signature is the command line; heavy imports wait for it."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, UseAppendAction, arg

from ..cleaning.pipeline import CleanSettings
from ..core.errors import InvalidArgument
from ..core.file_kinds import GRID, SPLATS, file_kind, not_readable
from ..core.progress import StagedProgress
from .options import given, options_of
from .plain_warnings import plain_warnings
from .prior import Threads

if TYPE_CHECKING:
    from ..cleaning.keep_mask import KeepMask

    CleanOptions = CleanSettings
else:
    _ELSEWHERE = "strength", "keep_boxes", "resolution"  # options of the verb itself, with their own spelling
    _NEEDS_A_FIELD = "field_pitch", "rule", "soft", "skip_empty", "backend", "chunk"
    CleanOptions = options_of(CleanSettings, leave_out=(*_ELSEWHERE, *_NEEDS_A_FIELD))

SPLAT_SUFFIXES = {".ply", ".splat", ".ksplat", ".spz", ".sog"}
Box = tuple[float, float, float, float, float, float]


def clean(
    source: Positional[Path],
    out: Annotated[Path | None, arg(aliases=["-o"])] = None,
    keep: Path | None = None,
    preview: Path | None = None,
    mask: Path | None = None,
    keep_box: UseAppendAction[tuple[Box, ...]] = (),
    cameras: Path | None = None,
    points: Path | None = None,
    denoiser: str | None = None,
    strength: float = 0.5,
    resolution: int | None = None,
    reach: float | None = None,
    box: Box | None = None,
    keep_score: bool = False,
    scores_only: bool = False,
    threads: Threads = 0,
    options: Annotated[CleanOptions, arg(name="")] = CleanOptions(),  # noqa: B008 (frozen)
) -> None:
    """Clean a density grid (.npz) or 3D Gaussians (.ply); writes a cleaned copy and the mask of what stays.

    A grid file has density (X, Y, Z) per scene unit and aabb (2, 3); its cells are cubes. What a file is, its content
    says, not its name.

    Args:
        source: the file to clean; it is not changed.
        out: the cleaned grid or splats; NAME-clean beside it if not given. Every property of a splat that stays is kept
            byte for byte, and none is added.
        keep: the mask of what was kept, with which --mask repeats the cleaning; NAME-keep.npz if not given
            (with --mask: none).
        preview: a PNG to write instead of all that: what would stay and what would go, from three sides; the regions
            that would go are listed.
        mask: a keep mask of an earlier cleaning, applied as it is instead of judging anew.
        keep_box: x0 y0 z0 x1 y1 z1, scene units: nothing in this box is removed; may be given several times. With
            --mask, takes back what that removed there (the boxes of the preview's table, say).
        cameras: of the training photos, in the file's own world: transforms.json (nerfstudio's), cameras.json
            (Inria's) or a COLMAP model. The photos are not needed. A dataparser_transforms.json (nerfstudio's) beside
            either file is applied.
        points: a COLMAP model with sparse points, or a folder that holds one; the one beside --cameras if not given.
            For --denoiser evidence: the points and who observed them tell surfaces from ghosts.
        denoiser: a shipped name or an .onnx file; default if not given. evidence takes --cameras and sparse points.
        strength: 0 removes nothing, 0.5 what the denoiser advises, 1 everything.
        resolution: of splats, cells along the longest side of the box; by the splats' sizes if not given.
        reach: of splats, how many times the scene's core (98 % of the opacity) is cleaned (twice if not given); what
            is beyond stays.
        box: of splats, x0 y0 z0 x1 y1 z1, scene units, in place of reach: only what is in this box is judged, and all
            else stays. For an object that is small beside its surroundings.
        keep_score: of splats, add the property keep_score to those that stay (strict readers refuse it).
        scores_only: of splats, write all of them with their keep_score, and remove none.
        threads: of onnxruntime; 0 leaves the choice to it.
    """
    from ..cleaning.keep_mask import KeepMask

    splats = _is_splats(source)
    suffix = ".ply" if splats else ".npz"
    suffix = source.suffix if source.suffix.lower() == suffix else suffix
    target = None if preview else out or source.with_name(f"{source.stem}-clean{suffix}")
    keep = None if preview or (mask and keep is None) else keep or source.with_name(f"{source.stem}-keep.npz")
    _check_distinct(source=source, out=target, keep=keep, preview=preview, mask=mask)
    _check_suffix(target, splats=splats)
    of_splats = {
        "resolution": resolution,
        "reach": reach,
        "box": None if box is None else [box[:3], box[3:]],
        "keep_score": keep_score or None,
        "scores_only": scores_only or None,
    }
    how: dict[str, Any] = {name: value for name, value in of_splats.items() if value is not None}
    if how and not splats:
        raise InvalidArgument(f"clean: {_options(of_splats)} are for splats (.ply); {source.name} is a grid")
    if reach is not None and box is not None:
        raise InvalidArgument("clean: --box is judged in place of --reach; leave one of them out")
    boxes = [[corners[:3], corners[3:]] for corners in keep_box]
    settings = given(options)
    with plain_warnings():
        if mask is not None:
            if settings or box is not None:
                unused = [*settings, *(["box"] if box is not None else [])]
                raise InvalidArgument(f"clean: --mask repeats a cleaning as it was; leave out {', '.join(unused)}")
            how["mask"] = KeepMask.load(mask).restored(boxes)
        else:
            if points is not None and cameras is None:
                raise InvalidArgument("clean: --points must come with --cameras, which observed them")
            name = denoiser or ("default" if splats else None)
            how |= {"keep_boxes": tuple(boxes), **_judging(name, threads, strength, cameras, points, source)}
            how |= {"settings": CleanSettings(**settings)} if settings else {}
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
    removed, occupied = (summary.get(name, 0) for name in ("removed", "occupied"))  # absent in a mask made by hand
    print(f"removed {removed} of {occupied} occupied cells ({summary['removed_share']:.1%}){back}")
    print(f"cleaned: {target}" + (f"\nkeep mask: {keep}" if keep else ""))


def _judging(
    denoiser: str | None, threads: int, strength: float, cameras: Path | None, points: Path | None, source: Path
) -> dict[str, Any]:
    """What ``clean`` is given to judge with; the first line that is printed lists it."""
    from ..denoisers import load_denoiser
    from ..evaluation.captures.loading import load_cameras, load_points
    from ..facade.choice import choose_denoiser

    known = None if cameras is None else load_cameras(cameras, scene=source)
    wanted = cameras is not None and (points is not None or denoiser == "evidence")
    sparse = load_points(points, cameras, scene=source) if cameras is not None and wanted else None
    name = denoiser or choose_denoiser(known, sparse)
    about = [f"{len(known)} cameras"] if known is not None else []
    about += [sparse.about] if sparse is not None else []
    print(f"judging by {name}: {', '.join(['density', *about])}")
    judging = {
        "denoiser": load_denoiser(name, backend="onnx", threads=threads or None),
        "strength": strength,
        "cameras": known,
        "progress": StagedProgress("cube"),
    }
    return judging if sparse is None else {**judging, "points": sparse}


def _is_splats(source: Path) -> bool:
    """Whether the file holds splats, and not a grid.

    Raises:
        ValueError: it holds neither; the message says what it is and what to do.
    """
    kind = file_kind(source, caller="clean")
    if kind not in (SPLATS, GRID):
        raise not_readable(source, kind, caller="clean")
    return kind is SPLATS


def _check_suffix(target: Path | None, *, splats: bool) -> None:
    """No file is written under the name of another format."""
    wrong = SPLAT_SUFFIXES if not splats else {".npz", *SPLAT_SUFFIXES} - {".ply"}
    if target is not None and target.suffix.lower() in wrong:
        written = "splats are written as .ply" if splats else "grids are written as .npz"
        raise InvalidArgument(f"clean: {written}, got --out {target.name}")


def _options(names: Iterable[str]) -> str:
    words = [f"--{name.replace('_', '-')}" for name in names]
    return f"{', '.join(words[:-1])} and {words[-1]}"


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
    gone = int((~found.keep & found.valid).sum())
    print(f"{gone} of {len(found.keep)} Gaussians ({gone / max(len(found.keep), 1):.1%}) are ghosts")
    invalid = ~found.valid
    if invalid.any():
        dropped = bool((invalid & ~found.keep).any())
        fate = "are removed" if dropped else "stay as they are (--drop-invalid removes them)"
        print(f"{int(invalid.sum())} cannot be judged (NaN, infinite, or a rotation of length 0) and {fate}")
    return found.mask, found.field.density_fn
