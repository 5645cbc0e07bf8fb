"""What a row of the two-trajectory benchmark says of one setting of a method: scores, curves over coverage, labels.

A method gives up pixels in one of three orders: ``own``, by the method's own uncertainty; ``spread``, by how far the
depth along the ray spreads, which any field can tell; ``photos``, by
:func:`unghost.evaluation.uncertainty.photometric`, which any field with the photos it was trained on can tell. A
method without an uncertainty of its own has ``spread`` as own; ours have photo doubt times the root of how far the
disparity spreads, the spread of the log depth per depth.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unghost.evaluation.scoring.conventions import evaluation_masks, get_convention
from unghost.evaluation.scoring.curves import cut_to_coverage
from unghost.evaluation.scoring.engine import SceneScores, score_scene, score_under_all
from unghost.evaluation.scoring.pseudo_truth import PseudoTruth
from unghost.evaluation.scoring.views import Renders, Truth
from unghost.evaluation.uncertainty.photometric import photo_doubt
from unghost.evaluation.uncertainty.sparsification import sparsify

from ..timing import Clock, Spent
from .job import Outcome, Views, add_seconds, render
from .scenes import DepthOf, LabelledSpace, TrajectoryScene

CONVENTION = "proper"
COVERAGES = (0.02, 0.05, *(round(0.05 * step, 2) for step in range(2, 20)))
CURVE_KEYS = ("psnr", "ssim", "disparity_mae", "normal_mean_deg")
LEAST_SPREAD = 1e-3  # of a disparity, cameras within +-1: a ray that is all of one mind is no proof
SLACK = 2.0  # cells of the field behind its depth that a photo still sees
DIGITS = 4  # of a curve's numbers


@dataclass(frozen=True, eq=False)
class Stage:
    """One scene with the truth about it; ``depth_of``: of a capture, what stands for its depth, from any camera."""

    scene: TrajectoryScene
    pseudo: PseudoTruth
    truth: Truth
    fit_steps: int
    steps: int
    depth_of: DepthOf | None = None


def scored(
    stage: Stage, outcome: Outcome, space: LabelledSpace | None, *, conventions: bool = False, headline: bool = True
) -> dict[str, Any]:
    """All that a row says.

    Args:
        stage: the scene.
        outcome: one setting of a method.
        space: its labels; None for a capture.
        conventions: scores under every published one, too.
        headline: the setting that stands in the tables, which is cut in all orders; False: in its own and by spread.
    """
    scene = stage.scene
    views = render(outcome, scene, scene.evaluation.cameras)
    renders = Renders(np.clip(views["rgb"], 0, 1), views["depth"], np.clip(views["accumulation"], 0, 1))
    extent = scene.extent
    scores = score_scene(renders, stage.truth, extent, convention=CONVENTION)
    mask = evaluation_masks(get_convention(CONVENTION), renders, stage.truth, extent)
    row = {"convention": CONVENTION, **scores.means(), "psnr_visible": _psnr_visible(renders, stage.truth)}
    row["curves"], row["ause"] = {}, {}
    clock = Clock()
    doubts = _doubts(stage, outcome, views, renders, headline)
    took: Spent = clock.read() if outcome.asks_photos else {"seconds": 0.0, "cpu_seconds": 0.0}
    for name, doubt in doubts.items():
        if name == "own" and doubt is doubts["spread"]:
            continue
        row["curves"][name] = _curve(stage, renders, mask, doubt, scores)
        row["ause"][name] = _ause(views["depth"], stage.pseudo.depth, doubt, mask)
    for each in ("curves", "ause"):
        row[each].setdefault("own", row[each]["spread"])
    if conventions:
        under = score_under_all(renders, stage.truth, extent)
        row["conventions"] = {name: each.means() for name, each in under.items() if each.images}
    if space is not None:
        row |= space.scores(outcome.field)
    return {
        **row,
        **add_seconds(outcome, took),
        "trained_steps": outcome.steps,
        "knob": outcome.knob,
        "note": outcome.note,
    }


def _doubts(stage: Stage, outcome: Outcome, views: Views, renders: Renders, headline: bool) -> dict[str, NDArray[Any]]:
    """Order -> uncertainty of every pixel."""
    found = {"own": views["spread"], "spread": views["spread"]}
    if outcome.uncertainty is not None:
        found["own"] = views["uncertainty"]
    if headline or outcome.asks_photos:
        told = stage.scene.train
        found["photos"] = photo_doubt(
            renders.colours,
            views["depth"],
            stage.scene.evaluation.cameras,
            photos=told.photos,
            photo_depth=render(outcome, stage.scene, told.cameras, values=False)["depth"],
            photo_cameras=told.cameras,
            slack=SLACK * outcome.field.field_pitch,
        )
    if outcome.asks_photos:
        found["own"] = found["photos"] * np.sqrt(views["spread"] / views["depth"] + LEAST_SPREAD)
    return found


def _curve(
    stage: Stage, renders: Renders, mask: NDArray[np.bool_], doubt: NDArray[Any], whole: SceneScores
) -> dict[str, list[float | None]]:
    """Scores of the surest pixels, as many as each coverage asks for; every pixel counts alike."""
    covered = float(mask.mean())
    points = [{"coverage": covered, **whole.pooled(CURVE_KEYS)}]
    for coverage in (each for each in COVERAGES if each < covered):
        cut = cut_to_coverage(mask, -doubt, coverage=coverage)
        point = score_scene(
            renders, stage.truth, stage.scene.extent, convention=CONVENTION, within=cut, keys=CURVE_KEYS
        )
        points.append({"coverage": coverage, **point.pooled(CURVE_KEYS)})
    columns = {key: [point[key] for point in points] for key in points[0]}
    for key in CURVE_KEYS:  # not the coverage: the bar is exactly one of them
        columns[key] = [None if value is None else round(value, DIGITS) for value in columns[key]]
    return columns


def _psnr_visible(renders: Renders, truth: Truth) -> float | None:
    """Of all pixels that a training photo saw, whatever is rendered there: nothing can be gained by removing."""
    errors = np.mean((renders.colours.astype(np.float64) - truth.photos) ** 2, axis=-1)
    assert truth.visible is not None
    values = [-10 * np.log10(error[seen].mean()) for error, seen in zip(errors, truth.visible) if seen.any()]
    return float(np.mean(values)) if values else None


def _ause(depth: NDArray[Any], true: NDArray[Any], doubt: NDArray[Any], mask: NDArray[np.bool_]) -> float | None:
    """How well an uncertainty ranks errors of depth: area under the sparsification error curve, 0 is best."""
    both = mask & np.isfinite(true)
    if not both.any():
        return None
    error = np.abs(np.where(both, depth, 0.0) - np.where(both, true, 0.0))
    return sparsify(error, doubt, both).ause
