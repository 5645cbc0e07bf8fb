"""How much should each loss weigh? Every factor on development scenes, none of which the benchmark scores.

    python -m benchmarks.two_trajectory.sweep
    python -m benchmarks.two_trajectory.sweep --losses sight_lines end_points ds_nerf urban nearest_point floater_score
    python -m benchmarks.two_trajectory.sweep --losses       tries nothing: chooses anew among what is there

All factors of a loss are cut to the lowest coverage among them; of those whose PSNR is there within .1 dB of the best,
the one with the smallest disparity error is ``chosen``, mean over the scenes; what differs by less than .001 and .01 dB
is a tie, and stays with the factor that is there. Writes
docs/results/two_trajectory_sweep.json, off which ``Weights`` in ``job.py`` is read; losses that are not
asked for stay there as they were.
"""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch

from unghost.core.results import build_results, json_ready

from ..compact import write_lines
from ..fit_cache import FitCache
from ..options import ROOT, SHORT_RESULTS, BenchmarkOptions, parse
from ..progress import Plan, say, wrote
from .compact import compact_rows
from .job import Job, Weights
from .methods import FACTORS_OF, METHODS
from .points import MATCH_WIDTH, with_points
from .run import Options as Benchmark
from .run import fitted
from .scenes import synthetic_scene
from .scores import Stage, scored
from .tables import summary_rows

FACTORS = {
    "sparsity": (1e-4, 1e-3, 1e-2, 1e-1),
    "tv": (1e-3, 1e-2, 1e-1, 1.0),
    "regnerf": (1e-3, 1e-2, 1e-1, 1.0),
    "distortion": (4e-3, 2e-2, 1e-1, 5e-1),
    "free_space": (1e-6, 1e-5, 1e-4, 1e-3),
    "bayes_rays": (0.6, 0.7, 0.8, 0.9),
    "dsds_paper": (1e-2, 1e-1, 1.0, 10.0),
    "sight_lines": (1e-2, 3e-2, 1e-1, 3e-1),  # ours; the library's default should be what is chosen here
    "end_points": (0.0, 3e-3, 1e-2, 3e-2),
    "ds_nerf": (1e-2, 1e-1, 1.0, 10.0),
    "urban": (1e-4, 1e-3, 1e-2, 1e-1),
    "nearest_point": (1e-3, 1e-2, 1e-1, 1.0),
    "floater_score": (1e-2, 1e-1, 1.0, 10.0),
}
OURS = ("sight_lines", "end_points")
POINT_LOSSES = (*OURS, "ds_nerf", "urban", "nearest_point", "floater_score")
WITHIN_DB = 0.1


@dataclass(frozen=True)
class Options(BenchmarkOptions):
    """What to try.

    Attributes:
        scenes: by kind and number of the seed's.
        scene_seed: not the benchmark's.
        losses: whose factors; all if left out.
        factors: tried of each loss, at most.
        fit_steps, steps: as in the benchmark.
        photos, views, width, resolution, match_width: of a scene, as in the benchmark.
        cache: where fitted fields are kept.
    """

    SHORT: ClassVar[dict[str, Any]] = {
        "scenes": ("room-1",),
        "factors": 2,
        "fit_steps": 40,
        "steps": 2,
        "photos": 8,
        "views": 3,
        "width": 48,
        "resolution": 48,
        "match_width": 192,
        "cache": SHORT_RESULTS / "two_trajectory",
    }

    scenes: tuple[str, ...] = ("room-1", "objects-3")
    scene_seed: int = 555
    losses: tuple[str, ...] = tuple(FACTORS)
    fit_steps: int = 450
    steps: int = 150
    factors: int = 4
    photos: int = 20
    views: int = 10
    width: int = 96
    resolution: int = 96
    match_width: int = MATCH_WIDTH
    cache: Path = ROOT / "out" / "two_trajectory"


def chosen_factors(rows: list[dict[str, Any]]) -> dict[str, str]:
    """Loss -> the name of its factor, by the one rule for all; none of a loss that left nothing to score."""
    result = {}
    for loss in dict.fromkeys(row["table"] for row in rows):
        mine = [row for row in rows if row["table"] == loss and row["psnr_at_coverage"] is not None]
        if not mine:
            continue
        most = max(row["psnr_at_coverage"] for row in mine)
        good = [row for row in mine if row["psnr_at_coverage"] >= most - WITHIN_DB]
        there = f"{loss} {getattr(Weights(), loss):g}"
        result[loss] = min(
            good,
            key=lambda row: (
                round(row["disparity_mae_at_coverage"], 3),
                -round(row["psnr_at_coverage"], 2),
                row["method"] != there,
            ),
        )["method"]
    return result


def swept_by(loss: str) -> str:
    """The method by which a factor is chosen: the first that depends on it (and on few others)."""
    return next(name for name, factors in FACTORS_OF.items() if loss in factors)


def main() -> None:
    options = parse(Options, __doc__)
    torch.set_num_threads(options.threads)
    cache, cells = FitCache(options.cache), list[dict[str, Any]]()
    tried = [loss for loss in options.losses for _ in FACTORS[loss][: options.factors]]
    plan = Plan(tried * len(options.scenes), dict.fromkeys(options.losses, 30.0))
    for name in options.scenes:
        scene = synthetic_scene(
            options.scene_seed,
            name,
            photos=options.photos,
            views=options.views,
            width=options.width,
            resolution=options.resolution,
        )
        if set(options.losses) & set(POINT_LOSSES):
            scene = with_points(scene, cache, match_width=options.match_width)
        pseudo = scene.pseudo(lambda cameras: np.zeros(0))
        stage = Stage(scene, pseudo, scene.truth(pseudo), options.fit_steps, options.steps)
        base, _ = fitted(Benchmark(), cache, "field", scene, scene.train, 0, options.fit_steps)
        for loss in options.losses:
            method = METHODS[swept_by(loss)]
            for factor in FACTORS[loss][: options.factors]:
                plan.begin(loss, f"{name}, {loss} {factor:g}")
                weights = dataclasses.replace(Weights(), **{loss: factor})
                job = Job(scene, base, 0, options.steps, threads=options.threads, weights=weights)
                row = scored(stage, method(job)[0], None, headline=False)
                cells.append({"table": loss, "scene": name, "seed": 0, "method": f"{factor:g}", **row})
                said = {key: row[key] for key in ("psnr", "coverage", "disparity_mae") if row[key] is not None}
                say("    " + " ".join(f"{key} {value:.3f}" for key, value in said.items()))
    path = options.out / "two_trajectory_sweep.json"
    stored = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {"rows": []}
    rows = [{**row, "method": f"{row['table']} {row['method']}"} for row in summary_rows(cells)]
    rows = [row for row in stored["rows"] if row["table"] not in options.losses] + rows
    best = chosen_factors(rows)
    for row in rows:
        row["chosen"] = best.get(row["table"]) == row["method"]
        if row["psnr_at_coverage"] is None:
            say(f"{row['method']}: no pixel that all have, so no score; more --fit-steps leave more")
        else:
            say(
                f"{row['method']}: {row['psnr_at_coverage']:.3f} dB at {row['at_coverage']:.3f}, disparity "
                f"{row['disparity_mae_at_coverage']:.4f}{' *' * row['chosen']}"
            )
    command = options.command()
    if options.losses != tuple(FACTORS):
        command = " ; ".join([stored.get("command", ""), *([command] if options.losses else [])])
    results = build_results(
        compact_rows(rows), command=command, seeds=[0], scene_seed=options.scene_seed, threads=options.threads
    )
    write_lines(path, json_ready(results))
    wrote(path)


if __name__ == "__main__":
    main()
