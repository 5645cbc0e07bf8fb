"""Methods of the two-trajectory benchmark: what each does to a trained field, under the names of the table's rows.

Those that train go on from the same field with the same rays for the same steps; those that do not get the field as it
is, which is the row ``fitted``. ``visibility+...`` are the visibility loss and one rival's, as in the paper's table.
``WITH_POINTS`` are given the sparse points of the training photos, all the same ones. ``scratch...`` train a fresh
field from the first step, for as many steps as the fit has; ``scratch`` alone is that fit.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from unghost import load_denoiser
from unghost.baselines.bayes_rays import LOWEST, deformation_uncertainty
from unghost.cleaning.components import label_components
from unghost.cleaning.keep_mask import KeepMask
from unghost.cleaning.pipeline import Judgement, judge
from unghost.fields.filtered import FilteredField
from unghost.regularizer.removal import RemovalLoss
from unghost.regularizer.settings import RegularizerSettings

from ..timing import Clock
from .cells import cell_places
from .job import (
    Job,
    Outcome,
    Term,
    add_seconds,
    fine_tuned,
    from_scratch,
    lines_alone,
    make_regularizer,
    sight_lines,
    visibility,
)
from .rivals import (
    ds_nerf,
    floater_score,
    free_space,
    nearest_point,
    regnerf,
    sparsity,
    total_variation,
    urban,
)

PAPER_PRIOR = Path(__file__).parents[1] / "weights" / "small-epsilon.onnx"
PAPER_TIMESTEPS = (10, 50)
UNCERTAINTY_THRESHOLDS = (0.5, 0.6, 0.7, 0.8, 0.9, 1.0)  # that of the weights stands in the tables
UNCERTAINTY_RAYS = 1 << 16
STRENGTHS = (0.5, 0.1, 0.3, 0.7)  # the default first: it stands in the tables


def _with(*makers: Callable[[Job], Term]) -> Callable[[Job], list[Outcome]]:
    return lambda job: [fine_tuned(job, visibility, *(make(job) for make in makers))]


def _distortion(job: Job) -> list[Outcome]:
    return [fine_tuned(job, visibility, config=_distorting(job))]


def _distorting(job: Job) -> Any:
    return dataclasses.replace(job.fitting, distortion_weight=job.weights.distortion)


def _dsds_and_distortion(job: Job) -> list[Outcome]:
    return [_doubted(fine_tuned(job, make_regularizer, config=_distorting(job)))]


def _dsds_and_tv(job: Job) -> list[Outcome]:
    return [_doubted(fine_tuned(job, make_regularizer, total_variation(job)))]


def _once_and_tv(job: Job) -> list[Outcome]:
    return [_doubted(fine_tuned(job, visibility, judged_once(job), total_variation(job)))]


def _sight_lines(
    *makers: Callable[[Job], Term], dsds: bool = False, distortion: bool = False
) -> Callable[[Job], list[Outcome]]:
    """Ours with sparse points, DSDS or the visibility loss alone beside them; doubted by the photos."""

    def method(job: Job) -> list[Outcome]:
        make = (lambda job: make_regularizer(job, points=True)) if dsds else sight_lines
        config = _distorting(job) if distortion else None
        return [_doubted(fine_tuned(job, make, *(maker(job) for maker in makers), config=config))]

    return method


def _scratch(*, lines: bool = False, seen: bool = False, distortion: bool = False) -> Callable[[Job], list[Outcome]]:
    """From the first step: ours on sight lines, the visibility loss, the distortion loss; doubted by the photos if ours
    takes part."""

    def method(job: Job) -> list[Outcome]:
        config = _distorting(job) if distortion else None
        if not lines:
            return [from_scratch(job, config=config)]
        return [_doubted(from_scratch(job, sight_lines if seen else lines_alone, config=config))]

    return method


def judged_once(job: Job) -> Term:
    """What ``clean`` would take out of the field at the first step is held down at every step."""
    removal: list[RemovalLoss] = []

    def term(field: Any, step: int) -> Tensor:
        if not removal:
            removal.append(RemovalLoss(judged(job, field).mask(), seed=job.seed))
        return removal[0](field.density_fn)

    return term


def restoration(job: Job, **over: Any) -> list[Outcome]:
    """Trained with DSDS; what stays is doubted by the photos."""
    return [_doubted(fine_tuned(job, lambda job: make_regularizer(job, **over)))]


def judged(job: Job, base: Any, *, with_points: bool = False) -> Judgement:
    """The field judged by the default prior, or by the one that takes cameras and sparse points."""
    known: dict[str, Any] = {}
    if with_points:
        known = {"cameras": job.scene.train.cameras, "points": job.scene.points}
    denoiser = load_denoiser("evidence" if with_points else "default", backend="onnx", threads=job.threads)
    return judge(base.density_fn, base.aabb, denoiser=denoiser, field_pitch=base.field_pitch, **known)


def _doubted(outcome: Outcome) -> Outcome:
    """With our own order of pixels."""
    return dataclasses.replace(outcome, asks_photos=True)


def paper_timestep(step: int) -> int:
    """The paper's t in [10, 50], anew each step."""
    return int(np.random.default_rng([step, 15]).integers(PAPER_TIMESTEPS[0], PAPER_TIMESTEPS[1] + 1))


def paper(job: Job, **over: Any) -> list[Outcome]:
    denoiser = load_denoiser(str(PAPER_PRIOR), backend="onnx", threads=job.threads)
    settings = RegularizerSettings.paper(timestep=paper_timestep, dsds_weight=job.weights.dsds_paper, **over)
    note = (
        f"the paper's loss, schedule and objective, and its kind of cubes; {job.cubes} of them a step, as for ours "
        "(the paper: 40); a network of .29 M parameters (7.2 M need a GPU to train)"
    )
    return [fine_tuned(job, lambda job: make_regularizer(job, denoiser=denoiser, settings=settings), note=note)]


def bayes_rays(job: Job, base: Any) -> list[Outcome]:
    """Of a field at each threshold; pixels are ranked by the uncertainty of what stays, as in the published code."""
    clock = Clock()
    told = job.scene.train
    found = deformation_uncertainty(
        base,
        told.cameras,
        told.photos,
        seed=job.seed,
        sampling=job.scene.sampling,
        level=7,
        rays=min(UNCERTAINTY_RAYS, told.photos[..., 0].size),
    )
    took = clock.read()
    mine = job.weights.bayes_rays
    return [
        Outcome(
            FilteredField(base, found.keep(threshold)),
            **took,
            knob=threshold,
            uncertainty=found.log_deviation,
            background_uncertainty=LOWEST,
        )
        for threshold in (mine, *(each for each in UNCERTAINTY_THRESHOLDS if each != mine))
    ]


def _visibility_and_bayes_rays(job: Job) -> list[Outcome]:
    tuned = once(job, "visibility")
    found, *_ = bayes_rays(job, tuned.field)
    spent = add_seconds(tuned, {"seconds": found.seconds, "cpu_seconds": found.cpu_seconds})
    return [dataclasses.replace(found, **spent, steps=tuned.steps, knob=None)]


def _components(job: Job) -> list[Outcome]:
    """Everything opaque that does not hang together with the largest piece goes; on the field's own grid."""
    clock = Clock()
    box, pitch, places = job.base.aabb, job.base.field_pitch, cell_places(job.base)
    with torch.no_grad():
        density = job.base.density_fn(torch.from_numpy(places))[..., 0].numpy()
    occupied = RegularizerSettings().rule.occupied(density, pitch)
    labels, found = label_components(occupied)
    largest = int(np.bincount(labels.ravel())[1:].argmax()) + 1 if found else 0
    mask = KeepMask(box, pitch, ~occupied | (labels == largest))
    return [Outcome(FilteredField(job.base, mask.keep), **clock.read())]


def cleaned(
    job: Job, base: Any, *, strengths: tuple[float, ...] = STRENGTHS, with_points: bool = False
) -> list[Outcome]:
    """``clean`` of a field at each strength."""
    clock = Clock()
    judgement = judged(job, base, with_points=with_points)
    masks = {strength: judgement.mask(strength) for strength in strengths}
    took = clock.read()
    return [
        _doubted(Outcome(FilteredField(base, mask.keep), **took, knob=strength)) for strength, mask in masks.items()
    ]


def once(job: Job, name: str) -> Outcome:
    """What a method makes of the field, trained once a job."""
    if name not in job.done:
        make = {"visibility": lambda: fine_tuned(job, visibility), "dsds-restoration": lambda: restoration(job)[0]}
        job.done[name] = make[name]()
    return job.done[name]


def _clean_after(name: str) -> Callable[[Job], list[Outcome]]:
    def method(job: Job) -> list[Outcome]:
        tuned = once(job, name)
        clock = Clock()
        (found,) = cleaned(job, tuned.field, strengths=STRENGTHS[:1])
        return [dataclasses.replace(found, **add_seconds(tuned, clock.read()), steps=tuned.steps, knob=None)]

    return method


METHODS: dict[str, Callable[[Job], list[Outcome]]] = {
    "fitted": lambda job: [Outcome(job.base, 0.0)],
    "photo-doubt": lambda job: [_doubted(Outcome(job.base, 0.0))],
    "field": lambda job: [fine_tuned(job)],
    "visibility": lambda job: [once(job, "visibility")],
    "visibility+sparsity": _with(sparsity),
    "visibility+tv": _with(total_variation),
    "visibility+regnerf": _with(regnerf),
    "visibility+distortion": _distortion,
    "free-space": lambda job: [fine_tuned(job, None, free_space(job))],
    "bayes-rays": lambda job: bayes_rays(job, job.base),
    "visibility+bayes-rays": _visibility_and_bayes_rays,
    "components": _components,
    "dsds-paper": paper,
    "dsds-restoration": lambda job: [once(job, "dsds-restoration")],
    "dsds-restoration+distortion": _dsds_and_distortion,
    "dsds-restoration+tv": _dsds_and_tv,
    "dsds-once": lambda job: [_doubted(fine_tuned(job, visibility, judged_once(job)))],
    "dsds-once+tv": _once_and_tv,
    "clean": lambda job: cleaned(job, job.base),
    "visibility+clean": _clean_after("visibility"),
    "dsds-restoration+clean": _clean_after("dsds-restoration"),
    "visibility+ds-nerf": _with(ds_nerf),
    "visibility+urban": _with(urban),
    "visibility+nearest-point": _with(nearest_point),
    "visibility+floater-score": _with(floater_score),
    "visibility+sight-lines": _sight_lines(),
    "visibility+sight-lines+distortion": _sight_lines(distortion=True),
    "visibility+sight-lines+tv": _sight_lines(total_variation),
    "dsds+sight-lines": _sight_lines(dsds=True),
    "dsds+sight-lines+distortion": _sight_lines(dsds=True, distortion=True),
    "dsds+sight-lines+tv": _sight_lines(total_variation, dsds=True),
    "clean+points": lambda job: cleaned(job, job.base, with_points=True),
    "scratch": lambda job: [Outcome(job.base, job.fit_seconds, steps=job.fit_steps)],
    "scratch+distortion": _scratch(distortion=True),
    "scratch+sight-lines": _scratch(lines=True),
    "scratch+all": _scratch(lines=True, seen=True, distortion=True),
}
_LINES = ("sight_lines", "end_points")
FACTORS_OF: dict[str, tuple[str, ...]] = {  # which weights of `Weights` a method depends on
    **{f"visibility+{name}": (name,) for name in ("sparsity", "tv", "regnerf", "distortion", "urban")},
    "visibility+ds-nerf": ("ds_nerf",),
    "visibility+nearest-point": ("nearest_point",),
    "visibility+floater-score": ("floater_score",),
    "free-space": ("free_space",),
    "bayes-rays": ("bayes_rays",),
    "visibility+bayes-rays": ("bayes_rays",),
    "dsds-paper": ("dsds_paper",),
    "dsds-restoration+distortion": ("distortion",),
    "dsds-restoration+tv": ("tv",),
    "dsds-once+tv": ("tv",),
    **{f"{name}+sight-lines": _LINES for name in ("visibility", "dsds", "scratch")},
    **{
        f"{name}+sight-lines+{more}": (*_LINES, more)
        for name in ("visibility", "dsds")
        for more in ("distortion", "tv")
    },
    "scratch+distortion": ("distortion",),
    "scratch+all": (*_LINES, "distortion"),
}
WITH_POINTS = (
    *(f"visibility+{name}" for name in ("ds-nerf", "urban", "nearest-point", "floater-score")),
    *(name for name in METHODS if "sight-lines" in name),
    "scratch+all",
)
FROM_SCRATCH = ("scratch", "scratch+distortion", "scratch+sight-lines", "scratch+all")
# equal seconds say nothing of them
UNTRAINED = ("fitted", "photo-doubt", "bayes-rays", "components", "clean", "clean+points", *FROM_SCRATCH)
