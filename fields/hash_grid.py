"""A hash-grid radiance field after Müller et al. 2022 (instant neural graphics primitives), for a CPU.

Level ``l`` is a trilinear grid of ``N_l`` cells along an axis, ``N_l`` growing geometrically from
``base_resolution`` to ``resolution`` (their eq. 2 and 3). Its nodes are rows of a table: row by row while they
fit, else by the spatial hash ``(x * 1) xor (y * 2654435761) xor (z * 805459861) mod rows`` (eq. 4), so that
nodes share rows. A lookup is a sparse matrix with eight weights a row times the table, see :mod:`.trilinear`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ..core.errors import InvalidArgument
from ..core.interpolate import corner_weights, lower_nodes
from .implicit import EncodedField, check_encoded
from .trilinear import weighted_rows

PRIMES = (1, 2654435761, 805459861)


@dataclass(frozen=True)
class HashConfig:
    """Size and start of the field.

    Attributes:
        resolution: cells of the finest level along an axis of the contracted cube.
        base_resolution: cells of the coarsest level.
        levels: how many; their paper has 16, on a CPU fewer are enough for photos of a hundred pixels.
        rows: of each level's table at most; a power of two up to 2^20.
        features: numbers a row.
        width, hidden: of the networks behind.
        initial_opacity: opacity of one finest cell before training.
        contract: False for a scene that lies wholly in [-1, 1]^3.
        seed: of the start values.

    Example:
        >>> HashConfig(resolution=64, base_resolution=16, levels=3).resolutions
        (16, 32, 64)
    """

    resolution: int = 128
    base_resolution: int = 12
    levels: int = 5
    rows: int = 2**15
    features: int = 2
    width: int = 32
    hidden: int = 1
    initial_opacity: float = 0.01
    contract: bool = True
    seed: int = 0

    def __post_init__(self) -> None:
        check_encoded(self)
        if not 1 <= self.base_resolution <= self.resolution:
            raise InvalidArgument(
                f"HashConfig: base_resolution must lie in [1, resolution = {self.resolution}], "
                f"got {self.base_resolution}"
            )
        if min(self.levels, self.features) < 1:
            raise InvalidArgument(
                f"HashConfig: levels and features must be >= 1, got {self.levels} and {self.features}"
            )
        if not 2 <= self.rows <= 2**20 or self.rows & (self.rows - 1):
            raise InvalidArgument(f"HashConfig: rows must be a power of two in [2, 2^20], got {self.rows}")

    @property
    def resolutions(self) -> tuple[int, ...]:
        """Cells along an axis of every level, coarse to fine; the last is ``resolution``."""
        if self.levels == 1:
            return (self.resolution,)
        growth = (math.log(self.resolution) - math.log(self.base_resolution)) / (self.levels - 1)
        return tuple(round(self.base_resolution * math.exp(growth * level)) for level in range(self.levels))


def level_rows(resolution: int, rows: int) -> int:
    """Rows of a level: one for each of ``(resolution + 1)^3`` nodes, at most ``rows``.

    Example:
        >>> level_rows(4, 2**8), level_rows(8, 2**8)
        (125, 256)
    """
    return min((resolution + 1) ** 3, rows)


def level_corners(unit: Tensor, resolution: int, rows: int) -> tuple[Tensor, Tensor]:
    """Rows ``(N, 8)`` int32 and weights ``(N, 8)`` of the nodes around ``unit (N, 3)`` in [0, 1].

    The eight stand in the order 000, 001, .., 111 of ``xyz``. A NaN gives NaN weights and some valid row.

    Example:
        >>> index, weights = level_corners(torch.tensor([[0.5, 0.0, 0.0]]), 3, 2**8)
        >>> index[0].tolist(), weights[0].tolist()
        ([16, 17, 20, 21, 32, 33, 36, 37], [0.5, 0.0, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0])
    """
    lower, shares = lower_nodes((unit * resolution).unbind(-1), (resolution + 1,) * 3)
    side = resolution + 1
    dense = side**3 <= rows
    # Only the low bits of a product count, and they come from the low bits of its factors: no overflow in int32.
    factors = (side * side, side, 1) if dense else tuple(prime % rows for prime in PRIMES)
    join = torch.add if dense else torch.bitwise_xor
    nearer = [node.to(torch.int32) * factor for node, factor in zip(lower, factors)]
    x, y, z = ((near, near + factor) for near, factor in zip(nearer, factors))
    corners = [join(first, last) for one in x for two in y for first in (join(one, two),) for last in z]
    index = torch.stack(corners, dim=1)
    return index if dense else index.bitwise_and_(rows - 1), torch.stack(corner_weights(shares), dim=1)


def hash_encode(table: Tensor, unit: Tensor, resolutions: tuple[int, ...], rows: int) -> Tensor:
    """Concatenated features of all levels.

    Args:
        table: ``(sum of level_rows, F)`` float, the levels one below the other.
        unit: ``(N, 3)`` in [0, 1]. No gradient flows to it.
        resolutions: cells along an axis of each level.
        rows: of a level at most, a power of two.

    Returns:
        ``(N, levels * F)``, differentiable with respect to the table.

    Raises:
        ValueError: the table has another number of rows.

    Example:
        >>> resolutions, rows = (4, 8), 2**8  # 5^3 nodes have a row each, 9^3 share 2^8
        >>> table = torch.ones(sum(level_rows(resolution, rows) for resolution in resolutions), 2)
        >>> hash_encode(table, torch.full((3, 3), 0.3), resolutions, rows).shape
        torch.Size([3, 4])
    """
    sizes = [level_rows(resolution, rows) for resolution in resolutions]
    if len(table) != sum(sizes):
        raise InvalidArgument(f"hash_encode: table must have {sum(sizes)} rows for {resolutions}, got {len(table)}")
    count, levels = len(unit), len(resolutions)
    index = torch.empty(levels, count, 8, dtype=torch.int32, device=unit.device)
    weights = torch.empty(levels, count, 8, dtype=table.dtype, device=unit.device)
    first = 0
    for level, (resolution, size) in enumerate(zip(resolutions, sizes)):
        corners, share = level_corners(unit.detach(), resolution, rows)
        torch.add(corners, first, out=index[level])
        weights[level] = share
        first += size
    found = weighted_rows(table, index.view(-1, 8), weights.view(-1, 8))
    return found.view(levels, count, table.shape[1]).transpose(0, 1).flatten(1)


class HashField(EncodedField):
    """Multi-resolution hash encoding and small networks; see :class:`HashConfig`.

    Its ``field_pitch`` is the side of its finest cell: within one, the encoding is trilinear.

    Example:
        >>> field = HashField(HashConfig(resolution=16, base_resolution=4, levels=2, rows=2**8))
        >>> field.density_fn(torch.zeros(5, 3)).shape
        torch.Size([5, 1])
    """

    def __init__(self, config: HashConfig | None = None) -> None:
        config = config or HashConfig()
        super().__init__(config, config.levels * config.features)
        self.config = config
        rows = sum(level_rows(resolution, config.rows) for resolution in config.resolutions)
        generator = torch.Generator().manual_seed(config.seed + 1)
        self.table = torch.nn.Parameter(torch.rand(rows, config.features, generator=generator) * 2e-4 - 1e-4)

    def encode(self, local: Tensor) -> Tensor:
        """Features ``(N, levels * features)`` of ``local (N, 3)`` in [-half_side, half_side]."""
        unit = (local + self.half_side) / (2.0 * self.half_side)
        return hash_encode(self.table, unit, self.config.resolutions, self.config.rows)

    def parameter_groups(self) -> list[tuple[list[torch.nn.Parameter], float]]:
        """Parameters and their learning rates relative to a dense grid's."""
        return [([self.table], 1.0), ([*self.trunk.parameters(), *self.head.parameters()], 0.1)]
