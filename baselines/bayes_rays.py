"""Bayes' Rays (Goli et al., CVPR 2024): how far could a trained field be bent without its photos noticing?

A grid of displacements is laid over the trained field. Its Laplace approximation asks how much each training ray's
colour would change if a node moved: nodes that may move freely are uncertain, and so is the density around them. The
method needs no retraining and no prior. This is an independent implementation for any field of
:mod:`unghost.fields.kinds`: the colour's derivative along a ray is written out (:func:`color_slopes`), that of
density and colour in space is taken by central differences, so that a field need not be differentiable in its
positions.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..core.cameras import Cameras
from ..core.errors import InvalidArgument
from ..core.interpolate import trilinear_corners
from ..fields.kinds import TrainableField
from ..fields.radiance import CONTRACTED, contract
from ..fields.rendering import Rendering, Sampling, render_rays
from ..fields.training import gather_rays

PRIOR = 1e-4  # lambda of the paper, divided by the number of cells
STEP = 0.25  # of the central differences, in field cells
FAINT = 1e-4  # samples that less light than this reaches, or next to nothing, move nothing
LOWEST = -3.0  # log10 of the deviation: what is cut off below, the published code's


@dataclass(frozen=True, eq=False)
class DeformationUncertainty:
    """Made by :func:`deformation_uncertainty`.

    Attributes:
        hessian: ``((2^level + 1)^3,)`` float64: mean over the rays of the squared change of colour, by node.
        level: log2 of the cells along an axis of the contracted cube.
        rays: how many were asked.
    """

    hessian: Tensor
    level: int
    rays: int

    @property
    def highest(self) -> float:
        """Log10 of the deviation of a node that no photo feels; thresholds are shares of it, as published."""
        return 0.5 * math.log10(2 ** (3 * self.level) / PRIOR)

    def log_deviation(self, positions: Tensor) -> Tensor:
        """Log10 of the standard deviation, scene units, of displacements at ``positions (..., 3)``: ``(...)`` float32.

        Variances of the eight nodes, weighted by the squares of their trilinear weights, which are normalised.
        """
        index, weights = _corners(positions.reshape(-1, 3), self.level)
        variance = 1.0 / (self.hessian[index] + PRIOR / 2 ** (3 * self.level))
        squares = weights.double() ** 2
        mean = (variance * squares).sum(1) / squares.sum(1)
        return (0.5 * torch.log10(mean)).float().view(positions.shape[:-1])

    def keep(self, threshold: float) -> Keep:
        """Which positions are certain enough: for :class:`unghost.fields.filtered.FilteredField`.

        Args:
            threshold: in (0, 1], a share of :attr:`highest`; 1 keeps everything.
        """
        if not 0.0 < threshold <= 1.0:
            raise InvalidArgument(f"DeformationUncertainty.keep: threshold must lie in (0, 1], got {threshold}")
        return Keep(self, threshold * self.highest + 1e-6)


@dataclass(frozen=True, eq=False)
class Keep:
    """``positions (M, 3) -> (M,)`` bool: at most ``most`` of log10 deviation."""

    uncertainty: DeformationUncertainty
    most: float

    def __call__(self, positions: Tensor) -> Tensor:
        """See the class."""
        return self.uncertainty.log_deviation(positions) <= self.most


def deformation_uncertainty(
    field: TrainableField,
    cameras: Cameras,
    images: NDArray[np.float32],
    *,
    level: int = 7,
    rays: int = 1 << 16,
    batch: int = 1024,
    seed: int = 0,
    sampling: Sampling | None = None,
    background: float = 0.5,
) -> DeformationUncertainty:
    """The diagonal of the Hessian of a field's photometric error under displacements (the paper, eq. 9 and 10).

    Departures from the published code: rays are drawn without replacement while there are any left; the grid
    is coarser by default (2^7 cells an axis rather than 2^8), as these fields are.

    Args:
        field: trained.
        cameras, images: of the training photos ``(N, H, W, 3)``; the colours themselves are not used.
        level: log2 of the cells along an axis.
        rays: how many to ask.
        batch: of them at a time.
        seed: which ones.
        sampling: along each ray.
        background: grey level behind everything.

    Example:
        >>> from unghost.fields.radiance import RadianceConfig, RadianceField
        >>> cameras = Cameras.create(np.eye(3, 4)[None], np.array([8.0, 8.0, 4.0, 3.0]), 8, 6)
        >>> field = RadianceField(RadianceConfig(resolution=8, color_resolution=8))
        >>> _ = torch.nn.init.normal_(field.density_table, generator=torch.Generator().manual_seed(0))
        >>> found = deformation_uncertainty(field, cameras, np.zeros((1, 6, 8, 3), np.float32), level=3, rays=48)
        >>> behind, before = found.log_deviation(torch.tensor([[0.0, 0.0, 0.9], [0.0, 0.0, -0.5]])).tolist()
        >>> behind > before  # nothing is known of what lies behind the camera
        True
    """
    if level < 1 or rays < 1 or batch < 1:
        raise InvalidArgument(
            f"deformation_uncertainty: level, rays and batch must be >= 1, got {level}, {rays}, {batch}"
        )
    origins, directions, _ = gather_rays(cameras, images)
    generator = torch.Generator().manual_seed(seed)
    rounds = -(-rays // len(origins))
    order = torch.cat([torch.randperm(len(origins), generator=generator) for _ in range(rounds)])[:rays]
    hessian = torch.zeros((2**level + 1) ** 3, dtype=torch.float64)
    used = sampling or Sampling()
    with torch.no_grad():
        occupied = field.occupied_nodes(FAINT)
        for chosen in torch.split(order, batch):
            starts, towards = origins[chosen], directions[chosen]
            rendering = render_rays(field, starts, towards, used, generator=generator, occupied=occupied)
            _add(hessian, *_sensitivity(field, rendering, towards, background), level)
    return DeformationUncertainty(hessian / rays, level, rays)


def color_slopes(weights: Tensor, optical_depth: Tensor, lengths: Tensor, colors: Tensor, background: float) -> Tensor:
    """How a ray's colour changes with the density of each sample, by the volume rendering equation.

    ``dC / dsigma_i = length_i (T_{i+1} c_i - sum_{j > i} w_j c_j - T_end background)``.

    Args:
        weights, optical_depth, lengths: ``(N, S)``; the weights are those of the optical depths.
        colors: ``(N, S, 3)``.
        background: grey level.

    Returns:
        ``(N, S, 3)``.

    Example:
        >>> depth, lengths = torch.tensor([[0.0]]), torch.tensor([[1.0]])
        >>> weights = 1 - torch.exp(-depth)
        >>> color_slopes(weights, depth, lengths, torch.ones(1, 1, 3), 0.5)[0, 0].tolist()  # from grey towards white
        [0.5, 0.5, 0.5]
    """
    through = torch.exp(-torch.cumsum(optical_depth, dim=1))  # T_{i+1}
    seen = weights[..., None] * colors
    behind = seen.sum(1, keepdim=True) - torch.cumsum(seen, dim=1) + through[:, -1:, None] * background
    return lengths[..., None] * (through[..., None] * colors - behind)


def _sensitivity(
    field: TrainableField, rendering: Rendering, directions: Tensor, background: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Samples that matter: their rays ``(M,)``, positions ``(M, 3)`` and ``dC / dposition (M, 3 colours, 3 axes)``."""
    lengths = rendering.edges[:, 1:] - rendering.edges[:, :-1]
    depth = rendering.density * lengths
    reached = torch.exp(-torch.cumsum(depth, dim=1) + depth) > FAINT
    ray, sample = (reached & (rendering.density > 0)).nonzero().T
    flat, towards = rendering.positions[ray, sample], directions[ray]
    stretch = flat.abs().amax(1, keepdim=True).clamp_min(1.0) ** 2  # cells grow so where space is contracted
    step = STEP * field.field_pitch * stretch
    rows = torch.arange(len(flat))
    here = field.query(flat)[1](rows, towards)
    density_slope, color_slope = flat.new_zeros(len(flat), 3), flat.new_zeros(len(flat), 3, 3)
    for axis in range(3):
        offset = torch.zeros(3)
        offset[axis] = 1.0
        (up, shade_up), (down, shade_down) = (field.query(flat + sign * step * offset) for sign in (1.0, -1.0))
        density_slope[:, axis] = (up - down) / (2.0 * step[:, 0])
        color_slope[:, :, axis] = (shade_up(rows, towards) - shade_down(rows, towards)) / (2.0 * step)
    colors = torch.zeros(*rendering.weights.shape, 3)
    colors[ray, sample] = here
    slopes = color_slopes(rendering.weights, depth, lengths, colors, background)[ray, sample]
    moved = slopes[:, :, None] * density_slope[:, None] + rendering.weights[ray, sample][:, None, None] * color_slope
    return ray, flat, moved


def _add(hessian: Tensor, ray: Tensor, positions: Tensor, moved: Tensor, level: int) -> None:
    """Add the squares of each ray's summed sensitivity to each node, over colours and axes."""
    if not len(ray):
        return
    index, weights = _corners(positions, level)
    keys, place = torch.unique((ray[:, None] * len(hessian) + index).reshape(-1), return_inverse=True)
    parts = (weights[:, :, None] * moved.reshape(len(ray), 1, 9)).reshape(-1, 9)
    summed = torch.zeros(len(keys), 9).index_add_(0, place, parts)
    hessian.index_add_(0, keys % len(hessian), summed.double().square().sum(1))


def _corners(positions: Tensor, level: int) -> tuple[Tensor, Tensor]:
    """Flat indices ``(N, 8)`` and trilinear weights of the nodes around positions, in the contracted cube."""
    cells = 2**level
    return trilinear_corners((contract(positions) + CONTRACTED) / (2 * CONTRACTED) * cells, (cells + 1,) * 3)
