"""Volume rendering of any :class:`~.kinds.TrainableField`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..core.cameras import Cameras

if TYPE_CHECKING:
    from .kinds import TrainableField


@dataclass(frozen=True)
class Sampling:
    """Where samples lie along a ray: evenly up to ``middle``, then evenly in inverse distance to ``far``.

    Attributes:
        near, middle, far: distances in scene units.
        near_samples, far_samples: how many in either part.
        minimal_weight: samples below this rendering weight get no colour lookup (their density still counts).
    """

    near: float = 0.05
    middle: float = 2.4
    far: float = 100.0
    near_samples: int = 96
    far_samples: int = 24
    minimal_weight: float = 1e-3

    def edges(self) -> Tensor:
        """``(samples + 1,)`` interval edges, ascending."""
        inner = torch.linspace(self.near, self.middle, self.near_samples + 1)
        if not self.far_samples:
            return inner
        outer = 1.0 / torch.linspace(1.0 / self.middle, 1.0 / self.far, self.far_samples + 1)
        return torch.cat([inner, outer[1:]])


@dataclass(frozen=True)
class Rendering:
    """Per ray: ``rgb (N, 3)`` without background, ``weights (N, S)``, ``edges (N, S + 1)`` distances.

    Example:
        >>> weights, edges = torch.tensor([[0.5, 0.25, 0.0]]), torch.tensor([[0.0, 1.0, 2.0, 3.0]])
        >>> rendering = Rendering(torch.zeros(1, 3), weights, edges, torch.zeros(1, 3, 3), torch.zeros(1, 3))
        >>> rendering.accumulation.tolist()
        [0.75]
    """

    rgb: Tensor
    weights: Tensor
    edges: Tensor
    positions: Tensor
    density: Tensor

    @property
    def accumulation(self) -> Tensor:
        """``(N,)`` in [0, 1]."""
        return self.weights.sum(dim=1)


def render_rays(
    field: TrainableField,
    origins: Tensor,
    directions: Tensor,
    sampling: Sampling,
    *,
    generator: torch.Generator | None = None,
    occupied: Tensor | None = None,
) -> Rendering:
    """Render rays ``(N, 3)``; with a generator, samples are jittered within their intervals.

    ``occupied``: nodes of the field's ``occupied_nodes``; samples nearest to other nodes are taken as empty.

    Example:
        >>> from unghost.fields.radiance import RadianceConfig, RadianceField
        >>> field = RadianceField(RadianceConfig(resolution=8, color_resolution=8, initial_opacity=0.5))
        >>> origins, directions = torch.zeros(1, 3), torch.tensor([[0.0, 0.0, -1.0]])
        >>> rendering = render_rays(field, origins, directions, Sampling())
        >>> round(float(rendering.accumulation[0].detach()), 2)  # share of the light that the field stops
        1.0
    """
    edges = sampling.edges().expand(len(origins), -1)
    fraction = torch.rand(len(origins), edges.shape[1] - 1, generator=generator) if generator else torch.tensor(0.5)
    lengths = edges[:, 1:] - edges[:, :-1]
    middles = edges[:, :-1] + fraction * lengths
    positions = origins[:, None] + middles[..., None] * directions[:, None]
    flat = positions.view(-1, 3)
    if occupied is None:
        values, shade = field.query(flat)
        rank, density = torch.arange(len(flat)), values.view(positions.shape[:2])
    else:
        mask = occupied[field.nearest_nodes(flat)]
        inhabited = mask.nonzero()[:, 0]
        values, shade = field.query(flat[inhabited])
        rank = mask.cumsum(0) - 1  # row in what was queried
        density = torch.zeros(len(flat)).index_put((inhabited,), values).view(positions.shape[:2])
    depth = density * lengths
    transmittance = torch.exp(-torch.cumsum(depth, dim=1) + depth)
    weights = transmittance * -torch.expm1(-depth)
    chosen = weights.detach() > sampling.minimal_weight
    ray = chosen.nonzero()[:, 0]
    color = shade(rank[chosen.view(-1)], directions[ray])
    rgb = torch.zeros_like(origins).index_add(0, ray, color * weights[chosen][:, None])
    return Rendering(rgb, weights, edges, positions, density)


def depth_spread(rendering: Rendering) -> Tensor:
    """``(N,)`` standard deviation of the logarithm of where a ray ends; light that gets through ends at the last edge.

    About the relative error of a depth that is read off the ray: 0 for a sharp surface, large in fog.

    Example:
        >>> edges = torch.tensor([[0.0, 1.0, 2.0, 3.0]])
        >>> weights = torch.tensor([[0.5, 0.4, 0.0]])
        >>> rendering = Rendering(torch.zeros(1, 3), weights, edges, torch.zeros(1, 3, 3), torch.zeros(1, 3))
        >>> depth_spread(rendering).shape
        torch.Size([1])
    """
    edges = rendering.edges
    middles = torch.log((edges[:, 1:] + edges[:, :-1]) / 2.0)
    places = torch.cat([middles, torch.log(edges[:, -1:])], dim=1)
    weights = torch.cat([rendering.weights, (1.0 - rendering.accumulation[:, None]).clamp_min(0.0)], dim=1)
    weights = weights / weights.sum(dim=1, keepdim=True)
    mean = (weights * places).sum(dim=1, keepdim=True)
    return torch.sqrt((weights * (places - mean) ** 2).sum(dim=1))


def median_distance(rendering: Rendering) -> Tensor:
    """``(N,)`` distance along the ray at which transmittance falls below one half; inf where it never does.

    Example:
        >>> edges = torch.tensor([[0.0, 1.0, 2.0, 3.0]])
        >>> weights = torch.tensor([[0.5, 0.4, 0.0]])
        >>> rendering = Rendering(torch.zeros(1, 3), weights, edges, torch.zeros(1, 3, 3), torch.zeros(1, 3))
        >>> median_distance(rendering).tolist()
        [1.0]
    """
    accumulated = torch.cumsum(rendering.weights, dim=1)
    reached = accumulated >= 0.5
    index = reached.to(torch.int8).argmax(dim=1, keepdim=True)
    before = torch.gather(accumulated - rendering.weights, 1, index)
    weight = torch.gather(rendering.weights, 1, index).clamp_min(1e-12)
    low = torch.gather(rendering.edges, 1, index)
    high = torch.gather(rendering.edges, 1, index + 1)
    distance = low + (high - low) * ((0.5 - before) / weight).clamp(0.0, 1.0)
    return torch.where(reached.any(dim=1), distance[:, 0], torch.tensor(float("inf")))


@torch.no_grad()
def render_view(
    field: TrainableField,
    cameras: Cameras,
    index: int,
    *,
    sampling: Sampling | None = None,
    chunk: int = 4096,
    background: float = 0.5,
    values: Callable[[Tensor], Tensor] | None = None,
) -> dict[str, NDArray[np.float32]]:
    """Render one camera.

    Args:
        field, cameras, index: what is seen, and from where.
        sampling: along each ray.
        chunk: rays at a time.
        background: grey level behind everything.
        values: ``positions (M, 3) -> (M,)``, anything that is to be averaged along the rays as colours are.

    Returns:
        ``rgb (H, W, 3)`` in [0, 1]; ``depth (H, W)``: distance along the unit ray at which the
        transmittance falls below one half, inf where it never does; ``accumulation (H, W)``;
        ``spread (H, W)``: :func:`depth_spread`; with ``values``, ``values (H, W)``: their sum by rendering weight.

    Example:
        >>> from unghost.fields.radiance import RadianceConfig, RadianceField
        >>> cameras = Cameras.create(np.eye(3, 4)[None], np.array([8.0, 8.0, 4.0, 3.0]), 8, 6)
        >>> view = render_view(RadianceField(RadianceConfig(resolution=8, color_resolution=8)), cameras, 0)
        >>> {name: array.shape for name, array in view.items()}
        {'rgb': (6, 8, 3), 'depth': (6, 8), 'accumulation': (6, 8), 'spread': (6, 8)}
    """
    sampling = sampling or Sampling()
    origins, directions = cameras.rays(index)
    starts, towards = (torch.from_numpy(item.reshape(-1, 3)).float() for item in (origins, directions))
    parts = []
    for start, toward in zip(torch.split(starts, chunk), torch.split(towards, chunk)):
        rendering = render_rays(field, start, toward, sampling)
        rgb = rendering.rgb + (1.0 - rendering.accumulation[:, None]) * background
        maps = [median_distance(rendering), rendering.accumulation, depth_spread(rendering)]
        if values is not None:
            found = values(rendering.positions.reshape(-1, 3)).view_as(rendering.weights)
            maps.append((rendering.weights * found).sum(1))
        parts.append((rgb, *maps))
    shape = cameras.shapes[index]
    color, *planes = (torch.cat(column).numpy() for column in zip(*parts))
    names = ("depth", "accumulation", "spread", "values")
    return {"rgb": color.reshape(*shape, 3), **{name: plane.reshape(shape) for name, plane in zip(names, planes)}}
