"""What the methods of the two-trajectory benchmark look like: colour over depth, from the sweep that is scored.

    python -m benchmarks.two_trajectory.pictures --scene room-0

Fits and improves the field again (fits come from the benchmark's cache if they are there). Writes
docs/results/two_trajectory_views.png, and two_trajectory_doubt.png: what the photos and the prior doubt of the field as
it was fitted, beside what is wrong with it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch

from unghost.evaluation.report.rows import draw_comparison
from unghost.evaluation.uncertainty.photometric import photo_doubt

from ..fit_cache import FitCache
from ..options import CAPTURE, ROOT, SHORT_RESULTS, BenchmarkOptions, parse
from ..progress import say, wrote
from .job import Job, Outcome, Views, render
from .methods import METHODS, judged
from .run import Options as Benchmark
from .run import fitted, stages
from .scores import SLACK, Stage


@dataclass(frozen=True)
class Options(BenchmarkOptions):
    """What to draw.

    Attributes:
        scene: of the benchmark's synthetic ones; a capture's folder is given with ``--capture``.
        capture: a real one instead.
        methods: a column each, beside the truth.
        views: rows of the picture.
        seed: of fits and rays.
        fit_steps, steps: as in the benchmark.
        photos, width, resolution: of a synthetic scene, as in the benchmark.
        sweep_views: of its evaluation sweep.
        cache: of the benchmark.
    """

    SHORT: ClassVar[dict[str, Any]] = {
        "scene": "room-1",
        "views": 2,
        "fit_steps": 40,
        "steps": 2,
        "photos": 8,
        "sweep_views": 3,
        "width": 48,
        "resolution": 48,
        "cache": SHORT_RESULTS / "two_trajectory",
    }
    DATA: ClassVar[dict[str, str]] = {"capture": CAPTURE}

    scene: str = "room-0"
    capture: Path | None = None
    methods: tuple[str, ...] = ("fitted", "visibility+distortion", "bayes-rays", "dsds-restoration+distortion", "clean")
    views: int = 4
    seed: int = 0
    fit_steps: int = 450
    steps: int = 150
    photos: int = 20
    sweep_views: int = 10
    width: int = 96
    resolution: int = 96
    cache: Path = ROOT / "out" / "two_trajectory"


def columns(options: Options, stage: Stage, cache: FitCache) -> dict[str, Views]:
    """The truth, then each method."""
    scene = stage.scene
    found: dict[str, Views] = {"photo · true depth": {"rgb": scene.evaluation.photos, "depth": stage.pseudo.depth}}
    base, _ = fitted(Benchmark(), cache, "field", scene, scene.train, options.seed, stage.fit_steps)
    for name in options.methods:
        say(f"{scene.name}, {name}")
        outcome = METHODS[name](Job(scene, base, options.seed, stage.steps, threads=options.threads))[0]
        found[name] = render(outcome, scene, scene.evaluation.cameras)
    return found


def draw_doubt(path: Path, stage: Stage, job: Job, views: list[int]) -> None:
    """A row a view: photo, render, photo doubt, the prior's doubt, what is wrong with the colour."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    scene, prior = stage.scene, judged(job, job.base)
    told_by = Outcome(job.base, 0.0, uncertainty=prior.doubt, background_uncertainty=0.5)
    seen, told = (render(told_by, scene, sweep.cameras) for sweep in (scene.evaluation, scene.train))
    shown = np.clip(seen["rgb"], 0, 1)
    doubt = photo_doubt(
        shown,
        seen["depth"],
        scene.evaluation.cameras,
        photos=scene.train.photos,
        photo_depth=told["depth"],
        photo_cameras=scene.train.cameras,
        slack=SLACK * job.base.field_pitch,
    )
    wrong = np.abs(shown - scene.evaluation.photos).mean(axis=-1)
    columns: dict[str, tuple[Any, float | None]] = {
        "photo": (scene.evaluation.photos, None),
        "the field as fitted": (shown, None),
        "the photos' doubt": (doubt, 0.3),
        "the prior's doubt": (seen["uncertainty"], 1.0),
        "what is wrong (colour)": (wrong, 0.3),
    }
    figure = Figure(figsize=(2.6 * len(columns), 2.05 * len(views) + 0.5), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(len(views), len(columns), squeeze=False)
    for row, view in zip(grid, views):
        for axes, (name, (values, top)) in zip(row, columns.items()):
            axes.imshow(
                values[view], cmap=None if top is None else "magma", vmin=0, vmax=top or 1, interpolation="nearest"
            )
            axes.axis("off")
            if view == views[0]:
                axes.set_title(name, fontsize=11)
    figure.suptitle(f"{scene.name}: dark is trusted, bright is doubted (or wrong)", fontsize=12)
    figure.savefig(path, dpi=80, metadata={"Software": None})


def main() -> None:
    options = parse(Options, __doc__)
    torch.set_num_threads(options.threads)
    cache = FitCache(options.cache)
    scenes = () if options.capture else (options.scene,)
    benchmark = Benchmark(
        scenes=scenes,
        capture=options.capture,
        fit_steps=options.fit_steps,
        steps=options.steps,
        photos=options.photos,
        views=options.sweep_views,
        width=options.width,
        resolution=options.resolution,
        cache=options.cache,
        short=options.short,
    ).shortened()
    for stage in stages(benchmark, cache):
        count = len(stage.pseudo.depth)
        views = np.unique(np.linspace(0, count - 1, options.views + 2).round().astype(int)[1:-1]).tolist()
        path = options.out / "two_trajectory_views.png"
        draw_comparison(
            path,
            columns(options, stage, cache),
            views=views,
            limit=stage.scene.extent.limit,
            title=f"{stage.scene.name}: trained on one sweep, seen from another",
            note=f"Below each picture its depth (warm is near; grey: nothing within the depth limit). "
            f"Seed {options.seed}, {stage.steps} steps of each method.",
        )
        base, _ = fitted(benchmark, cache, "field", stage.scene, stage.scene.train, options.seed, stage.fit_steps)
        job = Job(stage.scene, base, options.seed, stage.steps, threads=options.threads)
        doubt = options.out / "two_trajectory_doubt.png"
        draw_doubt(doubt, stage, job, views)
        wrote(path, doubt)


if __name__ == "__main__":
    main()
