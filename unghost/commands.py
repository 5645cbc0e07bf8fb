"""The verbs that use a prior. Signatures are the command line; heavy imports wait for the verb."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, arg

if TYPE_CHECKING:
    from .regularizer.keep_mask import KeepMask

Threads = Annotated[int, arg(help="of onnxruntime; 0 leaves the choice to it.")]


def demo(out: Path = Path("out/demo"), seed: int = 0) -> None:
    """Clean a synthetic room whose ghosts are known; writes a page to look at and result.json.

    Args:
        out: folder for index.html, result.json and the pictures.
        seed: of the room and its ghosts.
    """
    from .demo import run_demo, summary_table

    results = run_demo(out, seed=seed)
    print(summary_table(results))
    print(f"look at {out / 'index.html'}")


def clean(
    source: Positional[Path],
    out: Annotated[Path | None, arg(aliases=["-o"])] = None,
    keep: Path | None = None,
    preview: Path | None = None,
    cameras: Path | None = None,
    denoiser: str = "default",
    strength: float = 0.5,
    resolution: int | None = None,
    reach: float | None = None,
    threads: Threads = 0,
) -> None:
    """Clean a density grid (.npz: density (X, Y, Z) per scene unit, aabb (2, 3), cubic cells) or 3D Gaussians (.ply).

    Args:
        source: the file to clean; it is not changed.
        out: the cleaned grid or splats; NAME-clean beside it if not given. Every property of a splat is kept byte for
            byte, and keep_score is added.
        keep: the mask of what was kept, which undoes or repeats the cleaning; NAME-keep.npz if not given.
        preview: a PNG to write instead of all that: what would stay and what would go, from three sides; the regions
            that would go are listed.
        cameras: a transforms.json (nerfstudio's format) of the training photos, in the file's own world; where few
            or none of them look, ghosts are likelier. The photos themselves are not needed.
        denoiser: a shipped name or an .onnx file.
        strength: 0 removes nothing, 0.5 what the denoiser advises, 1 everything.
        resolution: of splats, cells along the longest side of the box; by the splats' sizes if not given.
        reach: of splats, how many times the scene's core (98 % of the opacity) is cleaned (twice if not given); what
            is beyond stays.
        threads: of onnxruntime; 0 leaves the choice to it.
    """
    from .denoisers import load_denoiser
    from .evaluation.captures import load_cameras

    splats = source.suffix == ".ply"
    target = None if preview else out or source.with_name(f"{source.stem}-clean{source.suffix}")
    keep = None if preview else keep or source.with_name(f"{source.stem}-keep.npz")
    _check_distinct(source=source, out=target, keep=keep, preview=preview)
    if not splats and (resolution is not None or reach is not None):
        raise ValueError(f"clean: --resolution and --reach are for splats (.ply); {source.name} has its own cells")
    options: dict[str, Any] = {
        "denoiser": load_denoiser(denoiser, backend="onnx", threads=threads or None), "strength": strength,
        "cameras": None if cameras is None else load_cameras(cameras), "progress": _windows(),
    }  # fmt: skip
    if splats:
        options |= {} if reach is None else {"reach": reach}
        mask, density_fn = _clean_splats(source, target, resolution=resolution, **options)
    else:
        mask, density_fn = _clean_grid(source, target, **options)
    if preview:
        from .removal_preview import region_table, write_preview

        write_preview(preview, mask, density_fn)
        print(f"{region_table(mask)}\nlook at {preview}; nothing was changed")
        return
    assert keep is not None
    keep.parent.mkdir(parents=True, exist_ok=True)
    mask.save(keep)
    summary = mask.summary()
    print(f"removed {summary['removed']} of {summary['occupied']} occupied cells ({summary['removed_share']:.1%})")
    print(f"cleaned: {target}\nkeep mask: {keep}")


def _check_distinct(**files: Path | None) -> None:
    """No file is written over another: neither over the one to clean nor over what is written beside it."""
    named = [(name, path.resolve()) for name, path in files.items() if path is not None]
    for index, (name, path) in enumerate(named):
        for other, same in named[:index]:
            if path == same or (path.exists() and same.exists() and path.samefile(same)):
                raise ValueError(f"clean: {name} and {other} are the same file, {path.name}; write to another")


def _clean_grid(source: Path, target: Path | None, **options: Any) -> tuple[KeepMask, Callable[[Any], Any]]:
    from .cleaning import clean
    from .grids import cell_pitch, grid_density_fn, load_grid, save_grid

    density, aabb = load_grid(source)
    density_fn = grid_density_fn(density, aabb)
    mask = clean(density_fn, aabb, field_pitch=cell_pitch(aabb, density.shape, caller="clean"), **options)
    if target is not None:
        save_grid(target, mask.apply_grid(density), aabb)
    return mask, density_fn


def _clean_splats(source: Path, target: Path | None, **options: Any) -> tuple[KeepMask, Callable[[Any], Any]]:
    from .splat_cleaning import clean_ply

    found = clean_ply(source, target, **options)
    gone = int((~found.keep).sum())
    print(f"{gone} of {len(found.keep)} Gaussians ({gone / max(len(found.keep), 1):.1%}) are ghosts")
    return found.mask, found.field.density_fn


def _windows() -> Callable[[int, int], None]:
    """A progress bar of the windows that went through the denoiser, on stderr, gone when it is full."""
    from tqdm import tqdm

    bar = tqdm(unit="cube", dynamic_ncols=True, leave=False, disable=None)

    def progress(done: int, total: int) -> None:
        if done < bar.n:  # the next level begins
            bar.reset()
        bar.total = total
        bar.update(done - bar.n)

    return progress


def bench(
    denoiser: str = "default", batch: int = 40, threads: Threads = 0, seconds: float = 5.0, out: Path | None = None
) -> None:
    """Measure how many 32^3 cubes a second a denoiser restores through onnxruntime.

    Args:
        denoiser: a shipped name or an .onnx file.
        batch: cubes a call.
        threads: of onnxruntime; 0 leaves the choice to it.
        seconds: how long to measure, after three calls to warm up.
        out: also write the result as JSON here.
    """
    from .bench import measure_speed
    from .core.results import build_results, write_results
    from .denoisers import load_denoiser

    model = load_denoiser(denoiser, backend="onnx", threads=threads or None)
    row = measure_speed(model, batch=batch, seconds=seconds)
    print(f"{row['cubes_per_second']:.0f} cubes/s ({model.precision}, batch {batch}, median of {row['calls']} calls, "
          f"{row['milliseconds']:.1f} ms each)")  # fmt: skip
    if out is not None:
        about = {"precision": model.precision, "parameters": model.manifest.parameters}
        rows = [{"method": model.manifest.name, **row, "threads": threads, **about}]
        write_results(out, build_results(rows, seeds=[0], weights=model.manifest.body_sha256))
