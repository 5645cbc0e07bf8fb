"""The optional channels of a denoiser, for cubes of a field that is being trained (torch)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..cleaning.grid_channels import evidence_channels, light_channel, light_maps, view_channel
from ..core.aabb import contains
from ..core.arrays import to_numpy, widest
from ..core.cameras import Cameras
from ..core.channels import (
    SURROUNDINGS,
    TRANSMITTANCE,
    VIEW_COUNT,
    encode_surroundings,
    pool_surroundings,
    stack_channels,
    surroundings_lattice,
)
from ..core.occupancy import EMPTY, OccupancyRule
from ..core.sight_lines import SightLines
from ..core.visibility.transmittance import TransmittanceMaps
from .cubes import CubeBatch

Ask = Callable[[Tensor], Tensor]


@torch.no_grad()
def cube_surroundings(
    ask: Ask, cubes: CubeBatch, asked: Tensor, *, aabb: NDArray[np.float64], rule: OccupancyRule, soft: bool
) -> NDArray[np.float32]:
    """Mean signed opacity about some of the cubes, ``(n, 16, 16, 16)``, empty outside the box; no gradient.

    Args:
        ask: positions ``(M, 3)`` float32 to densities ``(M,)``.
        cubes: all of a step's.
        asked: ``(N,)`` bool, which of them.
        aabb: ``(2, 3)``.
        rule, soft: how the cubes themselves are encoded, over the same pitch.
    """
    device = cubes.pitch.device
    lattice = surroundings_lattice(*cubes.frames(asked))
    inside = torch.from_numpy(contains(aabb, lattice)).to(device)
    positions = torch.as_tensor(lattice, dtype=torch.float32, device=device)[inside]
    pitch = cubes.pitch[asked].expand(inside.shape)[inside]
    values = rule.encode(widest(ask(positions)), pitch, soft=soft).float()
    signed = torch.full(inside.shape, EMPTY, device=device).masked_scatter(inside, values)
    return pool_surroundings(signed.cpu().numpy())


class FollowedRays:
    """Rays from the cameras through fields that change: followed anew every so many steps.

    Args:
        names: the denoiser's channels; if it does not ask for transmittances, nothing is ever followed.
        cameras: of the training photos, or None.
        aabb: ``(2, 3)``.
        every: steps, >= 1.
    """

    def __init__(self, names: Sequence[str], cameras: Cameras | None, aabb: NDArray[np.float64], *, every: int) -> None:
        self.names, self.cameras, self.aabb, self.every = names, cameras, aabb, every
        self._maps: dict[int, tuple[int, TransmittanceMaps | None]] = {}

    def through(self, ask: Ask, *, index: int, step: int, pitch: float, like: Tensor) -> TransmittanceMaps | None:
        """The maps of field ``index``, at most ``every`` steps old; positions are asked for where ``like`` is."""
        followed, maps = self._maps.get(index, (step - self.every, None))
        if step - followed >= self.every:

            @torch.no_grad()
            def density_fn(positions: NDArray[Any]) -> NDArray[Any]:
                return to_numpy(ask(torch.as_tensor(positions, dtype=torch.float32, device=like.device)))

            maps = light_maps(self.names, self.cameras, density_fn, aabb=self.aabb, pitch=pitch)
            self._maps[index] = step, maps
        return maps


def complete_channels(
    names: tuple[str, ...],
    signed: Tensor,
    cubes: CubeBatch,
    asked: Tensor,
    *,
    viewing: Cameras | None,
    maps: TransmittanceMaps | None,
    lines: SightLines | None,
    surroundings: Callable[[], NDArray[np.float32]],
) -> Tensor:
    """All channels of the cubes that are asked about; what cannot be told is unknown.

    Args:
        names: of the channels.
        signed: ``(n, 1, R, R, R)``, the first of them.
        cubes, asked: as :func:`cube_surroundings` has them.
        viewing: cameras to count, or None.
        maps: rays through the field, or None.
        lines: sight lines on a grid of the field's pitch, or None.
        surroundings: called if the denoiser wants them.

    Returns:
        ``(n, C, R, R, R)``, where ``signed`` is.
    """
    frames, known = cubes.frames(asked), {}
    if viewing is not None:
        known[VIEW_COUNT] = view_channel(viewing, *frames)
    if maps is not None:
        known[TRANSMITTANCE] = light_channel(maps, *frames)
    if lines is not None:
        known |= evidence_channels(lines, *frames)
    if SURROUNDINGS in names:
        known[SURROUNDINGS] = encode_surroundings(surroundings())
    nothing = np.broadcast_to(np.float32(EMPTY), (len(signed), *signed.shape[2:]))
    others = torch.from_numpy(stack_channels(names, nothing, known)[:, 1:])
    return torch.cat([signed, others.to(signed.device)], dim=1)
