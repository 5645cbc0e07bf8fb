"""What the methods of the two-trajectory benchmark share: a job, its outcome, fine-tuning and rendering."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from unghost import load_denoiser
from unghost.core.cameras import Cameras
from unghost.fields.rendering import render_view
from unghost.fields.training import TrainingConfig, train_field
from unghost.regularizer.density_regularizer import DensityRegularizer
from unghost.regularizer.settings import RegularizerSettings

from ..timing import Clock, Spent
from .scenes import TrajectoryScene

REACH = 3.0  # how many times the box the visibility loss goes out to
Views = dict[str, NDArray[Any]]
Term = Callable[[Any, int], Tensor]


@dataclass(frozen=True)
class Weights:
    """Factors of the rivals' losses and their knobs, chosen on development scenes (``sweep.py``).

    One rule for all: the smallest disparity error of those whose PSNR at equal coverage is within .1 dB of the best.
    """

    sparsity: float = 1e-4
    tv: float = 1e-2
    regnerf: float = 1e-2
    distortion: float = 1e-1
    free_space: float = 1e-5
    bayes_rays: float = 0.7  # the threshold above which what is uncertain goes
    dsds_paper: float = 0.1  # of the paper's own loss


@dataclass(frozen=True, eq=False)
class Outcome:
    """One setting of a method.

    Attributes:
        field: to be rendered and asked.
        seconds: that it took, by the clock.
        cpu_seconds: of both cores together: what it takes when nothing else runs.
        steps: of training; 0 for none.
        knob: where the method's knob stood; None without one.
        uncertainty: ``positions -> (M,)``, the method's own, averaged along rays; None: how far a ray's depth spreads.
        background_uncertainty: of light that gets through.
        asks_photos: the method's own order of pixels is by photo doubt and how far the depth spreads.
        note: for the row.
    """

    field: Any
    seconds: float
    cpu_seconds: float = 0.0
    steps: int = 0
    knob: float | None = None
    uncertainty: Callable[[Tensor], Tensor] | None = None
    background_uncertainty: float = 0.0
    asks_photos: bool = False
    note: str = ""


@dataclass(frozen=True, eq=False)
class Job:
    """A trained field, and how long it may be improved.

    Attributes:
        scene: what it is of.
        base: the field; not to be changed.
        seed: of rays and cubes.
        steps: of those that train.
        seconds: instead of steps; None: steps.
        cubes: a step.
        threads: of the denoiser.
        weights: of the rivals' losses.
        done: outcomes that another method of the same job goes on from.
    """

    scene: TrajectoryScene
    base: Any
    seed: int
    steps: int
    seconds: float | None = None
    cubes: int = 12
    threads: int = 2
    weights: Weights = Weights()
    done: dict[str, Outcome] = field(default_factory=dict)

    @property
    def fitting(self) -> TrainingConfig:
        """As the field was fitted."""
        return TrainingConfig(rays=self.scene.rays, sampling=self.scene.sampling)


def add_seconds(before: Outcome, after: Spent) -> Spent:
    """Seconds of an outcome and of what came after it."""
    return {
        "seconds": before.seconds + after["seconds"],
        "cpu_seconds": before.cpu_seconds + after["cpu_seconds"],
    }


def total(losses: Iterable[Tensor]) -> Tensor:
    """Sum of scalar losses; 0 for none."""
    return sum(losses, torch.zeros(()))


def render(outcome: Outcome, scene: TrajectoryScene, cameras: Cameras, *, values: bool = True) -> Views:
    """``rgb (n, H, W, 3)``, ``depth``, ``accumulation``, ``spread``; with ``values``, the method's ``uncertainty``."""

    asked = outcome.uncertainty if values else None
    views = [
        render_view(outcome.field, cameras, index, sampling=scene.sampling, values=asked)
        for index in range(len(cameras))
    ]
    stacked = {key: np.stack([view[key] for view in views]) for key in views[0]}
    if asked is not None:
        through = 1.0 - stacked["accumulation"]
        stacked["uncertainty"] = stacked.pop("values") + through * outcome.background_uncertainty
    return stacked


def make_regularizer(
    job: Job, *, denoiser: Any = None, settings: RegularizerSettings | None = None, **over: Any
) -> Any:
    used = denoiser or load_denoiser("default", backend="onnx", threads=job.threads)
    over = {"cubes": job.cubes, "visibility_reach": REACH, "seed": job.seed, **over}
    return DensityRegularizer(
        used,
        aabb=job.base.aabb,
        cameras=job.scene.train.cameras,
        field_pitch=job.base.field_pitch,
        settings=settings,
        **over,
    )


def fine_tuned(
    job: Job,
    make: Callable[[Job], Any] | None = None,
    *terms: Term,
    config: TrainingConfig | None = None,
    note: str = "",
    observed: bool = True,
) -> Outcome:
    """A copy of the field after more training with a regularizer's losses and further terms.

    ``make``: of the regularizer, whose making is timed, too. ``observed``: it learns of the rays' densities, if it has
    cubes to place.
    """
    clock = Clock()
    regularizer = None if make is None else make(job)
    tuned = copy.deepcopy(job.base)
    parts: list[Term] = list(terms)
    watched = None
    if regularizer is not None:
        parts.insert(0, lambda field, step: total(regularizer(field.density_fn).values()))
        watched = regularizer.observe if observed and regularizer.settings.dsds_weight > 0 else None
    left = None if job.seconds is None else max(job.seconds - clock.read()["seconds"], 1e-3)
    budget: dict[str, Any] = {"steps": job.steps} if left is None else {"seconds": left}
    record = train_field(
        tuned,
        job.scene.train.cameras,
        job.scene.train.photos,
        seed=job.seed,
        config=config or job.fitting,
        fine_tune=True,
        observer=watched,
        regularizer=(lambda field, step: total(part(field, step) for part in parts)) if parts else None,
        **budget,
    )
    return Outcome(tuned, **clock.read(), steps=record["steps"], note=note)


def visibility(job: Job) -> Any:
    return make_regularizer(job, dsds_weight=0.0)
