"""Clean cubes: objects composed of random solids, cut at 1 to 20 percent of their extent, as voxels.

Solids that cannot reach a cube are left out of its evaluation, so its cost does not grow with the object.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ...core.distances import signed as sd
from ...core.errors import InvalidArgument
from ...core.frames import RESOLUTION, CubeFrame, random_rotations
from ..recipe import Recipe
from .narrow_band import shell_in_cube
from .primitives import FAMILIES, Solid, log_uniform
from .undulations import sine

Array = NDArray[Any]
Occupancy = NDArray[np.bool_]
Operation = Literal["add", "blend", "cut"]

_BALL_RADIUS = float(np.sqrt(3.0) / 2)  # of the cube's circumscribed ball, in edges


@dataclass(frozen=True)
class Part:
    """One solid placed in an object: ``extent * solid(R^T (p - center) / extent)``, and how it joins the rest."""

    solid: Solid
    center: Array
    rotation: Array
    extent: float
    operation: Operation = "add"
    fillet: float = 0.0

    def distance(self, positions: Array) -> Array:
        """Signed distance ``(N,)`` at ``positions (N, 3)`` of the object."""
        turn = self.rotation.T / self.extent
        local = turn @ positions.T  # axes first in memory: several times as fast
        local -= (turn @ self.center)[:, None]
        return self.solid(local.T) * self.extent


@dataclass(frozen=True)
class ComposedObject:
    """Solids joined in order, about one unit across; ``extent`` is the longest side of its box."""

    parts: tuple[Part, ...]
    extent: float

    def distance(self, positions: Array) -> Array:
        """Signed distance bound ``(N,)`` at ``positions (N, 3)``."""
        result: Array | None = None
        for part in self.parts:
            value = part.distance(positions)
            if result is None:
                result = value
            elif part.operation == "add":
                result = np.minimum(result, value)
            elif part.operation == "blend":
                result = sd.smooth_union(result, value, part.fillet)
            else:
                result = sd.difference(result, value)
        return result if result is not None else np.full(len(positions), np.inf)

    def near(self, center: Array, radius: float) -> ComposedObject:
        """The object as a ball sees it: without the parts that cannot change the distance's sign in it."""
        kept: list[Part] = []
        for part in self.parts:
            reach = (radius + part.fillet) * 1.1
            if not kept and part.operation == "cut":
                continue  # nothing to carve it out of
            if float(part.distance(center[None])[0]) <= reach:
                kept.append(part)
        return replace(self, parts=tuple(kept))

    def seen_from(self, frame: CubeFrame) -> ComposedObject:
        """The object in a cube's own coordinates, the cube being [-1/2, 1/2]^3, distances in edges."""
        parts = [
            replace(
                part,
                center=frame.to_local(part.center),
                rotation=frame.rotation.T @ part.rotation,
                extent=part.extent / frame.edge_length,
                fillet=part.fillet / frame.edge_length,
            )
            for part in self.parts
        ]
        return ComposedObject(tuple(parts), self.extent / frame.edge_length)


def _bumpy(rng: np.random.Generator, solid: Solid) -> Solid:
    """Displace a surface by up to 0.004 to 0.05 along a periodic pattern of 1 to 12 periods a unit."""
    rate, depth = log_uniform(rng, 1.0, 12.0) * 2 * np.pi, log_uniform(rng, 0.004, 0.05)
    phase = rng.uniform(0, 2 * np.pi, size=3)
    bound = 1.0 + depth * rate

    def distance(p: Array) -> Array:
        waves = [sine(p[..., axis] * rate + float(phase[axis])) for axis in range(3)]
        result: Array = (solid(p) + depth * waves[0] * waves[1] * waves[2]) / bound
        return result

    return distance


def _hollow(rng: np.random.Generator, solid: Solid) -> Solid:
    """The wall of a solid, 0.005 to 0.08 thick, open towards +z."""
    thickness, opening = log_uniform(rng, 0.005, 0.08), rng.uniform(0.0, 0.4)
    return lambda p: np.maximum(sd.shell(solid(p), thickness), p[..., 2] - opening)


def _chopped(rng: np.random.Generator, solid: Solid, other: Solid) -> Solid:
    """The common part of two solids, the other one moved by up to 0.3."""
    shift = rng.uniform(-0.3, 0.3, size=3)
    return lambda p: np.maximum(solid(p), other(p - shift))


def _solid(rng: np.random.Generator, recipe: Recipe) -> Solid:
    names = recipe.families or tuple(FAMILIES)
    draw: Callable[[], Solid] = lambda: FAMILIES[names[int(rng.integers(len(names)))]](rng)  # noqa: E731
    solid = draw()
    if rng.random() < 0.1:
        solid = _chopped(rng, solid, draw())
    if rng.random() < recipe.hollow_share:
        solid = _hollow(rng, solid)
    if rng.random() < recipe.bumpy_share:
        solid = _bumpy(rng, solid)
    return solid


def compose_object(rng: np.random.Generator, recipe: Recipe) -> ComposedObject:
    """A random object: the first solid is the largest, the others are placed about it and added, blended or cut.

    A third of the objects are axis-aligned among themselves, as furniture and rooms are.

    Example:
        >>> from unghost.data_recipes.recipe import load_recipe
        >>> rng, recipe = np.random.default_rng(0), load_recipe("procedural")
        >>> composed = compose_object(rng, recipe)
        >>> composed.distance(np.zeros((4, 3))).shape
        (4,)
    """
    count = round(log_uniform(rng, recipe.parts[0], recipe.parts[1]))
    extents = np.sort(log_uniform(rng, *recipe.part_extent, count))[::-1]
    extents = extents / extents[0]
    rotations = random_rotations(rng, count)
    if rng.random() < 0.34:
        rotations[:] = rotations[0]
    parts: list[Part] = []
    for extent, rotation in zip(extents, rotations):
        host = parts[int(rng.integers(len(parts)))] if parts else None
        center = np.zeros(3) if host is None else host.center + rng.normal(size=3) * 0.25 * (host.extent + extent)
        operation: Operation = "add"
        if host is not None:
            draw = rng.random()
            if draw < recipe.cavity_share:
                operation = "cut"
            elif draw < recipe.cavity_share + recipe.smooth_share:
                operation = "blend"
        fillet = extent * log_uniform(rng, 0.02, 0.5) if operation == "blend" else 0.0
        parts.append(Part(_solid(rng, recipe), center, rotation, float(extent), operation, float(fillet)))
    low = np.min([part.center - part.extent / 2 for part in parts], axis=0)
    high = np.max([part.center + part.extent / 2 for part in parts], axis=0)
    return ComposedObject(tuple(parts), float((high - low).max()))


def _newton(part: Part, points: Array, steps: int = 3) -> tuple[Array, Array]:
    """Points ``(N, 3)`` moved onto a part's own surface, and the distance's gradient there (finite differences)."""
    width = 1e-3 * part.extent
    stencil = np.concatenate([np.zeros((1, 3)), np.eye(3) * width])[:, None, :]
    normals = np.zeros_like(points)
    for _ in range(steps):
        values = part.distance((points[None] + stencil).reshape(-1, 3)).reshape(4, -1)
        normals = ((values[1:] - values[0]) / width).T
        moves = normals * (values[0] / np.maximum((normals**2).sum(axis=1), 1e-2))[:, None]
        lengths = np.linalg.norm(moves, axis=1, keepdims=True)
        points = points - moves * np.minimum(1.0, 0.5 * part.extent / np.maximum(lengths, 1e-12))
    return points, normals


def surface_point(rng: np.random.Generator, composed: ComposedObject, *, tries: int = 24) -> tuple[Array, Array]:
    """A point on the surface and the unit normal there, both ``(3,)``.

    A part is drawn, points about it are moved onto its surface by Newton steps on its own distance, and one
    of those that lie on the whole object's surface is taken. A part without any (buried, or a cavity beside
    the solids) is replaced by another one, up to four times; then the nearest miss is taken. Parts are
    equally likely whatever their extent, which favours detail.

    Example:
        >>> from unghost.data_recipes.recipe import load_recipe
        >>> rng, recipe = np.random.default_rng(0), load_recipe("procedural")
        >>> composed = compose_object(rng, recipe)
        >>> point, normal = surface_point(rng, composed)
        >>> bool(abs(composed.distance(point[None])[0]) < 0.05), round(float(np.linalg.norm(normal)), 3)
        (True, 1.0)
    """
    best: tuple[float, Array, Array] | None = None
    for row in rng.permutation(len(composed.parts))[:4]:
        part = composed.parts[int(row)]
        start = part.center + rng.uniform(-0.55, 0.55, size=(tries, 3)) * part.extent
        points, normals = _newton(part, start)
        misses = np.abs(composed.distance(points))
        hits = np.flatnonzero(misses < 1e-3 * part.extent)
        chosen = int(hits[int(rng.integers(len(hits)))]) if len(hits) else int(np.argmin(misses))
        if best is None or misses[chosen] < best[0]:
            best = float(misses[chosen]), points[chosen], normals[chosen]
        if len(hits):
            break
    assert best is not None  # an object has at least one part
    normal = best[2] if np.any(best[2]) else rng.normal(size=3)
    return best[1], normal / np.linalg.norm(normal)


def dilate(occupancy: Occupancy, iterations: int, *, faces_only: bool = False) -> Occupancy:
    """Grow by ``iterations`` voxels, through 26 neighbours or the 6 that share a face; 0 is the identity.

    Args:
        occupancy: ``(R, R, R)`` bool.
        iterations: >= 0.
        faces_only: 6 neighbours rather than 26.

    Example:
        >>> point = np.zeros((3, 3, 3), dtype=bool)
        >>> point[1, 1, 1] = True
        >>> [int(dilate(point, 1, faces_only=faces).sum()) for faces in (False, True)]
        [27, 7]
    """
    if iterations < 0:
        raise InvalidArgument(f"dilate: iterations must be >= 0, got {iterations}")
    grown = occupancy.copy()
    for _ in range(iterations):
        source = grown.copy() if faces_only else grown
        for axis in range(3):
            before = source if faces_only else grown.copy()
            ahead, behind = [slice(None)] * 3, [slice(None)] * 3
            ahead[axis], behind[axis] = slice(1, None), slice(None, -1)
            grown[tuple(ahead)] |= before[tuple(behind)]
            grown[tuple(behind)] |= before[tuple(ahead)]
    return grown


def random_dilation(rng: np.random.Generator, occupancy: Occupancy, maximum: int) -> Occupancy:
    """Dilate 0 to ``maximum`` times, each count half as likely as the one before.

    Example:
        >>> point = np.zeros((5, 5, 5), dtype=bool)
        >>> point[2, 2, 2] = True
        >>> bool(random_dilation(np.random.default_rng(0), point, 2)[2, 2, 2])
        True
    """
    weights = 0.5 ** np.arange(maximum + 1)
    count = int(rng.choice(maximum + 1, p=weights / weights.sum()))
    return dilate(occupancy, count, faces_only=bool(rng.random() < 0.5))


def shell_from_distance(distance: Array, *, thickness: float = 1.0) -> Occupancy:
    """Voxels that a surface crosses, from distances at their centres.

    A plane ``d + g . x = 0`` meets a voxel when ``|d| <= (|gx| + |gy| + |gz|) / 2`` with the gradient g per
    voxel; g is the steeper of the two one-sided differences, so that sheets thinner than a voxel survive and
    distances off by a factor (bounds) give the same shell as exact ones.

    Args:
        distance: ``(R, R, R)``, any unit.
        thickness: 1 is the exact test for a plane.

    Example:
        >>> height = np.broadcast_to(np.arange(8.0) - 3.0, (8, 8, 8))  # of a plane through the voxels of index 3
        >>> shell_from_distance(height)[0, 0].tolist()
        [False, False, False, True, False, False, False, False]
    """
    slopes = np.zeros_like(distance)
    for axis in range(3):
        change = np.abs(np.diff(distance, axis=axis))
        pad = [(0, 0)] * 3
        pad[axis] = (1, 1)
        padded = np.pad(change, pad)
        low, high = [slice(None)] * 3, [slice(None)] * 3
        low[axis], high[axis] = slice(None, -1), slice(1, None)
        slopes += np.maximum(padded[tuple(low)], padded[tuple(high)])
    result: Occupancy = np.abs(distance) <= 0.5 * thickness * slopes
    return result


def draw_offset(rng: np.random.Generator, recipe: Recipe, normal: Array) -> Array:
    """Where a cube's centre lies, in edges, seen from a surface point ``(3,)``: on, near or away from it."""
    draw = rng.random()
    if draw < recipe.on_share:
        return rng.uniform(-1.0, 1.0, size=3) * recipe.center_jitter
    side = 1.0 if rng.random() < 0.75 else -1.0
    if draw < recipe.on_share + recipe.near_share:
        return normal * side * rng.uniform(0.0, 0.5) + rng.uniform(-0.25, 0.25, size=3)
    return normal * side * rng.uniform(0.5, 0.85)


def sample_cube(rng: np.random.Generator, recipe: Recipe) -> tuple[Occupancy, float, CubeFrame | None]:
    """One clean procedural cube.

    Returns:
        ``occupancy (32, 32, 32)`` bool, the cube's edge over the object's extent, and where the cube lay in the
        coordinates of its object; None for a cube that is empty by choice, for which no object was composed.

    Example:
        >>> from unghost.data_recipes.recipe import load_recipe
        >>> occupancy, edge_fraction, frame = sample_cube(np.random.default_rng(0), load_recipe("procedural"))
        >>> occupancy.shape, bool(occupancy.any()), 0 < edge_fraction <= 1
        ((32, 32, 32), True, True)
    """
    fraction = log_uniform(rng, *recipe.edge_fraction)
    if rng.random() < recipe.empty_share:
        return np.zeros((RESOLUTION,) * 3, dtype=bool), fraction, None
    composed = compose_object(rng, recipe)
    point, normal = surface_point(rng, composed)
    edge = fraction * composed.extent
    center = point + draw_offset(rng, recipe, normal) * edge
    frame = CubeFrame(center, edge, random_rotations(rng, 1)[0])
    visible = composed.near(center, edge * _BALL_RADIUS).seen_from(frame)
    thickness, solid = float(rng.uniform(*recipe.shell_thickness)), bool(rng.random() < recipe.solid_share)
    if not visible.parts:
        return np.zeros((RESOLUTION,) * 3, dtype=bool), fraction, frame
    occupancy = shell_in_cube(visible.distance, thickness=thickness, solid=solid)
    return random_dilation(rng, occupancy, recipe.max_dilation), fraction, frame
