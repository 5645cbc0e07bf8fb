"""The demo's pictures: the room before and after, what was removed, and two cross-sections."""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.errors import needs_extra
from ..core.occupancy import OccupancyRule, opacity_from_density
from ..scenes.labelled_room.room import AABB, Room
from ..scenes.volume_renderer import Floats, camera_at, render, shade

Mask = NDArray[np.bool_]
CAMERA = camera_at((6.0, -6.0, 4.9), (-0.1, 0.1, 0.72), width=800, height=600, fov_degrees=40.0)
REMOVED, MISSED, LOST = (0.98, 0.55, 0.12), (0.50, 0.20, 0.62), (0.85, 0.05, 0.10)
LABELS = {"clean": "unghost clean", "components": "largest component"}


def _png(image: Floats) -> bytes:
    with needs_extra("demo", caller="demo"):
        from matplotlib.image import imsave

    stream = io.BytesIO()
    imsave(stream, image, format="png")
    return stream.getvalue()


def _natural_color(room: Room) -> Floats:
    """Solids in their own colour; ghosts as the dull smear that training makes of their neighbours."""
    ghost = np.clip(1.0 - room.true_density / np.maximum(room.density, 1e-9), 0.0, 1.0)[..., None]
    smear = 0.4 * room.color + 0.6 * np.array([0.62, 0.60, 0.62], dtype=np.float32)
    return np.asarray(room.color * (1 - ghost) + smear * ghost, dtype=np.float32)


def _verdict_color(room: Room, kept: Mask, rule: OccupancyRule) -> Floats:
    """Kept surface pale; ghosts removed orange, ghosts left violet, surface lost red."""
    pale = 0.25 * room.color.mean(axis=-1, keepdims=True) + 0.25 * room.color + 0.45
    color = np.asarray(np.minimum(pale, 1.0), dtype=np.float32)
    surface, occupied = room.surface(rule), room.occupied(rule)
    color[occupied & ~surface & ~kept] = REMOVED
    color[occupied & ~surface & kept] = MISSED
    color[surface & ~kept] = LOST
    return color


def _panel(axes: Any, room: Room, kept: Mask | None, index: tuple[Any, ...], rule: OccupancyRule) -> None:
    """One cross-section: surfaces dark, ghosts still there violet, lost surface red."""
    density = room.density if kept is None else np.where(kept, room.density, 0.0)
    opacity = np.clip(opacity_from_density(density[index], room.pitch), 0, 1)[..., None]
    surface = room.surface(rule)[index]
    ink = np.where(surface[..., None], np.array([0.10, 0.12, 0.16]), np.array(MISSED))
    image = 1.0 - opacity**0.7 * (1.0 - ink)
    if kept is not None:
        image[surface & ~kept[index]] = LOST
    axes.imshow(image.swapaxes(0, 1), origin="lower", interpolation="nearest")
    axes.set(xticks=[], yticks=[])
    for spine in axes.spines.values():
        spine.set_visible(False)


def draw_sections(room: Room, kept: Mapping[str, Mask], rule: OccupancyRule) -> bytes:
    """A PNG of one level and one upright cut through the room, a column per state."""
    with needs_extra("demo", caller="demo"):
        from matplotlib.figure import Figure

    states: dict[str, Mask | None] = {"before": None}
    states |= {LABELS.get(name, name): mask for name, mask in kept.items()}
    states["the truth"] = room.surface(rule)
    level, upright = round((0.55 - AABB[0, 2]) / room.pitch), round((-0.55 - AABB[0, 1]) / room.pitch)
    cuts = {"level": np.s_[:, :, level], "upright": np.s_[:, upright, :]}
    figure = Figure(figsize=(3.0 * len(states), 4.7), dpi=110, layout="constrained", facecolor="white")
    grid = figure.subplots(2, len(states), height_ratios=[2, 1])
    for column, (title, mask) in enumerate(states.items()):
        grid[0, column].set_title(title, fontsize=12)
        for row, (name, index) in enumerate(cuts.items()):
            _panel(grid[row, column], room, mask, index, rule)
            if column == 0:
                grid[row, column].set_ylabel(name, fontsize=10)
    stream = io.BytesIO()
    figure.savefig(stream, format="png")
    return stream.getvalue()


def draw_pictures(room: Room, kept: Mapping[str, Mask], rule: OccupancyRule | None = None) -> dict[str, bytes]:
    """PNG files by name.

    Args:
        room: the patient.
        kept: cells kept, by method.
        rule: what counts as occupied; the default rule if None.

    Returns:
        ``before``, ``after_<method>`` for each method, ``removed`` (the first method's verdict) and ``sections``.
    """
    rule = OccupancyRule() if rule is None else rule
    natural = _natural_color(room)
    pictures = {"before": _png(render(shade(room.density, natural, AABB, room.pitch), CAMERA))}
    for name, mask in kept.items():
        density = np.where(mask, room.density, np.float32(0.0))
        pictures[f"after_{name}"] = _png(render(shade(density, natural, AABB, room.pitch), CAMERA))
    first = next(iter(kept.values()))
    verdict = shade(room.density, _verdict_color(room, first, rule), AABB, room.pitch)
    pictures["removed"] = _png(render(verdict, CAMERA))
    pictures["sections"] = draw_sections(room, kept, rule)
    return pictures
