"""The verbs that use a prior. Signatures are the command line; heavy imports wait for the verb."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tyro.conf import arg

Threads = Annotated[int, arg(help="of onnxruntime; 0 leaves the choice to it.")]


def demo(out: Path = Path("out/demo"), seed: int = 0) -> None:
    """Clean a synthetic room whose ghosts are known; writes a page to look at and result.json.

    Args:
        out: folder for index.html, result.json and the pictures.
        seed: of the room and its ghosts.
    """
    from ..demo.run import run_demo, summary_table

    results = run_demo(out, seed=seed)
    print(summary_table(results))
    print(f"look at {out / 'index.html'}")


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
    from ..core.results import build_results, write_results
    from ..denoisers import load_denoiser
    from ..speed import measure_speed

    model = load_denoiser(denoiser, backend="onnx", threads=threads or None)
    row = measure_speed(model, batch=batch, seconds=seconds)
    print(
        f"{row['cubes_per_second']:.0f} cubes/s ({model.precision}, batch {batch}, median of {row['calls']} calls, "
        f"{row['milliseconds']:.1f} ms each)"
    )
    if out is not None:
        about = {"precision": model.precision, "parameters": model.manifest.parameters}
        rows = [{"method": model.manifest.name, **row, "threads": threads, **about}]
        write_results(out, build_results(rows, seeds=[0], weights=model.manifest.body_sha256))
