"""The rivals' losses as terms of a training step: where each is applied, and how much it weighs."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from unghost.baselines.losses import depth_smoothness_loss, free_space_loss, sparsity_loss, total_variation_loss
from unghost.core.cameras import Cameras
from unghost.fields.rendering import render_rays

from .job import Job, Term

SPARSITY_POINTS, FREE_POINTS, TV_CUBES, TV_SIDE, PATCHES, PATCH = 1 << 15, 1 << 17, 12, 17, 10, 8


def _points(job: Job, count: int, step: int, stream: int) -> Tensor:
    """Uniform in the box ``(count, 3)``."""
    rng = np.random.default_rng([job.seed, step, stream])
    return torch.from_numpy(rng.uniform(job.base.aabb[0], job.base.aabb[1], (count, 3)).astype(np.float32))


def sparsity(job: Job) -> Term:
    def term(field: Any, step: int) -> Tensor:
        density = field.density_fn(_points(job, SPARSITY_POINTS, step, 11))
        return job.weights.sparsity * sparsity_loss(density, length=field.field_pitch).mean()

    return term


def free_space(job: Job) -> Term:
    def term(field: Any, step: int) -> Tensor:
        density = field.density_fn(_points(job, FREE_POINTS, step, 12))
        return job.weights.free_space * free_space_loss(density).mean()

    return term


def total_variation(job: Job) -> Term:
    def term(field: Any, step: int) -> Tensor:
        pitch = field.field_pitch
        corners = _points(job, TV_CUBES, step, 13)
        axis = torch.arange(TV_SIDE) * pitch
        lattice = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1)
        density = field.density_fn(corners[:, None, None, None] + lattice)[..., 0]
        return job.weights.tv * total_variation_loss(density * pitch).mean()

    return term


def unseen_patches(cameras: Cameras, rng: np.random.Generator, count: int, side: int) -> tuple[Tensor, Tensor]:
    """Patches of rays of cameras between two of the training cameras, somewhat off the way: RegNeRF's unseen views.

    Returns:
        Origins and unit directions, ``(count, side, side, 3)`` float32.
    """
    starts, towards = [], []
    for _ in range(count):
        first, second = rng.choice(len(cameras), 2, replace=len(cameras) < 2)
        share = rng.uniform()
        row, column = rng.integers(0, cameras.height - side + 1), rng.integers(0, cameras.width - side + 1)
        pixels = np.stack(np.meshgrid(np.arange(side) + column, np.arange(side) + row), axis=-1) + 0.5
        _, directions = cameras.rays(int(first), pixels.reshape(-1, 2))
        origin = (1 - share) * cameras.origins[first] + share * cameras.origins[second]
        origin = origin + rng.normal(0, 0.1, 3) * np.linalg.norm(np.ptp(cameras.origins, axis=0)) / np.sqrt(3)
        starts.append(np.broadcast_to(origin, directions.shape))
        towards.append(directions)
    shape = (count, side, side, 3)
    return tuple(torch.from_numpy(np.stack(part).reshape(shape).astype(np.float32)) for part in (starts, towards))  # type: ignore[return-value]


def regnerf(job: Job) -> Term:
    def term(field: Any, step: int) -> Tensor:
        rng = np.random.default_rng([job.seed, step, 14])
        starts, towards = unseen_patches(job.scene.train.cameras, rng, PATCHES, PATCH)
        rendering = render_rays(field, starts.reshape(-1, 3), towards.reshape(-1, 3), job.scene.sampling)
        middles = (rendering.edges[:, 1:] + rendering.edges[:, :-1]) / 2
        left = (1 - rendering.accumulation) * job.scene.sampling.middle
        depth = (rendering.weights * middles.clamp_max(job.scene.sampling.middle)).sum(1) + left
        return job.weights.regnerf * depth_smoothness_loss(depth.view(PATCHES, PATCH, PATCH)).mean()

    return term
