"""The furniture of the demo's room: solids of known signed distance, in metres."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.distances import signed as sd

Floats = NDArray[np.float32]
WALL = 2.4  # metres from the middle of the room to the face of each wall


@dataclass(frozen=True)
class Solid:
    """A solid with one colour: ``distance(positions (..., 3)) -> (...)``, metres."""

    color: tuple[float, float, float]
    distance: Callable[[Floats], Any]


def _place(positions: Floats, at: tuple[float, float, float], turn: float = 0.0) -> Floats:
    """World positions in the frame of a solid at ``at``, turned by ``turn`` radians about z."""
    c, s = np.cos(turn), np.sin(turn)
    moved = positions - np.array(at, dtype=np.float32)
    return np.asarray(moved @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=np.float32))


def _box(color: Any, at: Any, half: Any, *, turn: float = 0.0, rounding: float = 0.0) -> Solid:
    if rounding:
        return Solid(color, lambda p: sd.rounded_box(_place(p, at, turn), half, rounding))
    return Solid(color, lambda p: sd.box(_place(p, at, turn), half))


def _rod(color: Any, start: Any, end: Any, radius: float) -> Solid:
    return Solid(color, lambda p: sd.capsule(p, start, end, radius))


def _table(center: tuple[float, float], turn: float) -> list[Solid]:
    oak, (x, y) = (0.62, 0.42, 0.25), center
    c, s = np.cos(turn), np.sin(turn)
    solids = [_box(oak, (x, y, 0.74), (0.65, 0.4, 0.03), turn=turn, rounding=0.015)]
    for u, v in ((-0.57, -0.32), (0.57, -0.32), (-0.57, 0.32), (0.57, 0.32)):
        foot = (x + c * u - s * v, y + s * u + c * v)
        solids.append(_rod((0.45, 0.29, 0.17), (*foot, 0.0), (*foot, 0.72), 0.032))
    return solids


def _chair(center: tuple[float, float], turn: float) -> list[Solid]:
    paint, (x, y) = (0.16, 0.42, 0.45), center
    c, s = np.cos(turn), np.sin(turn)

    def world(u: float, v: float, z: float) -> tuple[float, float, float]:
        return (x + c * u - s * v, y + s * u + c * v, z)

    solids = [_box(paint, (x, y, 0.45), (0.21, 0.21, 0.025), turn=turn)]
    for u, v in ((-0.18, -0.18), (0.18, -0.18), (-0.18, 0.18), (0.18, 0.18)):
        solids.append(_rod(paint, world(u, v, 0.0), world(u, v, 0.45 if v < 0 else 0.95), 0.025))
    solids += [_rod(paint, world(-0.18, 0.18, z), world(0.18, 0.18, z), 0.03) for z in (0.7, 0.82, 0.94)]
    return solids


def _sofa() -> list[Solid]:
    cloth, dark, x, y = (0.66, 0.27, 0.20), (0.55, 0.20, 0.15), -0.2, 1.85
    solids = [
        _box(dark, (x, y, 0.22), (1.0, 0.42, 0.13), rounding=0.04),
        _box(dark, (x, y + 0.34, 0.55), (1.0, 0.12, 0.35), rounding=0.08),
    ]
    for side in (-1.0, 1.0):
        solids.append(_box(dark, (x + side * 0.95, y, 0.38), (0.11, 0.42, 0.26), rounding=0.07))
        solids.append(_box(cloth, (x + side * 0.42, y - 0.08, 0.41), (0.41, 0.33, 0.09), rounding=0.06))
    solids.append(_box((0.85, 0.68, 0.25), (x - 0.62, y + 0.1, 0.65), (0.19, 0.08, 0.19), turn=0.3, rounding=0.07))
    return solids


def _shelf(rng: np.random.Generator) -> list[Solid]:
    wood, x, y = (0.72, 0.56, 0.38), -2.22, 0.35
    solids = [_box(wood, (x, y + side * 0.62, 0.9), (0.17, 0.025, 0.9)) for side in (-1.0, 1.0)]
    for z in (0.1, 0.52, 0.94, 1.36, 1.78):
        solids.append(_box(wood, (x, y, z), (0.17, 0.62, 0.022)))
    for z in (0.12, 0.54, 0.96, 1.38):
        along = y - 0.57
        while along < y + 0.3 + 0.2 * rng.random():
            thick, tall = rng.uniform(0.02, 0.05), rng.uniform(0.11, 0.17)
            color = tuple(np.clip(rng.normal([0.45, 0.35, 0.32], 0.2), 0.1, 0.9))
            solids.append(_box(color, (x - 0.02, along + thick, z + tall), (0.12, thick, tall)))
            along += 2 * thick + (rng.random() < 0.12) * 0.12
    return solids


def _lamp() -> list[Solid]:
    metal, x, y = (0.25, 0.25, 0.27), 1.45, 1.9
    return [
        Solid(metal, lambda p: sd.cylinder(_place(p, (x, y, 0.02)), 0.18, 0.03)),
        _rod(metal, (x, y, 0.0), (x, y, 1.55), 0.025),
        Solid((0.95, 0.86, 0.62), lambda p: sd.tube(_place(p, (x, y, 1.6)), 0.2, 0.03, 0.16)),
        _rod(metal, (x - 0.2, y, 1.5), (x + 0.2, y, 1.5), 0.02),
    ]


def _stem(points: NDArray[np.float64]) -> Solid:
    return Solid((0.22, 0.42, 0.16), lambda p: sd.polyline_tube(p, points, 0.018))


def _leaf(color: Any, at: Any, turn: float) -> Solid:
    return Solid(color, lambda p: sd.ellipsoid(_place(p, at, turn), (0.16, 0.075, 0.045)))


def _plant(rng: np.random.Generator) -> list[Solid]:
    x, y = 1.95, 0.75
    solids = [Solid((0.70, 0.38, 0.26), lambda p: sd.cylinder(_place(p, (x, y, 0.2)), 0.2, 0.2))]
    for index in range(9):
        angle, lean = index * 2.4 + rng.uniform(-0.3, 0.3), rng.uniform(0.15, 0.45)
        tip = (x + lean * np.cos(angle), y + lean * np.sin(angle), rng.uniform(0.75, 1.3))
        middle = (x + 0.3 * lean * np.cos(angle), y + 0.3 * lean * np.sin(angle), 0.62)
        stem = np.array([(x, y, 0.38), middle, tip])
        solids += [_stem(stem), _leaf((0.20 + 0.1 * rng.random(), 0.5, 0.2), tip, angle)]
    return solids


def _small_things() -> list[Solid]:
    def vase(p: Floats) -> Any:
        local = _place(p, (0.75, -0.55, 0.98))
        return sd.difference(sd.shell(sd.ellipsoid(local, (0.13, 0.13, 0.22)), 0.03), local[..., 2] * -1.0 + 0.17)

    return [
        Solid((0.25, 0.40, 0.68), vase),
        Solid((0.90, 0.90, 0.88), lambda p: sd.cylinder(_place(p, (0.35, -0.85, 0.80)), 0.05, 0.06)),
        _box((0.80, 0.78, 0.70), (0.15, -0.5, 0.785), (0.15, 0.11, 0.02), turn=0.4),
        Solid((0.88, 0.55, 0.16), lambda p: sd.sphere(_place(p, (-1.1, -1.4, 0.21)), 0.21)),
        Solid((0.30, 0.55, 0.60), lambda p: sd.torus(_place(p, (-1.75, -1.2, 0.05)), 0.19, 0.055)),
        Solid((0.75, 0.42, 0.48), lambda p: sd.cylinder(_place(p, (-0.45, 0.55, 0.21)), 0.27, 0.21)),
        _box((0.86, 0.83, 0.74), (-0.2, 2.38, 1.55), (0.5, 0.05, 0.32)),
        Solid((0.2, 0.2, 0.22), lambda p: sd.sphere(_place(p, (1.45, 1.9, 1.62)), 0.06)),
        Solid((0.85, 0.85, 0.85), lambda p: sd.cylinder(_place(p, (0.0, -0.1, 0.01)), 1.25, 0.012)),
    ]


def solids(rng: np.random.Generator) -> list[Solid]:
    """Every solid of the room; ``rng`` draws the books and the leaves."""
    shell = [
        Solid((0.72, 0.62, 0.50), lambda p: sd.half_space(p, (0, 0, 1), 0.0)),
        Solid((0.80, 0.82, 0.80), lambda p: sd.half_space(p, (1, 0, 0), -WALL)),
        Solid((0.87, 0.85, 0.79), lambda p: sd.half_space(p, (0, -1, 0), -WALL)),
    ]
    furniture = _table((0.5, -0.65), 0.25) + _chair((0.55, -1.4), np.pi + 0.2) + _chair((1.5, -0.4), -1.2)
    return shell + furniture + _sofa() + _shelf(rng) + _lamp() + _plant(rng) + _small_things()
