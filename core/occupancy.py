"""Density, opacity and signed occupancy: the one place that converts between them.

    density  >= 0, per scene unit, after the field's activation
    opacity  1 - exp(-density * pitch) in [0, 1): what one cell of side ``pitch`` absorbs
    signed   2 * opacity - 1 in [-1, 1]: what a denoiser reads; a bit is -1 (empty) or +1 (occupied)

All functions take numpy arrays and torch tensors alike and return the same kind.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from .arrays import Array, namespace, to_numpy
from .errors import InvalidArgument, InvalidType

EMPTY = -1.0
OCCUPIED = 1.0
DECISION = 0.0  # x0_pred below it means "empty" (the paper, eq. 2)

FREE_LABEL, SURFACE_LABEL, IGNORE_LABEL = 0, 1, 2  # the three-valued labels of training pairs

PAPER_DENSITY_THRESHOLD = 0.01
DEFAULT_OPACITY_THRESHOLD = 0.1


def signed_from_occupancy(occupancy: Array) -> Array:
    """Booleans ``(...)`` to float32 signed occupancy, -1 empty and +1 occupied."""
    if namespace(occupancy) is np:
        return np.where(np.asarray(occupancy, dtype=bool), np.float32(OCCUPIED), np.float32(EMPTY))
    return occupancy.float() * (OCCUPIED - EMPTY) + EMPTY


def occupancy_from_signed(signed: Array) -> Array:
    """Signed occupancy ``(...)`` to booleans; a value exactly at ``DECISION`` counts as occupied."""
    return signed >= DECISION


def opacity_from_density(density: Array, pitch: Array | float) -> Array:
    """``1 - exp(-density * pitch)``, exact for tiny optical depths (expm1), in [0, 1]; 1 for depths beyond floats."""
    with np.errstate(over="ignore"):
        return -namespace(density).expm1(-density * pitch)


def signed_from_opacity(opacity: Array) -> Array:
    """Opacity in [0, 1] to the denoiser's domain [-1, 1]."""
    return opacity * (OCCUPIED - EMPTY) + EMPTY


def opacity_from_signed(signed: Array) -> Array:
    """Inverse of :func:`signed_from_opacity`."""
    return (signed - EMPTY) / (OCCUPIED - EMPTY)


@dataclass(frozen=True)
class OccupancyRule:
    """How a density becomes occupancy.

    Attributes:
        kind: ``"opacity"`` (default; independent of the scene's unit) or ``"density"`` (the paper).
        threshold: opacity in (0, 1), or a density > 0 per scene unit; above it a voxel is occupied.

    Example:
        >>> OccupancyRule().occupied(np.array([0.0, 1.0, 5.0]), pitch=0.05).tolist()  # opacity over one cell > 0.1
        [False, False, True]
        >>> OccupancyRule.paper().occupied(np.array([0.0, 1.0, 5.0]), pitch=0.05).tolist()
        [False, True, True]
    """

    kind: Literal["opacity", "density"] = "opacity"
    threshold: float = DEFAULT_OPACITY_THRESHOLD

    def __post_init__(self) -> None:
        if self.kind not in ("opacity", "density"):
            raise InvalidArgument(f"OccupancyRule: kind must be 'opacity' or 'density', got {self.kind!r}")
        upper = 1.0 if self.kind == "opacity" else math.inf
        if not 0.0 < self.threshold < upper:
            raise InvalidArgument(
                f"OccupancyRule: threshold must lie in (0, {upper}) for {self.kind}, got {self.threshold}"
            )

    @classmethod
    def paper(cls) -> OccupancyRule:
        """``density > 0.01``: the paper's tau."""
        return cls("density", PAPER_DENSITY_THRESHOLD)

    def density_threshold(self, pitch: Array | float) -> Array | float:
        """The density at which a voxel becomes occupied (the paper's tau)."""
        if self.kind == "density":
            return self.threshold
        return -math.log1p(-self.threshold) / pitch

    def occupied(self, density: Array, pitch: Array | float) -> Array:
        """Boolean occupancy of ``density (...)``; ``pitch`` broadcasts against it."""
        if self.kind == "density":
            return density > self.threshold
        return opacity_from_density(density, pitch) > self.threshold

    def encode(self, density: Array, pitch: Array | float, *, soft: bool = True) -> Array:
        """Denoiser input for ``density (...)``: signed opacity if ``soft`` and the rule allows, else a bit.

        Under the density rule the input is always a bit, as in the paper.
        """
        if soft and self.kind == "opacity":
            return signed_from_opacity(opacity_from_density(density, pitch))
        return signed_from_occupancy(self.occupied(density, pitch))


def check_density(density: Array, positions: Array, *, caller: str) -> None:
    """Raise unless every density is finite and >= 0; never clamps.

    Args:
        density: ``(N,)``.
        positions: ``(N, 3)``, the points at which it was asked, for the message.

    Raises:
        ValueError: counts NaN, infinite and negative values and names the first position.
    """
    xp = namespace(density)
    valid = xp.isfinite(density) & (density >= 0)
    if bool(valid.all()):
        return
    values, good = to_numpy(density).reshape(-1), to_numpy(valid).reshape(-1)
    counts = {
        "NaN": int(np.isnan(values).sum()),
        "infinite": int(np.isinf(values).sum()),
        "negative": int((values[np.isfinite(values)] < 0).sum()),
    }
    found = ", ".join(f"{count} {kind}" for kind, count in counts.items() if count)
    where = int(np.argmin(good))
    place = np.round(to_numpy(positions).reshape(-1, 3)[where].astype(float), 6).tolist()
    raise InvalidArgument(
        f"{caller}: densities must be finite and >= 0, got {found} of {values.size}; first {values[where]} at {place}"
    )


def warn_if_constant(lowest: float, highest: float, count: int, *, caller: str) -> None:
    """Warn if a density function gave one and the same density, other than 0, at ``count`` places of the box."""
    if count > 1 and lowest == highest > 0:
        warnings.warn(
            f"{caller}: density_fn returned {lowest:g} at each of {count} places: does it use its positions?",
            stacklevel=3,
        )


def check_density_shape(density: Any, positions: Array, *, caller: str) -> Array:
    """Accept ``(..., 1)`` or ``(...)`` for positions ``(..., 3)`` and return ``(...)``."""
    lead = tuple(positions.shape[:-1])
    shape = tuple(getattr(density, "shape", ()))
    if not hasattr(density, "shape"):
        raise InvalidType(f"{caller}: density_fn must return an array or tensor, got {type(density).__name__}")
    if shape == (*lead, 1):
        return density[..., 0]
    if shape == lead:
        return density
    raise InvalidArgument(
        f"{caller}: density_fn must return shape {(*lead, 1)} or {lead} for positions {(*lead, 3)}, got {shape}"
    )
