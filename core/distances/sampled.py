"""A signed distance known at the nodes of a grid: a solid of any shape for a scene or a voxeliser. numpy only."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InvalidArgument
from ..interpolate import interpolate_grid

Array = NDArray[Any]


@dataclass(frozen=True)
class SampledDistance:
    """Trilinear between nodes: its zero set *is* the solid, so that photos and labels agree on it exactly.

    Beyond the grid the value is a lower bound of the distance: a ray may step that far.

    Attributes:
        values: ``(X, Y, Z)`` float32 signed distances at the nodes, > 0 on all six sides of the grid.
        low: ``(3,)``, the first node.
        pitch: between neighbouring nodes.
    """

    values: NDArray[np.float32]
    low: Array
    pitch: float

    def __post_init__(self) -> None:
        shape = self.values.shape
        if len(shape) != 3 or min(shape) < 2:
            raise InvalidArgument(
                f"SampledDistance: values must have shape (X, Y, Z) with 2 nodes or more, got {shape}"
            )
        if not (np.isfinite(self.values).all() and 0 < self.pitch < np.inf):
            raise InvalidArgument(f"SampledDistance: values must be finite and pitch > 0, got pitch {self.pitch}")
        sides = [self.values.take(end, axis=axis).min() for axis in range(3) for end in (0, -1)]
        if min(sides) <= 0:
            raise InvalidArgument(f"SampledDistance: values must be > 0 on the sides of the grid, got {min(sides)}")

    @property
    def bound(self) -> float:
        """Radius of a ball around the origin that holds the solid."""
        solid = np.argwhere(self.values <= 0)
        if not len(solid):
            return 0.0
        nodes = self.low + solid * self.pitch
        return float(np.linalg.norm(nodes, axis=1).max() + np.sqrt(3.0) * self.pitch)

    def scaled(self, factor: float) -> SampledDistance:
        """The same solid ``factor`` times as large."""
        if not 0 < factor < np.inf:
            raise InvalidArgument(f"scaled: factor must be finite and > 0, got {factor}")
        return SampledDistance(self.values * np.float32(factor), self.low * factor, self.pitch * factor)

    def __call__(self, positions: Array) -> Array:
        """Signed distance ``(...)`` at ``positions (..., 3)``, in the grid's coordinates."""
        place = (np.asarray(positions, dtype=np.float64).reshape(-1, 3) - self.low) / self.pitch
        within = np.clip(place, 0.0, np.array(self.values.shape) - 1.0)
        result: Array = interpolate_grid(self.values, within, dtype=np.float64)
        beyond = np.linalg.norm(place - within, axis=1) * self.pitch
        out = beyond > 0
        result[out] = np.maximum(result[out] - beyond[out], beyond[out])
        return result.reshape(np.shape(positions)[:-1])
