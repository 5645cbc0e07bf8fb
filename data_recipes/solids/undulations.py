"""Families of solids whose signed distance is a bound: waves, twists, powers.

Their zero set and sign are exact. The value never exceeds the true distance by more than a few percent and
changes by no more than the way moved, since it is divided by a Lipschitz bound. ``rng`` and the meaning of a
family as in :mod:`primitives`. Sines are float32: off by 1e-6 of an amplitude, at a tenth of the cost.
"""

from __future__ import annotations

import numpy as np

from ...core.distances import signed as sd
from .distances import total
from .draws import Array, Solid, log_uniform


def sine(phase: Array) -> Array:
    """Sine in float32."""
    result: Array = np.sin(phase.astype(np.float32))
    return result


def _waves(rng: np.random.Generator, low: float, high: float, count: int) -> tuple[Array, Array, Array]:
    """Random plane waves: wave vectors ``(count, 3)`` (radians per unit), phases, amplitudes that add to 1."""
    frequency = log_uniform(rng, low, high, count) * 2 * np.pi
    direction = rng.normal(size=(3, count))
    vectors = (direction / np.linalg.norm(direction, axis=0) * frequency).T
    amplitude = 1.0 / frequency
    return vectors, rng.uniform(0, 2 * np.pi, size=count), amplitude / amplitude.sum()


def _sum_of_waves(coordinates: list[Array], vectors: Array, phases: Array, amplitudes: Array) -> Array:
    return total(
        float(amplitude) * sine(total(c * float(k) for c, k in zip(coordinates, vector)) + float(phase))
        for vector, phase, amplitude in zip(vectors, phases, amplitudes)
    )


def leaf(rng: np.random.Generator) -> Solid:
    """Thin cap of a sphere with an elliptic outline, thickness 0.004 to 0.03."""
    curvature, thickness = log_uniform(rng, 0.4, 4.0), log_uniform(rng, 0.004, 0.03)
    outline = log_uniform(rng, 0.15, 0.5, 2)
    center = np.array([0.0, 0.0, 1.0 / curvature])

    def distance(p: Array) -> Array:
        sheet = np.abs(sd.sphere(p - center, 1.0 / curvature)) - thickness / 2
        rim = (np.sqrt((p[..., 0] / outline[0]) ** 2 + (p[..., 1] / outline[1]) ** 2) - 1.0) * outline.min()
        result: Array = np.maximum(np.maximum(sheet, rim), p[..., 2] - 1.0 / curvature)
        return result

    return distance


def terrain(rng: np.random.Generator) -> Solid:
    """Ground below a height field of 4 plane waves, 0.5 to 8 per unit, relief 0.02 to 0.2."""
    vectors, phases, amplitudes = _waves(rng, 0.5, 8.0, 4)
    relief = log_uniform(rng, 0.02, 0.2)
    slope = relief * float((amplitudes * np.linalg.norm(vectors[:, :2], axis=1)).sum())
    bound = float(np.hypot(1.0, slope))

    def distance(p: Array) -> Array:
        height = _sum_of_waves([p[..., 0], p[..., 1]], vectors[:, :2], phases, amplitudes * relief)
        result: Array = (p[..., 2] - height) / bound
        return result

    return distance


def rock(rng: np.random.Generator) -> Solid:
    """Ball displaced by 5 plane waves, 0.7 to 5 per unit, by 0.03 to 0.15."""
    vectors, phases, amplitudes = _waves(rng, 0.7, 5.0, 5)
    depth, radius = log_uniform(rng, 0.03, 0.15), log_uniform(rng, 0.2, 0.4)
    bound = 1.0 + depth * float((amplitudes * np.linalg.norm(vectors, axis=1)).sum())

    def distance(p: Array) -> Array:
        bumps = _sum_of_waves([p[..., 0], p[..., 1], p[..., 2]], vectors, phases, amplitudes * depth)
        result: Array = (sd.sphere(p, radius) - bumps) / bound
        return result

    return distance


def superquadric(rng: np.random.Generator) -> Solid:
    """``(|x|^e + |y|^e + |z|^e)^(1/e) = 1`` with exponent 1 to 6 and radii 0.15 to 0.5."""
    exponent, radii = log_uniform(rng, 1.0, 6.0), log_uniform(rng, 0.15, 0.5, 3)
    steepest = max(1.0, 3.0 ** (1.0 / exponent - 0.5))

    def distance(p: Array) -> Array:
        powers = [(np.abs(p[..., axis]) / radii[axis]) ** exponent for axis in range(3)]
        norm = (powers[0] + powers[1] + powers[2]) ** (1.0 / exponent)
        result: Array = (norm - 1.0) * radii.min() / steepest
        return result

    return distance


def twisted_bar(rng: np.random.Generator) -> Solid:
    """Box of half sides 0.05 to 0.3, twisted about z by 0.1 to 1.5 turns a unit, either way."""
    half = np.array([*log_uniform(rng, 0.05, 0.3, 2), 0.5])
    rate = log_uniform(rng, 0.1, 1.5) * 2 * np.pi * rng.choice([-1.0, 1.0])
    radius = float(np.hypot(half[0], half[1]))
    bound = float(np.hypot(1.0, abs(rate) * radius * 1.3))

    def distance(p: Array) -> Array:
        x, y, z = p[..., 0], p[..., 1], p[..., 2]
        cosine, sines = sine(rate * z + np.pi / 2), sine(rate * z)
        turned = np.stack([cosine * x + sines * y, cosine * y - sines * x, z]).T
        radial = np.sqrt(x**2 + y**2)
        near = np.minimum(sd.box(turned, half) / bound, 0.3 * radius)  # the bound holds to 1.3 radii
        far = np.maximum(radial - radius, np.abs(z) - 0.5)
        result: Array = np.where(radial < 1.3 * radius, np.maximum(near, far), far)
        return result

    return distance


def sponge(rng: np.random.Generator) -> Solid:
    """Gyroid sheet of 1.5 to 6 periods a unit inside a ball: porous things, foliage-like clutter."""
    rate, thickness = log_uniform(rng, 1.5, 6.0) * 2 * np.pi, log_uniform(rng, 0.1, 1.0)

    def distance(p: Array) -> Array:
        phases = [p[..., axis] * rate for axis in range(3)]
        sines, cosines = [sine(q) for q in phases], [sine(q + np.pi / 2) for q in phases]
        gyroid = sines[0] * cosines[1] + sines[1] * cosines[2] + sines[2] * cosines[0]
        result: Array = np.maximum((np.abs(gyroid) - thickness) / (rate * 1.8), sd.sphere(p, 0.5))
        return result

    return distance
