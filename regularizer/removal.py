"""Cleaning while a field trains on: what ``clean`` would take out is held down, and the photos may object."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InvalidArgument, InvalidType, MissingExtra

try:
    import torch
    from torch import Tensor
except ImportError as error:  # pragma: no cover - exercised in a subprocess
    raise MissingExtra("unghost.regularizer.removal needs torch: pip install unghost[torch]") from error

from ..cleaning.keep_mask import KeepMask
from ..cleaning.queries import field_device
from ..core.arrays import widest
from .losses import stable_mean
from .tensor_queries import DensityFn, query_tensors

CALLER = "RemovalLoss"


class RemovalLoss:
    """Density score distillation with a prior that was asked once, about the whole field.

    A hard mask takes a surface that the prior mistook for a ghost, and nothing brings it back. This loss pushes
    density out of the same cells while the photometric loss goes on: what the photos need holds, ghosts that no photo
    needs go. It is the first half of the paper's eq. 2 with the mask of :func:`unghost.clean` for ``m``, on the
    optical depth of a cell. No network runs while the field trains, so a step costs ``samples`` densities.

    Args:
        mask: what is to go; nothing outside its removed cells is ever asked or moved.
        weight: of the mean optical depth per removed cell, ``density * mask.pitch``; finite, >= 0. Ten times the
            default takes more ghosts, and coverage with them.
        samples: random positions a step, >= 1; uniform in the removed cells.
        seed: positions of step s depend on (seed, s) alone.
        device: where positions are created; None for the device of the field's parameters, else the CPU.
        chunk: most positions handed to a callable at once, >= 1.
        drop_invalid: leave out NaN, infinite and negative densities instead of raising.

    Attributes:
        step: calls so far.

    Raises:
        ValueError: a weight, samples or chunk out of range.

    Example:
        >>> cells = np.ones((4, 4, 4), dtype=bool)
        >>> cells[2:] = False  # what clean() would remove
        >>> removal = RemovalLoss(KeepMask(np.array([[0.0] * 3, [4.0] * 3]), 1.0, cells), weight=1.0, samples=64)
        >>> density = torch.tensor(0.5, requires_grad=True)
        >>> loss = removal(lambda positions: density.expand(len(positions)))  # add it to your photometric loss
        >>> loss.backward()
        >>> round(loss.item(), 3), round(density.grad.item(), 3)
        (0.5, 1.0)
    """

    def __init__(
        self,
        mask: KeepMask,
        *,
        weight: float = 0.01,
        samples: int = 1 << 15,
        seed: int = 0,
        device: torch.device | str | None = None,
        chunk: int = 1 << 18,
        drop_invalid: bool = False,
    ) -> None:
        for name, value, holds, rule in (
            ("weight", weight, 0 <= weight < np.inf, "finite and >= 0"),
            ("samples", samples, samples >= 1, ">= 1"),
            ("chunk", chunk, chunk >= 1, ">= 1"),
        ):
            if not holds:
                raise InvalidArgument(f"{CALLER}: {name} must be {rule}, got {value!r}")
        self.mask, self.weight, self.samples, self.seed = mask, weight, samples, seed
        self.device, self.chunk, self.drop_invalid = device, chunk, drop_invalid
        self.step = 0
        self._removed = np.argwhere(~mask.cells)

    def __call__(self, density_fn: DensityFn | Sequence[DensityFn]) -> Tensor:
        """The weighted loss of one step: a scalar (float64, so that no finite density overflows).

        Args:
            density_fn: ``positions (M, 3) float32 tensor -> density (M, 1) or (M,)``, differentiable; or a list of
                them (proposal networks, too), whose losses are added. All are asked at the same positions.

        Returns:
            Exactly 0 without a question to the field if nothing is to go, or at weight 0.

        Raises:
            TypeError, ValueError: what a callable returned is no tensor, of the wrong shape, NaN, infinite, negative.
        """
        several = isinstance(density_fn, (Sequence, torch.nn.ModuleList))
        fields: list[Any] = list(density_fn) if several else [density_fn]  # type: ignore[arg-type]
        if not fields or not all(callable(field) for field in fields):
            raise InvalidType(
                f"{CALLER}: density_fn must be a callable or a non-empty list of them, got {density_fn!r}"
            )
        device = torch.device(self.device if self.device is not None else field_device(fields[0]) or "cpu")
        total = widest(torch.zeros((), device=device))
        points = self._points() if self.weight > 0 and len(self._removed) else np.zeros((0, 3), dtype=np.float32)
        self.step += 1
        if not len(points):
            return total
        positions = torch.as_tensor(points, device=device)
        for field in fields:
            density, _ = query_tensors(
                field, positions, chunk=self.chunk, drop_invalid=self.drop_invalid, caller=CALLER
            )
            total = total + stable_mean(widest(density) * self.mask.pitch, count=self.samples)
        return total * self.weight

    def _points(self) -> NDArray[np.float32]:
        """``(<= samples, 3)``: cells of the lattice may stick out of the box, where nothing is changed."""
        rng = np.random.default_rng([self.seed, self.step])
        cells = self._removed[rng.integers(len(self._removed), size=self.samples)]
        points = (self.mask.origin + (cells + rng.random((self.samples, 3))) * self.mask.pitch).astype(np.float32)
        chosen: NDArray[np.float32] = points[~self.mask.keep(points)]
        return chosen
