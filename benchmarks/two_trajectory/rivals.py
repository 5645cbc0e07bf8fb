"""The rivals' losses as terms of a training step: where each is applied, and how much it weighs."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from unghost.baselines.losses import depth_smoothness_loss, free_space_loss, sparsity_loss, total_variation_loss
from unghost.baselines.point_losses import (
    ds_nerf_loss,
    expected_depth_loss,
    floater_score_loss,
    line_of_sight_loss,
    nearest_point_loss,
)
from unghost.core.cameras import Cameras
from unghost.core.lattice import lattice_origin
from unghost.core.occupancy import opacity_from_density
from unghost.core.sight_lines import SightLines
from unghost.core.sparse_points import SparsePoints
from unghost.fields.rendering import Rendering, render_rays

from .job import Job, Term, points_of

SPARSITY_POINTS, FREE_POINTS, TV_CUBES, TV_SIDE, PATCHES, PATCH = 1 << 15, 1 << 17, 12, 17, 10, 8
POINT_RAYS, POINT_PLACES = 1024, 1 << 14  # a step: rays to sparse points, places in the box
REACH_SHARE = 0.1  # of the median distance from a camera to a point that it observed: .25 m in a room seen from 2.5 m
MARGIN_CELLS, MARGIN_SIGMAS = 2.0, 2.0  # half width of what is near a point, as for our sight lines
NEIGHBORS = 5
SCORE_CELLS = 2.0  # cells of the field in one of the grid on which lines are counted


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


class PointRays:
    """Rays from cameras to the sparse points that they observed; those whose rays do not determine them are left out.

    Args:
        job: whose scene has points.
    """

    def __init__(self, job: Job) -> None:
        self.job, points, cameras = job, points_of(job), job.scene.train.cameras
        known = np.isfinite(points.uncertainty[points.point])
        who, seen_by = points.point[known], points.camera[known]
        self.origins = cameras.origins[seen_by]
        offset = points.xyz[who] - self.origins
        self.depth, self.deviation = np.linalg.norm(offset, axis=1), points.uncertainty[who]
        self.directions = offset / self.depth[:, None]

    def render(self, field: Any, step: int, stream: int) -> tuple[Rendering, Tensor, Tensor]:
        """Random rays of a step, and the depth and the deviation ``(n,)`` of their points; no ray without points."""
        rng = np.random.default_rng([self.job.seed, step, stream])
        count = POINT_RAYS if len(self.depth) else 0
        chosen = rng.integers(max(len(self.depth), 1), size=count)
        origins, directions, depth, deviation = (
            torch.from_numpy(part[chosen].astype(np.float32))
            for part in (self.origins, self.directions, self.depth, self.deviation)
        )
        return render_rays(field, origins, directions, self.job.scene.sampling), depth, deviation

    def margin(self, deviation: Tensor) -> Tensor:
        """Half width of what is near a point, scene units."""
        cells: float = MARGIN_CELLS * self.job.base.field_pitch
        return cells + MARGIN_SIGMAS * deviation


def ds_nerf(job: Job) -> Term:
    """Deviations are those of triangulation, but no less than a cell of the field: samples are as far apart."""
    rays = PointRays(job)

    def term(field: Any, step: int) -> Tensor:
        rendering, depth, deviation = rays.render(field, step, 15)
        loss = ds_nerf_loss(rendering.weights, rendering.edges, depth, deviation.clamp_min(job.base.field_pitch))
        return job.weights.ds_nerf * loss.mean()

    return term


def urban(job: Job) -> Term:
    """Expected depth and line of sight together, the margin fixed (the paper shrinks it while it trains)."""
    rays = PointRays(job)

    def term(field: Any, step: int) -> Tensor:
        rendering, depth, deviation = rays.render(field, step, 16)
        sight = line_of_sight_loss(rendering.weights, rendering.edges, depth, rays.margin(deviation)).sum(dim=1)
        return job.weights.urban * (expected_depth_loss(rendering.weights, rendering.edges, depth) + sight).mean()

    return term


def point_reach(points: SparsePoints, cameras: Cameras) -> float:
    """What .25 m is in a scene without a unit: a tenth of the median distance from a camera to what it observed."""
    return REACH_SHARE * float(
        np.median(np.linalg.norm(points.xyz[points.point] - cameras.origins[points.camera], axis=1))
    )


def nearest_point(job: Job) -> Term:
    points, tree = points_of(job), cKDTree(points_of(job).xyz)
    reach = point_reach(points, job.scene.train.cameras)

    def term(field: Any, step: int) -> Tensor:
        places = _points(job, POINT_PLACES, step, 17)
        distance = torch.from_numpy(tree.query(places.numpy())[0]).float()
        depth = field.density_fn(places)[:, 0] * job.base.field_pitch
        return job.weights.nearest_point * nearest_point_loss(depth, distance, reach=reach).mean()

    return term


class LineCounts:
    """How many sight lines pass through and how many end in each cell of a grid, wrong points and all.

    Args:
        job: whose scene has points.
    """

    def __init__(self, job: Job) -> None:
        points, box = points_of(job), job.base.aabb
        pitch = SCORE_CELLS * job.base.field_pitch
        lines = SightLines.build(
            points, job.scene.train.cameras, aabb=box, pitch=pitch, margin_cells=0, margin_sigmas=0, robust=False
        )
        self.pitch, self.shape = pitch, lines.crossing_count.shape
        self.origin = lattice_origin(lines.aabb, pitch, self.shape)
        cells, inside = self._cells(points.xyz[points.point])
        self.ending = np.zeros(self.shape, dtype=np.int64)
        np.add.at(self.ending, tuple(cells[inside].T), 1)
        self.through = np.maximum(lines.crossing_count - self.ending, 0)  # a line is in the cell that it ends in, too

    def _cells(self, places: NDArray[Any]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        cells = np.floor((places - self.origin) / self.pitch).astype(np.int64)
        inside: NDArray[np.bool_] = ((cells >= 0) & (cells < np.array(self.shape))).all(axis=-1)
        return cells, inside

    def at(self, places: NDArray[Any]) -> tuple[Tensor, Tensor]:
        """Lines through and lines that end at places ``(n, 3)`` of the box."""
        cells, _ = self._cells(places)
        index = tuple(np.clip(cells, 0, np.array(self.shape) - 1).T)
        return torch.from_numpy(self.through[index]).float(), torch.from_numpy(self.ending[index]).float()


def floater_score(job: Job) -> Term:
    """The score's neighbours are the places a cell of its grid away, along each axis."""
    points, counts, tree = points_of(job), LineCounts(job), cKDTree(points_of(job).xyz)
    reach, nearest = point_reach(points, job.scene.train.cameras), min(NEIGHBORS, len(points))
    around = counts.pitch * torch.cat([torch.eye(3), -torch.eye(3)])

    def term(field: Any, step: int) -> Tensor:
        places = _points(job, POINT_PLACES, step, 18)
        distance = tree.query(places.numpy(), k=[*range(1, nearest + 1)])[0].mean(axis=1)
        with torch.no_grad():
            beside = field.density_fn((places[:, None] + around).reshape(-1, 3))[:, 0].reshape(-1, 6)
        through, ending = counts.at(places.numpy())
        loss = floater_score_loss(
            field.density_fn(places)[:, 0] * job.base.field_pitch,
            through=through,
            ending=ending,
            distance=torch.from_numpy(distance).float(),
            neighbor_opacity=opacity_from_density(beside.amax(dim=1), counts.pitch).float(),
            reach=reach,
        )
        return job.weights.floater_score * loss.mean()

    return term
