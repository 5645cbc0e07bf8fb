"""The verbs that use a prior. Signatures are the command line; heavy imports wait for the verb."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

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
    grid: Positional[Path],
    out: Path | None = None,
    keep: Path | None = None,
    cameras: Path | None = None,
    denoiser: str = "default",
    strength: float = 0.5,
    threads: Threads = 0,
) -> None:
    """Clean a density grid: an .npz with density (X, Y, Z) per scene unit and aabb (2, 3), cubic cells.

    Args:
        grid: the file to clean; it is not changed.
        out: the cleaned grid; GRID-clean.npz beside it if not given.
        keep: the mask of what was kept, which undoes or repeats the cleaning; GRID-keep.npz if not given.
        cameras: a transforms.json (nerfstudio's format) of the training photos, in the grid's own world; where few
            or none of them look, ghosts are likelier. The photos themselves are not needed.
        denoiser: a shipped name or an .onnx file.
        strength: 0 removes nothing, 0.5 what the denoiser advises, 1 everything.
        threads: of onnxruntime; 0 leaves the choice to it.
    """
    from .cleaning import clean as clean_field
    from .denoisers import load_denoiser
    from .evaluation.captures import load_cameras
    from .grids import cell_pitch, grid_density_fn, load_grid, save_grid

    density, aabb = load_grid(grid)
    mask = clean_field(
        grid_density_fn(density, aabb), aabb, denoiser=load_denoiser(denoiser, backend="onnx", threads=threads or None),
        cameras=None if cameras is None else load_cameras(cameras), strength=strength,
        field_pitch=cell_pitch(aabb, density.shape, caller="clean"),
    )  # fmt: skip
    out = out or grid.with_name(f"{grid.stem}-clean.npz")
    keep = keep or grid.with_name(f"{grid.stem}-keep.npz")
    save_grid(out, mask.apply_grid(density), aabb)
    keep.parent.mkdir(parents=True, exist_ok=True)
    mask.save(keep)
    summary = mask.summary()
    print(f"removed {summary['removed']} of {summary['occupied']} occupied cells ({summary['removed_share']:.1%})")
    print(f"cleaned grid: {out}\nkeep mask: {keep}")


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
