"""Families of solids with random proportions, each about one unit long, as signed distances.

A family is ``(rng) -> solid`` and a solid maps ``positions (N, 3)`` to signed distances ``(N,)``
(negative inside). Those of this file are exact Euclidean distances, inside and outside, but for ``cable``,
``lathe`` and ``studs``, which are exact outside and a bound inside; those of :mod:`undulations` are bounds.
No value exceeds the true distance by more than a few percent, so that a solid which is far from a cube can be
left out. Every proportion and every count is log-uniform over the range written beside it; what has no
natural zero (angles of placement, phases, offsets) is uniform.

Example:
    >>> solid = FAMILIES["ball"](np.random.default_rng(0))
    >>> (solid(np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]])) < 0).tolist()
    [True, False]
"""

from __future__ import annotations

import numpy as np

from ...core.distances import signed as sd
from . import distances
from .draws import Array, Family, Solid, log_uniform, log_whole
from .undulations import leaf, rock, sponge, superquadric, terrain, twisted_bar

__all__ = ["BOUNDS", "FAMILIES", "Family", "Solid", "log_uniform"]


def wall(rng: np.random.Generator) -> Solid:
    """One to three half-spaces at right angles: a floor, an edge or a corner, convex or concave."""
    count = log_whole(rng, 1, 3)
    offsets = rng.uniform(-0.2, 0.2, size=count)
    side = 1.0 if rng.random() < 0.5 else -1.0
    return lambda p: side * distances.corner([side * (p[..., axis] - float(o)) for axis, o in enumerate(offsets)])


def wedge(rng: np.random.Generator) -> Solid:
    """Two half-spaces at an angle of 15 to 165 degrees, the angle solid or hollow."""
    angle = np.radians(log_uniform(rng, 15.0, 165.0))
    side = 1.0 if rng.random() < 0.5 else -1.0
    return lambda p: side * distances.wedge(p[..., 0], p[..., 1], angle)


def ball(rng: np.random.Generator) -> Solid:
    """Sphere, radius 0.25 to 0.5."""
    radius = log_uniform(rng, 0.25, 0.5)
    return lambda p: sd.sphere(p, radius)


def ellipsoid(rng: np.random.Generator) -> Solid:
    """Ellipsoid, radii 0.125 to 0.5."""
    radii = log_uniform(rng, 0.125, 0.5, 3)
    return lambda p: distances.ellipsoid(p, radii)


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
    steps = rng.normal(size=(log_whole(rng, 3, 6), 3)) * 0.25
    points = np.cumsum(steps + steps[0], axis=0)
    points -= points.mean(axis=0)
    points /= max(2.0 * float(np.abs(points).max()), 1e-6)
    radius = log_uniform(rng, 0.008, 0.08)
    return lambda p: distances.polyline([p[..., 0], p[..., 1], p[..., 2]], points) - radius


def sheet(rng: np.random.Generator) -> Solid:
    """Bent sheet with rounded rims, bend radius 0.15 to 3, length 0.3 to 1, width 0.1 to 1, thickness 0.004 to 0.03."""
    radius, length = log_uniform(rng, 0.15, 3.0), log_uniform(rng, 0.3, 1.0)
    half_width, thickness = log_uniform(rng, 0.05, 0.5), log_uniform(rng, 0.004, 0.03)
    half_angle = min(length / (2 * radius), 2.8)
    return lambda p: distances.bent_sheet(p, radius, half_angle, half_width, thickness)


def stairs(rng: np.random.Generator) -> Solid:
    """3 to 7 steps along x, rise over run 0.3 to 1.5, half width 0.1 to 0.5."""
    count, slope, half_width = log_whole(rng, 3, 7), log_uniform(rng, 0.3, 1.5), log_uniform(rng, 0.1, 0.5)
    across = np.repeat(np.arange(count + 1), 2)[1:-1] / count - 0.5
    heights = np.repeat(np.arange(1, count + 1), 2) * slope / count - slope / 2
    profile = np.concatenate([np.stack([across, heights], axis=1), [[0.5, -slope / 2], [-0.5, -slope / 2]]])
    return lambda p: distances.extrude(distances.polygon(p[..., 0], p[..., 2], profile), p[..., 1], half_width)


def ridges(rng: np.random.Generator) -> Solid:
    """Ground below a jagged height field that runs along y: 4 to 10 points, heights 0.02 to 0.4."""
    count = log_whole(rng, 4, 10)
    across = np.sort(rng.uniform(-0.5, 0.5, size=count))
    across[[0, -1]] = -0.5, 0.5
    profile = np.concatenate([np.stack([across, log_uniform(rng, 0.02, 0.4, count)], 1), [[0.5, -0.5], [-0.5, -0.5]]])
    half = log_uniform(rng, 0.1, 0.5)
    return lambda p: distances.extrude(distances.polygon(p[..., 0], p[..., 2], profile), p[..., 1], half)


def studs(rng: np.random.Generator) -> Solid:
    """Ground with bumps, 3 to 9 a side, radius 0.05 to 0.5 of their pitch, sunk by 0.05 to 0.8 of it."""
    reach = log_whole(rng, 1, 4)
    pitch = 1.0 / (2 * reach + 1)
    radius = pitch * log_uniform(rng, 0.05, 0.5)
    sunk = radius * log_uniform(rng, 0.05, 0.8)
    return lambda p: distances.studs(p, pitch, radius, sunk, reach)


def lattice(rng: np.random.Generator) -> Solid:
    """Square bars along three axes, 3 to 9 each way, thickness 0.04 to 0.6 of their pitch: scaffolds, crates, racks."""
    reach = log_whole(rng, 1, 4)
    pitch = 0.5 / (reach + 0.3)
    half_bar = pitch / 2 * log_uniform(rng, 0.04, 0.6)
    return lambda p: distances.lattice(p, pitch, half_bar, reach)


def _star_outline(rng: np.random.Generator) -> Array:
    """A star-shaped polygon ``(n, 2)`` of 3 to 9 corners, radii 0.15 to 0.5; regular or not."""
    corners = log_whole(rng, 3, 9)
    angles = np.arange(corners) * 2 * np.pi / corners
    radii: Array = np.full(corners, 0.45)
    if rng.random() < 0.7:
        radii = log_uniform(rng, 0.15, 0.5, corners)
        angles = angles + rng.uniform(-0.3, 0.3, size=corners) * 2 * np.pi / corners
    return np.stack([radii * np.cos(angles), radii * np.sin(angles)], axis=-1)


def prism(rng: np.random.Generator) -> Solid:
    """Extruded star-shaped polygon, half height 0.01 to 0.5."""
    outline, half = _star_outline(rng), log_uniform(rng, 0.01, 0.5)
    return lambda p: distances.extrude(distances.polygon(p[..., 0], p[..., 1], outline), p[..., 2], half)


def lathe(rng: np.random.Generator) -> Solid:
    """Wall of 0.01 to 0.06 around a profile of 3 to 5 points turned about z: vases, bowls, lamps."""
    count = log_whole(rng, 3, 5)
    profile = np.stack([log_uniform(rng, 0.05, 0.45, count), np.sort(rng.uniform(-0.5, 0.5, size=count))], axis=-1)
    half = log_uniform(rng, 0.01, 0.06) / 2
    return lambda p: distances.polyline([np.sqrt(p[..., 0] ** 2 + p[..., 1] ** 2), p[..., 2]], profile) - half


def grating(rng: np.random.Generator) -> Solid:
    """2 to 10 equal bars side by side: fences, blinds, rows of books, keyboards."""
    count = log_whole(rng, 2, 10)
    pitch = 1.0 / count
    half = np.array([pitch / 2 * log_uniform(rng, 0.1, 0.9), log_uniform(rng, 0.01, 0.5), log_uniform(rng, 0.05, 0.5)])
    round_bars = rng.random() < 0.3

    def distance(p: Array) -> Array:
        index = np.clip(np.round(p[..., 0] / pitch - 0.5 * ((count + 1) % 2)), -(count // 2), (count - 1) // 2)
        local = p.copy()
        local[..., 0] -= (index + 0.5 * ((count + 1) % 2)) * pitch
        return sd.cylinder(local, float(half[0]), float(half[2])) if round_bars else sd.box(local, half)

    return distance


BOUNDS: tuple[Family, ...] = (leaf, terrain, rock, superquadric, twisted_bar, sponge)

FAMILIES: dict[str, Family] = {
    family.__name__: family
    for family in (
        wall,
        wedge,
        ball,
        ellipsoid,
        box,
        rounded_box,
        panel,
        rod,
        cylinder,
        tube,
        capsule,
        cone,
        torus,
        cable,
        sheet,
        stairs,
        ridges,
        studs,
        lattice,
        prism,
        lathe,
        grating,
        *BOUNDS,
    )
}
