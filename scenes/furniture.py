"""Furniture and things of random shape, as textured solids: what synthetic rooms are filled with."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.distances.sampled import SampledDistance
from ..core.frames import random_rotations
from .solids import Solid, Texture

Array = NDArray[Any]
UPRIGHT = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # meshes have y up, scenes z


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """A number whose logarithm is uniform."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def random_texture(rng: np.random.Generator, *, plainness: float = 0.2) -> Texture:
    """A texture; with probability ``plainness`` it is nearly featureless, as walls are."""
    first = rng.uniform(0.05, 0.95, size=3)
    if rng.random() < plainness:
        second = np.clip(first + rng.normal(0, 0.06, size=3), 0, 1)
        pattern = str(rng.choice(["plain", "gradient", "noise"]))
    else:
        second = rng.uniform(0.05, 0.95, size=3)
        pattern = str(rng.choice(["checker", "stripes", "noise", "noise", "gradient"]))
    gloss = float(rng.choice([0.0, 0.0, 0.15, 0.5]))
    grain = log_uniform(rng, 0.03, 0.25)
    return Texture(first, second, pattern, log_uniform(rng, 0.1, 0.7), gloss, grain, rng.uniform(0, 1, size=3))


def _yaw(angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def box_solid(center: Array, half: Array, texture: Texture, rotation: Array | None = None) -> Solid:
    """A box of half extents ``half (3,)``."""
    rotation = np.eye(3) if rotation is None else rotation
    return Solid("box", (np.asarray(half),), np.asarray(center), texture, float(np.linalg.norm(half)), rotation)


def random_shape(rng: np.random.Generator, center: Array, radius: float, rotation: Array) -> Solid:
    """Any single shape of about ``radius``."""
    r = radius
    ratio = rng.uniform(0.15, 1.0, size=3)
    points = np.cumsum(rng.normal(0, 0.5, size=(int(rng.integers(3, 7)), 3)), axis=0) * r
    points -= points.mean(axis=0)
    thin = log_uniform(rng, 0.03, 0.2) * r
    options: list[tuple[str, tuple[Any, ...], float]] = [
        ("sphere", (r,), r),
        ("ellipsoid", (r * np.maximum(ratio, 0.3),), r * float(np.maximum(ratio, 0.3).max())),
        ("box", (r * ratio,), 1.75 * r),
        ("rounded_box", (r * np.maximum(ratio, 0.2), 0.15 * r), 1.75 * r),
        ("box", (np.array([r, r * ratio[1], thin / 2]),), 1.5 * r),
        ("cylinder", (r * ratio[0], r), 1.5 * r),
        ("cylinder", (thin, r), 1.1 * r + thin),
        ("tube", (r * max(ratio[0], 0.3), 0.5 * thin, r * ratio[1]), 1.6 * r),
        ("torus", (r * 0.8, r * 0.25 * ratio[0]), 1.1 * r),
        ("cone", (r * max(ratio[0], 0.3), r * 1.4), 1.8 * r),
        ("polyline_tube", (points, 0.6 * thin), float(np.linalg.norm(points, axis=1).max()) + thin),
    ]
    shape, parameters, bound = options[int(rng.integers(len(options)))]
    return Solid(shape, parameters, center, random_texture(rng), bound, rotation)


def table(rng: np.random.Generator, floor: Array, height: float) -> list[Solid]:
    """A table or stool: a top on legs, sometimes with things on it. ``floor (3,)`` is where it stands."""
    turn = _yaw(rng.uniform(0, 2 * np.pi))
    half = height * rng.uniform(0.4, 1.2, size=2)
    thick = height * rng.uniform(0.02, 0.08)
    leg = height * log_uniform(rng, 0.02, 0.07)
    texture = random_texture(rng)
    top = floor + np.array([0.0, 0.0, height])
    solids = [box_solid(top, np.array([*half, thick]), texture, turn)]
    for x in (-0.85, 0.85):
        for y in (-0.85, 0.85):
            foot = floor + turn @ np.array([x * half[0], y * half[1], height / 2])
            solids.append(box_solid(foot, np.array([leg, leg, height / 2]), texture, turn))
    for _ in range(int(rng.integers(0, 4))):
        radius = height * rng.uniform(0.08, 0.25)
        place = top + turn @ np.array([*(rng.uniform(-0.7, 0.7, size=2) * half), thick + 0.8 * radius])
        solids.append(random_shape(rng, place, radius, random_rotations(rng, 1)[0]))
    return solids


def seat(rng: np.random.Generator, floor: Array, height: float) -> list[Solid]:
    """A chair or sofa: seat, back, sometimes arms and legs."""
    turn = _yaw(rng.uniform(0, 2 * np.pi))
    width = height * rng.uniform(0.5, 1.6)
    depth, thick = height * rng.uniform(0.45, 0.7), height * rng.uniform(0.05, 0.3)
    texture = random_texture(rng)
    parts = [
        (np.array([0, 0, 0.5 * height]), np.array([width, depth, thick])),
        (np.array([0, -depth, height]), np.array([width, 0.12 * height, 0.6 * height])),
    ]
    if rng.random() < 0.5:
        parts += [
            (np.array([s * width, 0, 0.7 * height]), np.array([0.1 * height, depth, 0.25 * height])) for s in (-1, 1)
        ]
    leg = 0.04 * height
    parts += [
        (np.array([x * width * 0.9, y * depth * 0.9, 0.25 * height]), np.array([leg, leg, 0.25 * height]))
        for x in (-1, 1)
        for y in (-1, 1)
    ]
    return [box_solid(floor + turn @ center, half, texture, turn) for center, half in parts]


def shelf(rng: np.random.Generator, floor: Array, height: float) -> list[Solid]:
    """Boards between two sides, with things on them."""
    turn = _yaw(rng.uniform(0, 2 * np.pi))
    width, depth, tall = height * rng.uniform(0.5, 1.1), height * rng.uniform(0.2, 0.4), height * rng.uniform(1.2, 2.2)
    texture, board = random_texture(rng), 0.03 * height
    solids = [
        box_solid(floor + turn @ np.array([s * width, 0, tall / 2]), np.array([board, depth, tall / 2]), texture, turn)
        for s in (-1, 1)
    ]
    for level in np.linspace(0.08, 1.0, int(rng.integers(3, 6))):
        center = np.array([0, 0, level * tall])
        solids.append(box_solid(floor + turn @ center, np.array([width, depth, board]), texture, turn))
        if level < 0.95 and rng.random() < 0.7:
            radius = depth * rng.uniform(0.3, 0.7)
            place = center + np.array([rng.uniform(-0.7, 0.7) * width, 0, board + radius])
            solids.append(random_shape(rng, floor + turn @ place, radius, turn))
    return solids


def plant(rng: np.random.Generator, floor: Array, height: float) -> list[Solid]:
    """A pot with leaves: flat ellipsoids and thin stems."""
    pot = height * rng.uniform(0.15, 0.25)
    solids = [Solid("cylinder", (pot, pot), floor + np.array([0, 0, pot]), random_texture(rng), 1.5 * pot)]
    leaf = random_texture(rng)
    base = floor + np.array([0, 0, 2 * pot])
    for _ in range(int(rng.integers(5, 12))):
        tip = np.array([*rng.normal(0, 0.35, size=2), rng.uniform(0.3, 1.0)]) * height
        points = np.stack([np.zeros(3), tip * np.array([0.4, 0.4, 0.7]), tip])
        solids.append(
            Solid("polyline_tube", (points, 0.012 * height), base, leaf, float(np.linalg.norm(tip)) * 1.1 + 0.05)
        )
        radii = height * np.array([0.14, 0.08, 0.03]) * rng.uniform(0.6, 1.4)
        solids.append(Solid("ellipsoid", (radii,), base + tip, leaf, float(radii.max()), random_rotations(rng, 1)[0]))
    return solids


def sampled_object(rng: np.random.Generator, floor: Array, height: float, shape: SampledDistance) -> list[Solid]:
    """A solid of longest side 1, made about ``height`` large; in two of three cases upright, else any way round."""
    size = height * log_uniform(rng, 0.6, 2.0)
    solid = shape.scaled(size)
    rotation = _yaw(rng.uniform(0, 2 * np.pi)) @ UPRIGHT if rng.random() < 0.67 else random_rotations(rng, 1)[0]
    corners = solid.low + solid.pitch * np.argwhere(solid.values <= 0)
    lowest = float((corners @ rotation.T)[:, 2].min()) if len(corners) else 0.0
    center = floor - np.array([0.0, 0.0, lowest])
    return [Solid("sampled", (solid,), center, random_texture(rng), solid.bound, rotation)]


def clutter(rng: np.random.Generator, floor: Array, height: float) -> list[Solid]:
    """A single random shape standing or floating about."""
    radius = height * rng.uniform(0.2, 0.7)
    lift = radius * rng.uniform(0.6, 2.5)
    return [random_shape(rng, floor + np.array([0, 0, lift]), radius, random_rotations(rng, 1)[0])]


FURNITURE: tuple[Callable[[np.random.Generator, Array, float], list[Solid]], ...] = (
    table,
    seat,
    shelf,
    plant,
    clutter,
    clutter,
)
