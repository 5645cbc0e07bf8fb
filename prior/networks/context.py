"""What the network makes of the surroundings: a few features where they coincide with the cube, and a summary.

channel 32^3 -> its 16^3 voxels -> opacity, known? -> 8^3 -> 8^3 -> central part, interpolated -> 8^3 of the cube
                                                          \\-> 4^3 -> mean over all -> conditioning
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from ...core.channels import LEAST_KNOWN, REPEAT, UNKNOWN, coincident_weights

LEAK = 0.1  # slope of the rectifiers below zero
GRID = 8  # voxels along the branch's grid (three edges) and along the cube's middle one (one edge)


def activate(grid: Tensor) -> Tensor:
    """Leaky rectifier. There are no norm layers: plain rectifiers were seen to die for good within 900 steps."""
    return functional.leaky_relu(grid, LEAK)


def context_features(channel: Tensor) -> Tensor:
    """The surroundings ``(N, 1, 32, 32, 32)`` in [-1, 1] to ``(N, 2, 16, 16, 16)``: ``2 sqrt(o) - 1`` and a flag.

    The second is 1 where the channel is ``UNKNOWN`` and 0 where it holds a known value.
    """
    coarse = channel[:, :, ::REPEAT, ::REPEAT, ::REPEAT]
    opacity = torch.relu((coarse - LEAST_KNOWN) * (1.0 / (1.0 - LEAST_KNOWN)))
    unknown = torch.relu((LEAST_KNOWN - coarse) * (1.0 / (LEAST_KNOWN - UNKNOWN)))
    return torch.cat([2.0 * torch.sqrt(opacity) - 1.0, unknown], dim=1)


def interpolation() -> tuple[slice, np.ndarray]:
    """The branch's voxels about the cube, along an axis, and the map ``(those^3, 8^3)`` to the cube's grid.

    Example:
        >>> span, weights = interpolation()
        >>> weights.shape, bool(np.allclose(weights.sum(axis=0), 1))
        ((64, 512), True)
    """
    part, weights = coincident_weights(GRID, GRID)
    return part, np.kron(np.kron(weights, weights), weights).T.copy()


class ContextBranch(nn.Module):
    """``channel (N, 1, 32, 32, 32)`` to what is added at 8^3 ``(N, out, 8, 8, 8)`` and to a summary ``(N, width)``."""

    resample: Tensor

    def __init__(self, width: int, out: int) -> None:
        super().__init__()
        self.enter = nn.Conv3d(2, width, 4, stride=2, padding=1)
        self.mix = nn.Conv3d(width, width, 3, padding=1)
        self.down = nn.Conv3d(width, width, 2, stride=2)
        self.project = nn.Conv3d(width, out, 1, bias=False)
        with torch.no_grad():
            self.project.weight.mul_(0.1)
        self.part, weights = interpolation()
        self.register_buffer("resample", torch.from_numpy(weights), persistent=False)

    def forward(self, channel: Tensor) -> tuple[Tensor, Tensor]:
        """See the class."""
        wide = activate(self.mix(activate(self.enter(context_features(channel)))))
        pooled = activate(self.down(wide)).mean(dim=(2, 3, 4))
        central = wide[:, :, self.part, self.part, self.part]
        beside = (central.flatten(2) @ self.resample).reshape(*central.shape[:2], GRID, GRID, GRID)
        return self.project(beside), pooled


def context_work(width: int, out: int) -> int:
    """Multiply-adds of :class:`ContextBranch` for one cube, the interpolation included."""
    _, weights = interpolation()
    convolutions = 8**3 * width * (64 * 2 + 27 * width + out) + 4**3 * width * 8 * width
    return convolutions + width * weights.size
