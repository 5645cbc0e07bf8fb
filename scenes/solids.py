"""Scenes made of signed distances: exact geometry, textures, lights, and a sphere tracer. numpy only."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.distances import signed as sd

Array = NDArray[Any]

SHAPES: dict[str, Callable[..., Array]] = {
    "sphere": sd.sphere,
    "ellipsoid": sd.ellipsoid,
    "box": sd.box,
    "rounded_box": sd.rounded_box,
    "cylinder": sd.cylinder,
    "tube": sd.tube,
    "capsule": sd.capsule,
    "torus": sd.torus,
    "cone": sd.cone,
    "polyline_tube": sd.polyline_tube,
    "sampled": lambda positions, distance: distance(positions),  # a SampledDistance
}


@dataclass(frozen=True)
class Texture:
    """Albedo over space.

    Attributes:
        first, second: colours ``(3,)`` in [0, 1].
        pattern: a name of ``PATTERNS``, mixing the two.
        wavelength: of the pattern, scene units.
        gloss: strength of the highlight, [0, 1].
        grain: strength of fine noise on top, [0, 1].
        phase: shifts the pattern, ``(3,)``.
    """

    first: Array
    second: Array
    pattern: str = "plain"
    wavelength: float = 0.2
    gloss: float = 0.0
    grain: float = 0.0
    phase: Array = field(default_factory=lambda: np.zeros(3))

    def albedo(self, positions: Array) -> Array:
        """``(N, 3)`` at ``positions (N, 3)``."""
        mix = PATTERNS[self.pattern](positions / self.wavelength + self.phase)[:, None]
        fine = _noise(positions * (1.4 / self.wavelength) + 3.1 * self.phase)[:, None] - 0.5
        color: Array = np.clip(self.first + (self.second - self.first) * mix + self.grain * fine, 0.0, 1.0)
        return color


def _checker(p: Array) -> Array:
    parity: Array = np.floor(p + 1e-4).sum(axis=1) % 2
    return parity


def _stripes(p: Array) -> Array:
    bright: Array = np.sin(2 * np.pi * (p @ np.array([0.8, 0.35, 0.48]))) > 0
    return bright.astype(np.float64)


def _noise(p: Array) -> Array:
    """A few octaves of crossed sines: smooth, not periodic on the scale of a room."""
    total = np.zeros(len(p))
    for octave in range(4):
        q = p * 1.9**octave
        total += (
            np.sin(6.1 * q[:, 0] + 3.1 * np.sin(2.3 * q[:, 1] + octave))
            * np.sin(5.3 * q[:, 1] + 2.7 * np.sin(3.1 * q[:, 2]))
            + np.sin(4.7 * q[:, 2] + 2.9 * np.sin(1.9 * q[:, 0]))
        ) / 1.6**octave
    mix: Array = 0.5 + 0.5 * np.tanh(total)
    return mix


PATTERNS: dict[str, Callable[[Array], Array]] = {
    "plain": lambda p: np.full(len(p), 0.5),
    "gradient": lambda p: 0.5 + 0.5 * np.sin(p @ np.array([0.7, 0.5, 0.4])),
    "checker": _checker,
    "stripes": _stripes,
    "noise": _noise,
}


@dataclass(frozen=True)
class Solid:
    """One textured shape: a name of ``SHAPES``, its parameters, and where it stands.

    ``bound`` is the radius of a ball around ``center`` that holds the solid; ``inside_out`` turns it
    into a hollow (a room), and then ``bound`` is ignored.
    """

    shape: str
    parameters: tuple[Any, ...]
    center: Array
    texture: Texture
    bound: float
    rotation: Array = field(default_factory=lambda: np.eye(3))
    inside_out: bool = False

    def distance(self, positions: Array) -> Array:
        """Signed distance ``(N,)`` at ``positions (N, 3)``."""
        value = SHAPES[self.shape]((positions - self.center) @ self.rotation, *self.parameters)
        return -value if self.inside_out else value


@dataclass(frozen=True)
class Light:
    """A point light: position ``(3,)`` and strength."""

    position: Array
    strength: float


@dataclass(frozen=True)
class SolidScene:
    """A union of solids under a few lights; rays that hit nothing see ``sky``."""

    solids: Sequence[Solid]
    lights: Sequence[Light]
    ambient: float = 0.5
    sky: Array = field(default_factory=lambda: np.array([0.7, 0.8, 0.9]))

    def nearest(self, positions: Array, *, chunk: int = 8192) -> tuple[Array, NDArray[np.int64]]:
        """Signed distance to the union and which solid is nearest, each ``(N,)``.

        A solid is only evaluated where its bounding ball could bring the minimum down. The sign is that of
        the plain minimum over all solids and so is the value, where every shape's distance is exact; a shape
        that only bounds its distance (the ellipsoid) may be passed over where its ball is farther than another
        solid: the value then lies between the plain minimum and the true distance.
        """
        if len(positions) <= chunk:
            return self._nearest(positions)
        parts = [self._nearest(positions[start : start + chunk]) for start in range(0, len(positions), chunk)]
        return np.concatenate([part[0] for part in parts]), np.concatenate([part[1] for part in parts])

    def _nearest(self, positions: Array) -> tuple[Array, NDArray[np.int64]]:
        best = np.full(len(positions), np.inf)
        owner = np.zeros(len(positions), dtype=np.int64)
        centers = np.array([solid.center for solid in self.solids])
        squared = (centers**2).sum(1)[:, None] + (positions**2).sum(1) - 2.0 * centers @ positions.T
        bounds = 1e-6 + np.array([np.inf if solid.inside_out else solid.bound for solid in self.solids])
        lower = np.sqrt(np.maximum(squared.min(axis=1), 0.0)) - bounds if len(positions) else np.zeros(0)
        for index in np.argsort(lower):
            if lower[index] >= best.max():
                break
            reach = np.maximum(best + bounds[index], 0.0)
            chosen = np.flatnonzero(squared[index] < reach * reach)
            if not len(chosen):
                continue
            value = self.solids[index].distance(positions[chosen])
            closer = value < best[chosen]
            best[chosen[closer]] = value[closer]
            owner[chosen[closer]] = index
        return best, owner

    def signed_distance(self, positions: Array) -> Array:
        """``positions (..., 3)`` to ``(...)``: negative inside solids and walls."""
        flat = np.asarray(positions, dtype=np.float64).reshape(-1, 3)
        return self.nearest(flat)[0].reshape(positions.shape[:-1])

    def trace(self, origins: Array, directions: Array, *, far: float = 60.0, steps: int = 256) -> Array:
        """Distance along unit rays ``(N, 3)`` to the first surface, ``(N,)``; inf where there is none before ``far``.

        A ray has arrived within ``5e-4 + 2e-4 * distance`` of a surface. One that is still on its way after
        ``steps`` counts as a hit only if it grazes a surface at that moment, to within ten times as much.
        """
        distance = np.zeros(len(origins))
        hit = np.zeros(len(origins), dtype=bool)
        active = np.arange(len(origins))
        for _ in range(steps):
            gap = self.nearest(origins[active] + distance[active, None] * directions[active])[0]
            distance[active] += gap
            reach = 5e-4 + 2e-4 * distance[active]
            arrived = gap < reach
            hit[active[arrived]] = True
            going = ~arrived & (distance[active] < far)
            grazing = active[going & (gap < 10.0 * reach)]
            active = active[going]
            if not len(active):
                break
        else:
            hit[grazing] = True
        return np.where(hit & (distance < far), distance, np.inf)

    def normals(self, positions: Array, *, step: float = 1e-3) -> Array:
        """Unit outward normals ``(N, 3)`` by central differences on a tetrahedron."""
        corners = np.array([[1, -1, -1], [-1, -1, 1], [-1, 1, -1], [1, 1, 1]], dtype=np.float64)
        total = sum(corner * self.nearest(positions + step * corner)[0][:, None] for corner in corners)
        normals: Array = total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)
        return normals

    def albedo(self, positions: Array) -> Array:
        """Albedo ``(N, 3)`` in [0, 1] of the solid nearest to ``positions (N, 3)``."""
        owner = self.nearest(positions)[1]
        albedo = np.zeros_like(positions)
        for index in np.unique(owner):
            mine = owner == index
            albedo[mine] = self.solids[index].texture.albedo(positions[mine])
        return albedo

    def shade(self, positions: Array, directions: Array) -> Array:
        """Colour ``(N, 3)`` in [0, 1] of surface points seen along unit ``directions``: Lambert plus a gloss lobe."""
        normals = self.normals(positions)
        owner = self.nearest(positions)[1]
        albedo, gloss = np.zeros_like(positions), np.zeros(len(positions))
        for index in np.unique(owner):
            mine = owner == index
            albedo[mine] = self.solids[index].texture.albedo(positions[mine])
            gloss[mine] = self.solids[index].texture.gloss
        color = albedo * self.ambient * (0.75 + 0.25 * normals[:, 2:3])
        for light in self.lights:
            toward = light.position - positions
            toward /= np.maximum(np.linalg.norm(toward, axis=1, keepdims=True), 1e-9)
            diffuse = np.maximum((normals * toward).sum(1), 0.0)
            half = toward - directions
            half /= np.maximum(np.linalg.norm(half, axis=1, keepdims=True), 1e-9)
            lobe = gloss * np.maximum((normals * half).sum(1), 0.0) ** 24
            color += light.strength * (albedo * diffuse[:, None] + lobe[:, None])
        return np.clip(color, 0.0, 1.0)

    def render(self, origins: Array, directions: Array) -> tuple[Array, Array]:
        """Colours ``(N, 3)`` and distances ``(N,)`` (inf for sky) of unit rays ``(N, 3)``."""
        distance = self.trace(origins, directions)
        color = np.broadcast_to(self.sky, origins.shape).copy()
        hit = np.isfinite(distance)
        color[hit] = self.shade(origins[hit] + distance[hit, None] * directions[hit], directions[hit])
        return color, distance
