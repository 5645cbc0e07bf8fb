"""A radiance field of which some density is left out: what a keep mask or an uncertainty threshold makes of it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from torch import Tensor

from .kinds import TrainableField
from .radiance import Shade


class FilteredField:
    """A field with no density where ``keep`` says so; for rendering, not for training.

    Args:
        field: what is filtered; shared, not copied.
        keep: ``positions (M, 3) -> (M,)`` bool, as :meth:`unghost.cleaning.keep_mask.KeepMask.keep` is.

    Example:
        >>> import torch
        >>> from unghost.fields.radiance import RadianceConfig, RadianceField
        >>> field = RadianceField(RadianceConfig(resolution=8, color_resolution=8))
        >>> upper = FilteredField(field, lambda positions: positions[:, 2] > 0)
        >>> (upper.density_fn(torch.tensor([[0.0, 0.0, 0.5], [0.0, 0.0, -0.5]])) > 0).flatten().tolist()
        [True, False]
    """

    def __init__(self, field: TrainableField, keep: Callable[[Tensor], Tensor]) -> None:
        self.field, self.keep = field, keep

    def __getattr__(self, name: str) -> Any:
        """All but the density is the field's own."""
        return getattr(self.field, name)

    def density_fn(self, positions: Tensor) -> Tensor:
        """Density per scene unit at ``positions (..., 3)``: ``(..., 1)``."""
        return self.field.density_fn(positions) * self.keep(positions)[..., None]

    def query(self, positions: Tensor) -> tuple[Tensor, Shade]:
        """See :class:`~.kinds.TrainableField`."""
        density, shade = self.field.query(positions)
        return density * self.keep(positions), shade
