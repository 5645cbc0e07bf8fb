"""Families of solids with random proportions, each about one unit long, as signed distances.

A family is ``(rng) -> solid`` and a solid maps ``positions (N, 3)`` to signed distances ``(N,)``
(negative inside). Magnitudes never exceed the true distance by more than a few percent (the twisted,
bumpy and periodic solids are divided by a Lipschitz bound), so that a solid which is far from a cube
can be left out. Every free proportion is log-uniform over the range written beside it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import signed_distance as sd

Array = NDArray[Any]
Solid = Callable[[Array], Array]
Family = Callable[[np.random.Generator], Solid]


def log_uniform(rng: np.random.Generator, low: float, high: float, count: int | None = None) -> Any:
    """Log-uniform draws on [low, high], ``low > 0``; a float, or ``(count,)``."""
    draws = np.exp(rng.uniform(np.log(low), np.log(high), size=count))
    return float(draws) if count is None else draws


def wall(rng: np.random.Generator) -> Solid:
    """One to three half-spaces meeting: a floor, an edge or a corner, convex or concave."""
    count = int(rng.integers(1, 4))
    normals = np.eye(3)[:count] + rng.normal(scale=rng.choice([0.0, 0.15]), size=(count, 3))
    offsets = rng.uniform(-0.2, 0.2, size=count)
    combine = sd.union if rng.random() < 0.5 else sd.intersection
    return lambda p: combine([sd.half_space(p, n, float(o)) for n, o in zip(normals, offsets)])


def ball(rng: np.random.Generator) -> Solid:
    """Sphere, radius 0.25 to 0.5."""
    radius = log_uniform(rng, 0.25, 0.5)
    return lambda p: sd.sphere(p, radius)


def ellipsoid(rng: np.random.Generator) -> Solid:
    """Ellipsoid, radii 0.125 to 0.5."""
    radii = log_uniform(rng, 0.125, 0.5, 3)
    return lambda p: sd.ellipsoid(p, radii)


def box(rng: np.random.Generator) -> Solid:
    """Box, half extents 0.05 to 0.5."""
    half = log_uniform(rng, 0.05, 0.5, 3)
    return lambda p: sd.box(p, half)


def rounded_box(rng: np.random.Generator) -> Solid:
    """Box with edges rounded by 0.1 to 0.9 of its least half extent."""
    half = log_uniform(rng, 0.05, 0.5, 3)
    radius = float(half.min()) * log_uniform(rng, 0.1, 0.9)
    return lambda p: sd.rounded_box(p, half, radius)


def panel(rng: np.random.Generator) -> Solid:
    """Thin flat panel, thickness 0.004 to 0.04: shelves, doors, table tops."""
    half = np.array([*log_uniform(rng, 0.15, 0.5, 2), log_uniform(rng, 0.002, 0.02)])
    return lambda p: sd.box(p, half)


def rod(rng: np.random.Generator) -> Solid:
    """Long cylinder, radius 0.005 to 0.05: legs, poles, wires."""
    radius = log_uniform(rng, 0.005, 0.05)
    return lambda p: sd.cylinder(p, radius, 0.5)


def cylinder(rng: np.random.Generator) -> Solid:
    """Cylinder, radius 0.1 to 0.5, half height 0.03 to 0.5."""
    radius, half = log_uniform(rng, 0.1, 0.5), log_uniform(rng, 0.03, 0.5)
    return lambda p: sd.cylinder(p, radius, half)


def tube(rng: np.random.Generator) -> Solid:
    """Open pipe, radius 0.05 to 0.45, wall 0.02 to 0.5 of it."""
    radius = log_uniform(rng, 0.05, 0.45)
    thickness, half = radius * log_uniform(rng, 0.02, 0.5), log_uniform(rng, 0.05, 0.5)
    return lambda p: sd.tube(p, radius, thickness, half)


def capsule(rng: np.random.Generator) -> Solid:
    """Straight capsule, radius 0.02 to 0.3."""
    radius = log_uniform(rng, 0.02, 0.3)
    end = np.array([0.0, 0.0, max(0.5 - radius, 0.1)])
    return lambda p: sd.capsule(p, -end, end, radius)


def cone(rng: np.random.Generator) -> Solid:
    """Cone, base radius 0.05 to 0.5, height 0.2 to 1."""
    radius, height = log_uniform(rng, 0.05, 0.5), log_uniform(rng, 0.2, 1.0)
    return lambda p: sd.cone(p + np.array([0.0, 0.0, height / 2]), radius, height)


def torus(rng: np.random.Generator) -> Solid:
    """Ring, minor radius 0.03 to 0.6 of the major one."""
    major = log_uniform(rng, 0.2, 0.4)
    minor = major * log_uniform(rng, 0.03, 0.6)
    return lambda p: sd.torus(p, major, minor)


def cable(rng: np.random.Generator) -> Solid:
    """Tube swept along a random walk of 3 to 6 points, radius 0.008 to 0.08."""
    steps = rng.normal(size=(int(rng.integers(3, 7)), 3)) * 0.25
    points = np.cumsum(steps + steps[0], axis=0)
    points -= points.mean(axis=0)
    points /= max(2.0 * float(np.abs(points).max()), 1e-6)
    radius = log_uniform(rng, 0.008, 0.08)
    return lambda p: sd.polyline_tube(p, points, radius)


def leaf(rng: np.random.Generator) -> Solid:
    """Curved thin sheet with an elliptic outline, thickness 0.004 to 0.03."""
    curvature, thickness = log_uniform(rng, 0.4, 4.0), log_uniform(rng, 0.004, 0.03)
    outline = log_uniform(rng, 0.15, 0.5, 2)
    center = np.array([0.0, 0.0, 1.0 / curvature])

    def distance(p: Array) -> Array:
        sheet = np.abs(sd.sphere(p - center, 1.0 / curvature)) - thickness / 2
        rim = (np.hypot(p[..., 0] / outline[0], p[..., 1] / outline[1]) - 1.0) * outline.min()
        result: Array = np.maximum(np.maximum(sheet, rim), p[..., 2] - 1.0 / curvature)
        return result

    return distance


def stairs(rng: np.random.Generator) -> Solid:
    """3 to 7 steps along x, rise over run 0.3 to 1.5, half width 0.1 to 0.5."""
    count, slope, half_width = int(rng.integers(3, 8)), log_uniform(rng, 0.3, 1.5), log_uniform(rng, 0.1, 0.5)
    run = 1.0 / count
    heights = (np.arange(count) + 1) * run * slope
    centers = [np.array([(i + 0.5) * run - 0.5, 0.0, (h - slope) / 2]) for i, h in enumerate(heights)]
    return lambda p: sd.union([sd.box(p - c, [run / 2, half_width, h / 2]) for c, h in zip(centers, heights)])


def _waves(rng: np.random.Generator, low: float, high: float, count: int) -> tuple[Array, Array, Array]:
    """Random plane waves: wave vectors ``(3, count)`` (radians per unit), phases, amplitudes that add to 1."""
    frequency = log_uniform(rng, low, high, count) * 2 * np.pi
    direction = rng.normal(size=(3, count))
    vectors = direction / np.linalg.norm(direction, axis=0) * frequency
    amplitude = 1.0 / frequency
    return vectors, rng.uniform(0, 2 * np.pi, size=count), amplitude / amplitude.sum()


def terrain(rng: np.random.Generator) -> Solid:
    """Ground below a height field of 4 plane waves, 0.5 to 8 per unit, relief 0.02 to 0.2."""
    vectors, phases, amplitudes = _waves(rng, 0.5, 8.0, 4)
    relief = log_uniform(rng, 0.02, 0.2)
    slope = relief * float((amplitudes * np.linalg.norm(vectors[:2], axis=0)).sum())
    bound = float(np.hypot(1.0, slope))
    return lambda p: (p[..., 2] - relief * (np.sin(p[..., :2] @ vectors[:2] + phases) @ amplitudes)) / bound


def rock(rng: np.random.Generator) -> Solid:
    """Ball displaced by 5 plane waves, 0.7 to 5 per unit, by 0.03 to 0.15."""
    vectors, phases, amplitudes = _waves(rng, 0.7, 5.0, 5)
    depth, radius = log_uniform(rng, 0.03, 0.15), log_uniform(rng, 0.2, 0.4)
    bound = 1.0 + depth * float((amplitudes * np.linalg.norm(vectors, axis=0)).sum())
    return lambda p: (sd.sphere(p, radius) - depth * (np.sin(p @ vectors + phases) @ amplitudes)) / bound


def superquadric(rng: np.random.Generator) -> Solid:
    """``(|x|^e + |y|^e + |z|^e)^(1/e) = 1`` with exponent 1 to 6 and radii 0.15 to 0.5."""
    exponent, radii = log_uniform(rng, 1.0, 6.0), log_uniform(rng, 0.15, 0.5, 3)
    steepest = max(1.0, 3.0 ** (1.0 / exponent - 0.5))

    def distance(p: Array) -> Array:
        norm = ((np.abs(p) / radii) ** exponent).sum(axis=-1) ** (1.0 / exponent)
        result: Array = (norm - 1.0) * radii.min() / steepest
        return result

    return distance


def _polygon_distance(points: Array, u: Array, v: Array) -> Array:
    """Signed distance of ``(u, v)`` to a closed polygon ``(n, 2)``; the usual crossing rule for the sign."""
    nearest: Array = np.full(u.shape, np.inf)
    inside = np.zeros(u.shape, dtype=bool)
    for (u0, v0), (u1, v1) in zip(points, np.roll(points, -1, axis=0)):
        du, dv, pu, pv = u1 - u0, v1 - v0, u - u0, v - v0
        along = np.clip((pu * du + pv * dv) / max(du * du + dv * dv, 1e-12), 0.0, 1.0)
        nearest = np.minimum(nearest, (pu - along * du) ** 2 + (pv - along * dv) ** 2)
        crosses = (v0 > v) != (v1 > v)
        inside ^= crosses & (pu < du * pv / (dv if dv != 0 else 1.0))
    return np.where(inside, -1.0, 1.0) * np.sqrt(nearest)


def _star_outline(rng: np.random.Generator) -> Array:
    """A star-shaped polygon ``(n, 2)`` of 3 to 9 corners, radii 0.15 to 0.5; regular or not."""
    corners = int(rng.integers(3, 10))
    angles = np.arange(corners) * 2 * np.pi / corners
    radii: Array = np.full(corners, 0.45)
    if rng.random() < 0.7:
        radii = log_uniform(rng, 0.15, 0.5, corners)
        angles = angles + rng.uniform(-0.3, 0.3, size=corners) * 2 * np.pi / corners
    return np.stack([radii * np.cos(angles), radii * np.sin(angles)], axis=-1)


def prism(rng: np.random.Generator) -> Solid:
    """Extruded star-shaped polygon, half height 0.01 to 0.5."""
    outline, half = _star_outline(rng), log_uniform(rng, 0.01, 0.5)
    return lambda p: np.maximum(_polygon_distance(outline, p[..., 0], p[..., 1]), np.abs(p[..., 2]) - half)


def lathe(rng: np.random.Generator) -> Solid:
    """Wall of 0.01 to 0.06 around a profile of 3 to 5 points turned about z: vases, bowls, lamps."""
    count = int(rng.integers(3, 6))
    radii, heights = log_uniform(rng, 0.05, 0.45, count), np.sort(rng.uniform(-0.5, 0.5, size=count))
    thickness = log_uniform(rng, 0.01, 0.06)
    points = np.stack([radii, np.zeros(count), heights], axis=-1)

    def distance(p: Array) -> Array:
        radial = np.sqrt(p[..., 0] ** 2 + p[..., 1] ** 2)
        return sd.polyline_tube(np.stack([radial, np.zeros_like(radial), p[..., 2]], axis=-1), points, thickness / 2)

    return distance


def grating(rng: np.random.Generator) -> Solid:
    """2 to 10 equal bars side by side: fences, blinds, rows of books, keyboards."""
    count = int(rng.integers(2, 11))
    pitch = 1.0 / count
    half = np.array([pitch / 2 * log_uniform(rng, 0.1, 0.9), log_uniform(rng, 0.01, 0.5), log_uniform(rng, 0.05, 0.5)])
    round_bars = rng.random() < 0.3

    def distance(p: Array) -> Array:
        index = np.clip(np.round(p[..., 0] / pitch - 0.5 * ((count + 1) % 2)), -(count // 2), (count - 1) // 2)
        local = p.copy()
        local[..., 0] -= (index + 0.5 * ((count + 1) % 2)) * pitch
        return sd.cylinder(local, float(half[0]), float(half[2])) if round_bars else sd.box(local, half)

    return distance


def twisted_bar(rng: np.random.Generator) -> Solid:
    """Box twisted about z by up to 1.5 turns a unit."""
    half = np.array([*log_uniform(rng, 0.05, 0.3, 2), 0.5])
    rate = rng.uniform(-1.5, 1.5) * 2 * np.pi
    bound = float(np.hypot(1.0, abs(rate) * np.hypot(half[0], half[1]) * 1.3))

    def distance(p: Array) -> Array:
        cosine, sine = np.cos(rate * p[..., 2]), np.sin(rate * p[..., 2])
        x, y = p[..., 0], p[..., 1]
        turned = np.stack([cosine * x + sine * y, -sine * x + cosine * y, p[..., 2]], axis=-1)
        near = sd.box(turned, half) / bound
        return np.where(np.hypot(x, y) > 0.6, np.minimum(near, np.hypot(x, y) - 0.45), near)

    return distance


def sponge(rng: np.random.Generator) -> Solid:
    """Gyroid sheet of 1.5 to 6 periods a unit inside a ball: porous things, foliage-like clutter."""
    rate, thickness = log_uniform(rng, 1.5, 6.0) * 2 * np.pi, log_uniform(rng, 0.1, 1.0)

    def distance(p: Array) -> Array:
        q = p * rate
        gyroid = np.einsum("...i,...i->...", np.sin(q), np.cos(np.roll(q, -1, axis=-1)))
        result: Array = np.maximum((np.abs(gyroid) - thickness) / (rate * 1.8), sd.sphere(p, 0.5))
        return result

    return distance


FAMILIES: dict[str, Family] = {
    family.__name__: family
    for family in (
        wall, ball, ellipsoid, box, rounded_box, panel, rod, cylinder, tube, capsule, cone, torus, cable, leaf,
        stairs, terrain, rock, superquadric, prism, lathe, grating, twisted_bar, sponge,
    )
}  # fmt: skip
