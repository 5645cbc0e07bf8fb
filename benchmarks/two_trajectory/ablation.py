"""The paper's ablation: where cubes are drawn, how large they are, and score distillation through an activation."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from unghost import load_denoiser
from unghost.baselines.losses import Squash, sds_loss, squash_density
from unghost.core.schedule import alphas_cumprod
from unghost.fields.rendering import render_rays
from unghost.regularizer.cubes import draw_cubes
from unghost.regularizer.settings import RegularizerSettings

from .job import Job, Outcome, fine_tuned, make_regularizer
from .methods import PAPER_PRIOR, paper, paper_timestep, restoration

POINTS_A_CELL = 1
WEIGHT_RAYS = 1024  # of each training photo, whose weights fill the grid
GRID_EVERY = 10  # steps after which all of the grid is looked at anew, as DSDS learns of its cubes
EDGES = {"1-10 %": (0.01, 0.1), "10-20 %": (0.1, 0.2), "1-20 %": (0.01, 0.2)}


def through_activation(job: Job, how: Squash) -> list[Outcome]:
    """The paper's "why not just": SDS, with noise, through a clamp or a sigmoid; beside the visibility loss."""
    denoiser = load_denoiser(str(PAPER_PRIOR), backend="onnx", threads=job.threads)
    settings = RegularizerSettings.paper(cubes=job.cubes, seed=job.seed, dsds_weight=job.weights.dsds_paper)
    regularizer = make_regularizer(job, denoiser=denoiser, settings=RegularizerSettings.paper(dsds_weight=0.0))
    cumulative = alphas_cumprod()

    def term(field: Any, step: int) -> Tensor:
        rng = np.random.default_rng([job.seed, step, 16])
        if step % GRID_EVERY == 0:
            _look(regularizer, field, rng)
        cubes = draw_cubes(regularizer.grid, rng, settings, field_pitch=None, resolution=32, device=torch.device("cpu"))
        signed = squash_density(field.density_fn(cubes.positions)[..., 0], threshold=settings.rule.threshold, how=how)
        t = paper_timestep(step)
        alpha = float(cumulative[t])
        noise = rng.standard_normal(signed.shape).astype(np.float32)
        noised = np.sqrt(alpha) * signed.detach().numpy() + np.sqrt(1 - alpha) * noise
        fractions = cubes.edge_fraction.astype(np.float32)
        x0_pred = denoiser(noised[:, None].astype(np.float32), np.full(len(noised), t, np.int64), fractions)[:, 0]
        loss = sds_loss(signed, torch.from_numpy(x0_pred), alpha_cumprod=alpha)
        return settings.dsds_weight * loss[cubes.inside].sum() / max(int(cubes.inside.sum()), 1)

    return [fine_tuned(job, lambda job: regularizer, term)]


def _look(regularizer: Any, field: Any, rng: np.random.Generator) -> None:
    """The densities of every cell into the grid that cubes are drawn by."""
    positions = torch.from_numpy(regularizer.grid.cell_points(rng, POINTS_A_CELL)).float()
    with torch.no_grad():
        regularizer.observe(positions, field.density_fn(positions))


def by_weights(job: Job) -> list[Outcome]:
    """Cubes where the training photos' rays end: accumulation weights, observed once, fill the grid."""
    denoiser = load_denoiser(str(PAPER_PRIOR), backend="onnx", threads=job.threads)
    settings = RegularizerSettings.paper(timestep=paper_timestep, dsds_weight=job.weights.dsds_paper)
    regularizer = make_regularizer(job, denoiser=denoiser, settings=settings)
    cameras, rng = job.scene.train.cameras, np.random.default_rng([job.seed, 18])
    with torch.no_grad():
        for index in range(len(cameras)):
            chosen = rng.permutation(cameras.width * cameras.height)[:WEIGHT_RAYS]
            starts, towards = (torch.from_numpy(part.reshape(-1, 3)[chosen]).float() for part in cameras.rays(index))
            rendering = render_rays(job.base, starts, towards, job.scene.sampling)
            regularizer.observe(rendering.positions, rendering.weights, kind="weight")
    weights, observed = regularizer.grid.values.copy(), regularizer.grid.observed.copy()

    def unchanged(field: Any, step: int) -> Tensor:
        """The densities of the cubes drawn must not take the weights' place."""
        regularizer.grid.values[:], regularizer.grid.observed[:] = weights, observed
        return torch.zeros(())

    return [fine_tuned(job, lambda job: regularizer, unchanged, observed=False)]


ABLATION: dict[str, Callable[[Job], list[Outcome]]] = {
    "paper, cubes drawn uniformly": lambda job: paper(job, strategy="uniform"),
    "paper, by densities": lambda job: paper(job, strategy="importance"),
    "paper, by weights": by_weights,
    "paper, clamp + SDS": lambda job: through_activation(job, "clamp"),
    "paper, sigmoid + SDS": lambda job: through_activation(job, "sigmoid"),
    "paper, edges 10-20 %": lambda job: paper(job, edge_range=EDGES["10-20 %"]),
    "paper, edges 1-20 %": lambda job: paper(job, edge_range=EDGES["1-20 %"]),
    "ours": restoration,
    "ours, cubes drawn uniformly": lambda job: restoration(job, strategy="uniform"),
    "ours, by densities": lambda job: restoration(job, strategy="importance"),
    **{f"ours, edges {name}": partial(restoration, edge_range=edges) for name, edges in EDGES.items()},
}
