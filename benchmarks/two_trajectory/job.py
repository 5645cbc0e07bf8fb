"""What the methods of the two-trajectory benchmark share: a job, its outcome, fine-tuning and rendering."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from unghost import load_denoiser
from unghost.core.cameras import Cameras
from unghost.core.sparse_points import SparsePoints
from unghost.fields.radiance import RadianceField
from unghost.fields.rendering import render_view
from unghost.fields.training import TrainingConfig, train_field
from unghost.regularizer.density_regularizer import DensityRegularizer
from unghost.regularizer.settings import RegularizerSettings

from ..timing import Clock, Spent
from .scenes import TrajectoryScene

REACH = 3.0  # how many times the box the visibility loss goes out to
NO_LOSSES = ("by_weights",)  # terms that do something else at every step
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
    sight_lines: float = 0.03  # of ours; the two are the defaults of the regularizer
    end_points: float = 0.01
    ds_nerf: float = 0.1
    urban: float = 1e-2
    nearest_point: float = 1e-2
    floater_score: float = 1e-1


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
        idle: losses that were 0 at every step, which then tests nothing.
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
    idle: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Job:
    """A trained field, and how long it may be improved.

    Attributes:
        scene: what it is of.
        base: the field; not to be changed.
        seed: of rays and cubes.
        steps: of those that train.
        seconds: instead of steps; None: steps.
        fit_steps, fit_seconds: of the field's fit, which those that train from the first step repeat.
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
    fit_steps: int = 0
    fit_seconds: float = 0.0
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
    job: Job,
    *,
    denoiser: Any = None,
    settings: RegularizerSettings | None = None,
    points: bool = False,
    **over: Any,
) -> Any:
    """The regularizer of a job's scene; ``points``: with the sight lines of its sparse points."""
    used = denoiser or load_denoiser("default", backend="onnx", threads=job.threads)
    if points:
        over = {"sight_line_weight": job.weights.sight_lines, "end_point_weight": job.weights.end_points, **over}
    over = {"cubes": job.cubes, "visibility_reach": REACH, "seed": job.seed, **over}
    return DensityRegularizer(
        used,
        aabb=job.base.aabb,
        cameras=job.scene.train.cameras,
        points=points_of(job) if points else None,
        field_pitch=job.base.field_pitch,
        settings=settings,
        **over,
    )


def points_of(job: Job) -> SparsePoints:
    """Points of the scene's training photos.

    Raises:
        ValueError: the scene has none.
    """
    if job.scene.points is None:
        raise ValueError(f"two_trajectory: {job.scene.name} has no sparse points (points.with_points makes them)")
    return job.scene.points


class _Losses:
    """The sum of a regularizer's losses and further terms, and which of them were 0 at every step."""

    def __init__(self, regularizer: Any, terms: Sequence[Term]) -> None:
        self.regularizer, self.terms = regularizer, {term.__qualname__.split(".")[0]: term for term in terms}
        self.active: set[str] = set()

    def __call__(self, field: Any, step: int) -> Tensor:
        prior = {} if self.regularizer is None else self.regularizer(field.density_fn)
        further = {name: term(field, step) for name, term in self.terms.items()}
        self.active |= {name for name, loss in {**prior, **further}.items() if bool(loss.detach() != 0)}
        return total([total(prior.values()), *further.values()])

    @property
    def idle(self) -> tuple[str, ...]:
        """Names of what did nothing."""
        expected = [*_switched_on(self.regularizer), *self.terms]
        return tuple(name for name in expected if name not in self.active and name not in NO_LOSSES)


def _switched_on(regularizer: Any) -> list[str]:
    """Losses of a regularizer that are not switched off."""
    if regularizer is None:
        return []
    s = regularizer.settings
    weights = {
        "dsds": s.dsds_weight,
        "visibility": s.visibility_weight,
        "sight_lines": 0.0 if regularizer.lines is None else s.sight_line_weight + s.end_point_weight,
    }
    return [name for name, weight in weights.items() if weight > 0]


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
    return _trained(job, copy.deepcopy(job.base), make, terms, config=config, note=note, observed=observed)


def from_scratch(
    job: Job, make: Callable[[Job], Any] | None = None, *terms: Term, config: TrainingConfig | None = None
) -> Outcome:
    """A fresh field, trained with these losses from the first step for as many steps as the fit has."""
    fresh = RadianceField(job.base.config)
    return _trained(job, fresh, make, terms, config=config, steps=job.fit_steps)


def _trained(
    job: Job,
    tuned: Any,
    make: Callable[[Job], Any] | None,
    terms: Sequence[Term],
    *,
    config: TrainingConfig | None = None,
    note: str = "",
    observed: bool = True,
    steps: int | None = None,
) -> Outcome:
    """Train a field in place; ``steps`` None: on from where it is, for the steps or the seconds of the job."""
    clock = Clock()
    regularizer = None if make is None else make(job)
    losses = _Losses(regularizer, terms)
    watched = None
    if regularizer is not None:
        watched = regularizer.observe if observed and regularizer.settings.dsds_weight > 0 else None
    left = None if job.seconds is None else max(job.seconds - clock.read()["seconds"], 1e-3)
    budget: dict[str, Any] = {"steps": steps or job.steps} if steps or left is None else {"seconds": left}
    record = train_field(
        tuned,
        job.scene.train.cameras,
        job.scene.train.photos,
        seed=job.seed,
        config=config or job.fitting,
        fine_tune=steps is None,
        observer=watched,
        regularizer=losses if terms or regularizer is not None else None,
        **budget,
    )
    return Outcome(tuned, **clock.read(), steps=record["steps"], note=note, idle=losses.idle)


def visibility(job: Job) -> Any:
    return make_regularizer(job, dsds_weight=0.0)


def sight_lines(job: Job) -> Any:
    """The visibility loss, and ours on sight lines."""
    return make_regularizer(job, points=True, dsds_weight=0.0)


def lines_alone(job: Job) -> Any:
    """Ours on sight lines, without the visibility loss."""
    return make_regularizer(job, points=True, dsds_weight=0.0, visibility_weight=0.0)
