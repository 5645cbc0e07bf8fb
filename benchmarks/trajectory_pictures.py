"""What the methods of the two-trajectory benchmark look like: colour over depth, from the sweep that is scored.

    python benchmarks/trajectory_pictures.py --scene room-1

Fits and improves the field again (fits come from the benchmark's cache if they are there). Writes
docs/results/two_trajectory_views.png.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from fit_cache import FitCache, say
from trajectory_job import Job, Views, render
from trajectory_methods import METHODS
from trajectory_scores import Stage
from two_trajectory import Options as Benchmark
from two_trajectory import fitted, stages

from unghost.evaluation.report import draw_comparison

ROOT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Options:
    """What to draw.

    Attributes:
        scene: of the benchmark's synthetic ones; a capture's folder is given with ``--capture``.
        capture: a real one instead.
        methods: a column each, beside the truth.
        views: rows of the picture.
        seed: of fits and rays.
        fit_steps, steps: as in the benchmark.
        threads: of torch and onnxruntime.
        out: where two_trajectory_views.png goes.
        cache: of the benchmark.
    """

    scene: str = "room-1"
    capture: Path | None = None
    methods: tuple[str, ...] = ("field", "visibility", "visibility+distortion", "bayes-rays", "dsds-restoration")
    views: int = 4
    seed: int = 0
    fit_steps: int = 450
    steps: int = 150
    threads: int = 2
    out: Path = ROOT / "docs" / "results"
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


def main() -> None:
    options = tyro.cli(Options, description=__doc__)
    torch.set_num_threads(options.threads)
    cache = FitCache(options.cache)
    scenes = () if options.capture else (options.scene,)
    benchmark = Benchmark(
        scenes=scenes, capture=options.capture, fit_steps=options.fit_steps, steps=options.steps, cache=options.cache
    )
    for stage in stages(benchmark, cache):
        count = len(stage.pseudo.depth)
        views = np.unique(np.linspace(0, count - 1, options.views + 2).round().astype(int)[1:-1]).tolist()
        path = options.out / "two_trajectory_views.png"
        draw_comparison(
            path, columns(options, stage, cache), views=views, limit=stage.scene.extent.limit,
            title=f"{stage.scene.name}: trained on one sweep, seen from another",
            note=f"Below each picture its depth (warm is near; grey: nothing within the depth limit). "
            f"Seed {options.seed}, {stage.steps} steps of each method.",
        )  # fmt: skip
        say(str(path))


if __name__ == "__main__":
    main()
