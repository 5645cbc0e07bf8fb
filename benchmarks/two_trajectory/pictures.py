"""What the methods of the two-trajectory benchmark look like: colour over depth, from the sweep that is scored.

    python -m benchmarks.two_trajectory.pictures --scene room-0
    python -m benchmarks.two_trajectory.pictures --capture CAPTURE --train one --eval two --out FOLDER

Photos and renders are ``--picture-width`` pixels wide, whatever the field was trained on. Fits and improves the field
again (fits come from the benchmark's cache if they are there). Writes docs/results/two_trajectory_views.png, and
two_trajectory_doubt.png: what the photos and the prior doubt of the field as it was fitted, beside what is wrong with
it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch

from unghost.core.cameras import Cameras
from unghost.evaluation.captures.loading import load_capture
from unghost.evaluation.report.rows import draw_comparison
from unghost.evaluation.scoring.depths import ray_depth
from unghost.evaluation.uncertainty.photometric import photo_doubt
from unghost.scenes.generator import PhotographedScene, photograph_larger

from ..fit_cache import FitCache
from ..options import CAPTURE, ROOT, SHORT_RESULTS, BenchmarkOptions, parse
from ..progress import say, wrote
from .job import Job, Outcome, Views, render
from .methods import METHODS, judged
from .run import Options as Benchmark
from .run import fitted, stages
from .scores import SLACK, Stage

IN_RUN = (  # columns of the pictures that `run --pictures` draws
    "fitted",
    "visibility+distortion",
    "visibility+urban",
    "dsds-restoration+distortion",
    "dsds+sight-lines+distortion",
    "clean",
)


@dataclass(frozen=True)
class Options(BenchmarkOptions):
    """What to draw.

    Attributes:
        scene: of the benchmark's synthetic ones; a capture's folder is given with ``--capture``.
        capture: a real one instead,
        train, eval: its sweeps,
        downscale: and its photo pixels per pixel that is trained on.
        methods: a column each, beside the truth.
        views: rows of the picture.
        picture_width: of each photo and render, in pixels.
        seed: of fits and rays.
        fit_steps, steps, capture_steps: as in the benchmark.
        photos, width, resolution: of a synthetic scene, as in the benchmark.
        sweep_views: of its evaluation sweep.
        cache: of the benchmark.
    """

    SHORT: ClassVar[dict[str, Any]] = {
        "scene": "room-1",
        "views": 2,
        "picture_width": 96,
        "downscale": 32,
        "capture_steps": (10, 2),
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
    train: str = "trajectory_1"
    eval: str = "trajectory_3"
    downscale: float = 8
    methods: tuple[str, ...] = ("fitted", "visibility+distortion", "bayes-rays", "dsds-restoration+distortion", "clean")
    views: int = 4
    picture_width: int = 256
    seed: int = 0
    fit_steps: int = 450
    steps: int = 150
    capture_steps: tuple[int, int] = (360, 100)
    photos: int = 20
    sweep_views: int = 10
    width: int = 96
    resolution: int = 96
    cache: Path = ROOT / "out" / "two_trajectory"


def larger_truth(stage: Stage, width: int, views: Sequence[int]) -> tuple[Cameras, Views]:
    """Cameras of some evaluation views for photos ``width`` pixels wide, and ``rgb`` and ``depth`` along unit rays."""
    scene = stage.scene
    if scene.again is not None:
        photos, depth_maps = photograph_larger(_only(scene.again, views), width=width)
        cameras = scene.again.true_cameras.select(views)
        cameras = cameras.resized(width / cameras.width)
        return cameras, {"rgb": photos, "depth": ray_depth(depth_maps, cameras)}
    if scene.capture is None or scene.held_out is None or stage.depth_of is None:
        raise ValueError(f"pictures: of {scene.name} neither the geometry is known nor the capture")
    chosen = scene.held_out[list(views)]
    stored, _ = scene.capture.photo_size(int(chosen[0]))
    large = load_capture(scene.capture.folder, downscale=max(1.0, stored / width))
    cameras = large.cameras.select(chosen)
    return cameras, {"rgb": large.images(chosen), "depth": stage.depth_of(cameras)}


def _only(again: PhotographedScene, views: Sequence[int]) -> PhotographedScene:
    return dataclasses.replace(again, true_cameras=again.true_cameras.select(views))


def columns(stage: Stage, job: Job, methods: Sequence[str], cameras: Cameras, truth: Views) -> dict[str, Views]:
    """The truth, then each method."""
    name = "photo · true depth" if stage.depth_of is None else "photo · depth of both sweeps"
    found: dict[str, Views] = {name: truth}
    for method in methods:
        say(f"{stage.scene.name}, {method}")
        found[method] = render(METHODS[method](job)[0], stage.scene, cameras, values=False)
    return found


def draw_views(path: Path, stage: Stage, job: Job, options: Options) -> list[int]:
    """Colour over depth of every method; returns which views of the evaluation sweep were drawn."""
    count = len(stage.pseudo.depth)
    views: list[int] = np.unique(np.linspace(0, count - 1, options.views + 2).round().astype(int)[1:-1]).tolist()
    cameras, truth = larger_truth(stage, options.picture_width, views)
    draw_comparison(
        path,
        columns(stage, job, options.methods, cameras, truth),
        views=range(len(views)),
        limit=stage.scene.extent.limit,
        title=f"{stage.scene.name}: trained on one sweep, seen from another",
        note=f"Below each picture its depth (warm is near; grey: nothing within the depth limit). "
        f"Seed {options.seed}, {stage.steps} steps of each method.",
    )
    return views


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


def job_of(benchmark: Benchmark, cache: FitCache, stage: Stage, seed: int) -> Job:
    """The fitted field of a scene, and what is to be done with it."""
    base, took = fitted(benchmark, cache, "field", stage.scene, stage.scene.train, seed, stage.fit_steps)
    return Job(stage.scene, base, seed, stage.steps, None, stage.fit_steps, took, threads=benchmark.threads)


def draw_all(benchmark: Benchmark, cache: FitCache) -> None:
    """Views of the first synthetic scene and of the first pair of a run: what ``run --pictures`` draws at its end."""
    options = Options(short=benchmark.short, methods=IN_RUN).shortened()
    first = dataclasses.replace(benchmark, scenes=benchmark.scenes[:1], capture=None, capture_pairs=(), methods=IN_RUN)
    folder, train, evaluation = next(iter(benchmark.pairs()), (None, "", ""))
    pair = dataclasses.replace(first, scenes=(), capture=folder, train=train, eval=evaluation)
    names = ("two_trajectory_views.png", "two_trajectory_views_capture.png")
    for name, part in zip(names, (first, pair)):
        for stage in stages(part, cache):
            draw_views(benchmark.out / name, stage, job_of(part, cache, stage, options.seed), options)
            wrote(benchmark.out / name)


def main() -> None:
    options = parse(Options, __doc__)
    torch.set_num_threads(options.threads)
    cache = FitCache(options.cache)
    benchmark = Benchmark(
        scenes=() if options.capture else (options.scene,),
        capture=options.capture,
        train=options.train,
        eval=options.eval,
        downscale=options.downscale,
        methods=options.methods,
        fit_steps=options.fit_steps,
        steps=options.steps,
        capture_steps=options.capture_steps,
        photos=options.photos,
        views=options.sweep_views,
        width=options.width,
        resolution=options.resolution,
        cache=options.cache,
        short=options.short,
        threads=options.threads,
    ).shortened()
    for stage in stages(benchmark, cache):
        job = job_of(benchmark, cache, stage, options.seed)
        path, doubt = (options.out / f"two_trajectory_{name}.png" for name in ("views", "doubt"))
        views = draw_views(path, stage, job, options)
        draw_doubt(doubt, stage, job, views)
        wrote(path, doubt)


if __name__ == "__main__":
    main()
