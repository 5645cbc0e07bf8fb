"""Kinds of radiance field behind one interface: what fitting, rendering and harvesting need to know of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..core.errors import InvalidArgument
from .frequency_mlp import FrequencyConfig, FrequencyField
from .hash_grid import HashConfig, HashField
from .radiance import RadianceConfig, RadianceField, Shade


class TrainableField(Protocol):
    """A field that :func:`~.training.train_field` can fit and :func:`~.rendering.render_view` can show."""

    @property
    def aabb(self) -> NDArray[np.float64]:
        """``(2, 3)``: the box that is not contracted."""

    @property
    def field_pitch(self) -> float:
        """Side of what stands for a cell, scene units."""

    def density_fn(self, positions: Tensor) -> Tensor:
        """Density per scene unit at ``positions (..., 3)``: ``(..., 1)``, >= 0."""

    def color(self, positions: Tensor, directions: Tensor) -> Tensor:
        """RGB in (0, 1) at ``positions (N, 3)`` seen along unit ``directions (N, 3)``: ``(N, 3)``."""

    def query(self, positions: Tensor) -> tuple[Tensor, Shade]:
        """Density ``(M,)`` at ``positions (M, 3)``, and a function of rows ``(K,)`` of them and directions ``(K, 3)``.

        The function gives their colours ``(K, 3)``. Both as :meth:`density_fn` and :meth:`color` do, but what the
        two have in common is computed once.
        """

    def parameters(self) -> Iterator[torch.nn.Parameter]:
        """All that is fitted."""

    def parameter_groups(self) -> list[tuple[list[torch.nn.Parameter], float]]:
        """Parameters and their learning rates relative to :class:`~.training.TrainingConfig`'s."""

    def refine(self, share: float) -> bool:
        """Go to ``share`` of the final resolution; True if that made new parameters."""

    def occupied_nodes(self, minimal_opacity: float) -> Tensor:
        """Nodes ``(M,)`` of some grid near which a cell may have more than ``minimal_opacity``."""

    def nearest_nodes(self, positions: Tensor) -> Tensor:
        """Rows of that grid nearest to ``positions (N, 3)``: ``(N,)`` int64."""


def _dense(resolution: int, initial_opacity: float, contract: bool, seed: int) -> TrainableField:
    return RadianceField(RadianceConfig(resolution, max(48, resolution * 3 // 4), initial_opacity, contract))


def _hash(resolution: int, initial_opacity: float, contract: bool, seed: int) -> TrainableField:
    return HashField(HashConfig(resolution, initial_opacity=initial_opacity, contract=contract, seed=seed))


def _mlp(resolution: int, initial_opacity: float, contract: bool, seed: int) -> TrainableField:
    return FrequencyField(FrequencyConfig(resolution, initial_opacity=initial_opacity, contract=contract, seed=seed))


KINDS: dict[str, Callable[[int, float, bool, int], TrainableField]] = {"dense": _dense, "hash": _hash, "mlp": _mlp}


def make_field(
    kind: str, resolution: int, *, initial_opacity: float = 0.01, contract: bool = True, seed: int = 0
) -> TrainableField:
    """A fresh field of a kind.

    Args:
        kind: ``dense`` (a trilinear grid), ``hash`` (a multi-resolution hash grid) or ``mlp`` (frequency-encoded).
        resolution: what the kind calls so: about ``1 / field_pitch`` times the side of the cube it covers.
        initial_opacity: of one cell, before training.
        contract: False for a scene that lies wholly in [-1, 1]^3.
        seed: of the start values (a dense grid starts even and needs none).

    Raises:
        ValueError: no such kind.

    Example:
        >>> [type(make_field(kind, 16)).__name__ for kind in ("dense", "hash", "mlp")]
        ['RadianceField', 'HashField', 'FrequencyField']
    """
    if kind not in KINDS:
        raise InvalidArgument(f"make_field: kind must be one of {', '.join(KINDS)}, got {kind!r}")
    return KINDS[kind](resolution, initial_opacity, contract, seed)
