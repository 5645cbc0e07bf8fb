"""Does score distillation fill? Holes torn into a clean room, and what a few hundred steps of it do to them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from unghost import load_denoiser
from unghost.core.occupancy import OccupancyRule
from unghost.fields.adapters.grids import cell_centers
from unghost.regularizer.density_regularizer import DensityRegularizer
from unghost.scenes.labelled_room.room import AABB, SHAPE, Room, build_room

from ..progress import say
from .grid_field import GridField

RULE = OccupancyRule()
Mask = NDArray[np.bool_]
HOLES, RADII = 60, (1.5, 3.5)  # cells
ROOM = 20  # a seed that neither the demo nor a threshold has seen


def torn(seed: int) -> tuple[Room, Mask, Mask]:
    """A room, and ``(X, Y, Z)`` its occupied cells within a true solid (a skin's outer skirt left out), and which of
    them are missing: balls about random ones."""
    room, rng = build_room(seed), np.random.default_rng(seed)
    solid, places = room.surface(RULE) & (room.distance < 0), cell_centers(AABB, SHAPE)
    missing = np.zeros(SHAPE, dtype=bool)
    for center in rng.permutation(np.argwhere(solid))[:HOLES]:
        distance = np.linalg.norm(places - places[tuple(center)], axis=-1)
        missing |= distance < rng.uniform(*RADII) * room.pitch
    return room, solid, missing


def fill_row(name: str, *, steps: int, target: float | None = None, seed: int = ROOM) -> dict[str, Any]:
    """``steps`` of Adam on the DSDS loss with default settings but ``target``, beside a term that holds every cell
    outside the holes to its opacity, as photos of them would."""
    room, solid, missing = torn(seed)
    field = GridField(np.where(missing, 0.0, room.true_density), room.pitch)
    seen, start = torch.from_numpy(~missing), 1.0 - torch.exp(-field.cells().detach() * room.pitch)
    denoiser = load_denoiser(name, backend="onnx")
    regularizer = DensityRegularizer(denoiser, aabb=AABB, field_pitch=room.pitch, target=target)
    optimizer = torch.optim.Adam(field.parameters(), lr=0.1)
    for _ in range(steps):
        optimizer.zero_grad()
        held = ((1.0 - torch.exp(-field.cells() * room.pitch) - start)[seen] ** 2).mean()
        (held + sum(regularizer(field).values())).backward()
        optimizer.step()
    found = np.asarray(RULE.occupied(field.cells().detach().numpy(), room.pitch))
    row = {
        "method": f"filling, {name}",
        "target": -math.expm1(-regularizer.settings.target_density()),
        "steps": steps,
        "holes": HOLES,
        "cells_missing": int((solid & missing).sum()),
        "holes_filled": float(found[solid & missing].mean()),
        "surface_kept": float(found[solid & ~missing].mean()),
        "cells_added": float((found & ~room.surface(RULE)).sum() / solid.sum()),
    }
    say(" ".join(f"{key} {value:.3f}" if isinstance(value, float) else str(value) for key, value in row.items()))
    return row
