"""A contracted voxel radiance field: density and colour on dense trilinear grids.

The box ``[-1, 1]^3`` is kept as it is; everything outside is contracted to ``[-2, 2]^3`` as in
mip-NeRF 360, with the maximum norm: ``x -> (2 - 1/|x|) x/|x|``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..core.errors import InvalidArgument
from .trilinear import trilinear

CONTRACTED = 2.0  # half side of the contracted cube
SH_COEFFICIENTS = 4  # spherical harmonics of degree 1 per colour channel
Shade = Callable[[Tensor, Tensor], Tensor]  # rows (K,) and unit directions (K, 3) to RGB (K, 3)
SH_CONSTANT, SH_LINEAR = 0.28209479177387814, 0.4886025119029199


@dataclass(frozen=True)
class RadianceConfig:
    """Size and start of the field.

    Attributes:
        resolution: density nodes along an axis of the contracted cube.
        color_resolution: colour nodes along an axis.
        initial_opacity: opacity of one cell before training.
        contract: False for a scene that lies wholly in [-1, 1]^3; the grid then covers just that box.

    Example:
        >>> RadianceField(RadianceConfig(resolution=16, color_resolution=8)).resolution
        16
    """

    resolution: int = 160
    color_resolution: int = 128
    initial_opacity: float = 0.01
    contract: bool = True

    def __post_init__(self) -> None:
        if min(self.resolution, self.color_resolution) < 4:
            raise InvalidArgument(
                f"RadianceConfig: resolutions must be >= 4, got {self.resolution}, {self.color_resolution}"
            )
        if not 0.0 < self.initial_opacity < 1.0:
            raise InvalidArgument(f"RadianceConfig: initial_opacity must lie in (0, 1), got {self.initial_opacity}")


def contract(positions: Tensor) -> Tensor:
    """Contract ``(..., 3)`` into [-2, 2]^3 (mip-NeRF 360, eq. 10, maximum norm).

    Example:
        >>> contract(torch.tensor([[0.5, 0.0, 0.0], [4.0, 0.0, 0.0]])).tolist()
        [[0.5, 0.0, 0.0], [1.75, 0.0, 0.0]]
    """
    norm = positions.abs().amax(dim=-1, keepdim=True).clamp_min(1.0)
    return (2.0 - 1.0 / norm) * positions / norm


class RadianceField(torch.nn.Module):
    """Density and view-dependent colour; see :class:`RadianceConfig`.

    ``density = softplus(raw) / cell``, so that a raw value means the same opacity at any resolution.

    Example:
        >>> field = RadianceField(RadianceConfig(resolution=8, color_resolution=8, initial_opacity=0.01))
        >>> density = field.density_fn(torch.zeros(1, 3)).detach()
        >>> round(1 - float(torch.exp(-density * field.field_pitch)), 4)  # opacity of one cell
        0.01
    """

    def __init__(self, config: RadianceConfig | None = None) -> None:
        super().__init__()
        self.config = config or RadianceConfig()
        optical_depth = -np.log1p(-self.config.initial_opacity)
        raw = float(np.log(np.expm1(optical_depth)))
        self.density_table = torch.nn.Parameter(torch.full((self.config.resolution**3, 1), raw))
        self.color_table = torch.nn.Parameter(torch.zeros(self.config.color_resolution**3, 3 * SH_COEFFICIENTS))

    @property
    def aabb(self) -> NDArray[np.float64]:
        """``(2, 3)``: the box that is not contracted."""
        return np.array([[-1.0] * 3, [1.0] * 3])

    @property
    def half_side(self) -> float:
        """Half side of the cube that the grids cover."""
        return CONTRACTED if self.config.contract else 1.0

    @property
    def field_pitch(self) -> float:
        """Side of a density cell inside the aabb, scene units."""
        return 2.0 * self.half_side / (self.resolution - 1)

    @property
    def resolution(self) -> int:
        """Density nodes along an axis, now (training refines it)."""
        side: int = round(self.density_table.shape[0] ** (1 / 3))
        return side

    @property
    def color_resolution(self) -> int:
        """Colour nodes along an axis, now."""
        side: int = round(self.color_table.shape[0] ** (1 / 3))
        return side

    def _grid_coordinates(self, positions: Tensor, resolution: int) -> Tensor:
        local = contract(positions) if self.config.contract else positions.clamp(-self.half_side, self.half_side)
        return (local + self.half_side) * ((resolution - 1) / (2.0 * self.half_side))

    def density_fn(self, positions: Tensor) -> Tensor:
        """Density per scene unit at ``positions (..., 3)``: ``(..., 1)``, >= 0; 0 outside an uncontracted box.

        Positions that are NaN, or infinite in a contracted field, give NaN.
        """
        flat = positions.reshape(-1, 3).to(self.density_table.dtype)
        raw = trilinear(self.density_table, self._grid_coordinates(flat, self.resolution), self.resolution)
        density = torch.nn.functional.softplus(raw) / self.field_pitch
        if not self.config.contract:
            density = density * (flat.abs().amax(dim=-1, keepdim=True) <= 1.0)
        return density.reshape(*positions.shape[:-1], 1)

    @torch.no_grad()
    def occupied_nodes(self, minimal_opacity: float) -> Tensor:
        """Density nodes ``(resolution^3,)`` that have, or touch one that has, more than ``minimal_opacity`` a cell."""
        side = self.resolution
        opacity = -torch.expm1(-torch.nn.functional.softplus(self.density_table)).view(1, 1, side, side, side)
        return (torch.nn.functional.max_pool3d(opacity, 3, stride=1, padding=1) > minimal_opacity).reshape(-1)

    @torch.no_grad()
    def nearest_nodes(self, positions: Tensor) -> Tensor:
        """Row of the density node nearest to each of ``positions (N, 3)``: ``(N,)`` int64."""
        side = self.resolution
        node = (self._grid_coordinates(positions, side) + 0.5).to(torch.int64).clamp_(0, side - 1)
        return (node[:, 0] * side + node[:, 1]) * side + node[:, 2]

    def color(self, positions: Tensor, directions: Tensor) -> Tensor:
        """RGB in (0, 1) at ``positions (N, 3)`` seen along unit ``directions (N, 3)``: ``(N, 3)``."""
        coordinates = self._grid_coordinates(positions, self.color_resolution)
        coefficients = trilinear(self.color_table, coordinates, self.color_resolution)
        basis = torch.cat([torch.full_like(directions[:, :1], SH_CONSTANT), SH_LINEAR * directions], dim=1)
        return torch.sigmoid(torch.einsum("ncb,nb->nc", coefficients.view(-1, 3, SH_COEFFICIENTS), basis))

    def query(self, positions: Tensor) -> tuple[Tensor, Shade]:
        """Density ``(M,)`` at ``positions (M, 3)``, and colours of rows of them: :class:`~.kinds.TrainableField`."""
        return self.density_fn(positions)[:, 0], lambda rows, directions: self.color(positions[rows], directions)

    def parameter_groups(self) -> list[tuple[list[torch.nn.Parameter], float]]:
        """Parameters and their learning rates relative to the run's; see :class:`~.kinds.TrainableField`."""
        return [(list(self.parameters()), 1.0)]

    def refine(self, share: float) -> bool:
        """Go to ``share`` in (0, 1] of the configured resolutions; True if that changed them."""
        sizes = (self.config.resolution, self.config.color_resolution)
        density, color = (min(size, max(8, round(size * share))) for size in sizes)
        if (self.resolution, self.color_resolution) == (density, color):
            return False
        self.resample(density, color)
        return True

    @torch.no_grad()
    def resample(self, resolution: int, color_resolution: int) -> None:
        """Change both grids' resolution by trilinear interpolation (values are kept, optimizer state is not)."""
        for name, size in (("density_table", resolution), ("color_table", color_resolution)):
            table = getattr(self, name)
            side = round(len(table) ** (1 / 3))
            volume = table.T.reshape(1, -1, side, side, side)
            finer = torch.nn.functional.interpolate(volume, size=(size,) * 3, mode="trilinear", align_corners=True)
            setattr(self, name, torch.nn.Parameter(finer.reshape(table.shape[1], -1).T.contiguous()))
