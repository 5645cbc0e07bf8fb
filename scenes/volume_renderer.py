"""A small volume renderer in numpy: emission and absorption along rays, with a sun, a sky and soft shade."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.cameras import Cameras, look_at
from ..core.errors import needs_extra
from ..core.interpolate import interpolate_grid

Floats = NDArray[np.float32]
SUN = np.array([0.42, -0.50, 0.76]) / np.linalg.norm([0.42, -0.50, 0.76])
PAPER = np.array([0.965, 0.955, 0.94], dtype=np.float32)  # the page's background


@dataclass(frozen=True)
class Volume:
    """``samples (X, Y, Z, 4)``: shaded red, green, blue and optical depth per cell; ``aabb (2, 3)``; ``pitch``."""

    samples: Floats
    aabb: NDArray[np.float64]
    pitch: float


def camera_at(eye: Any, target: Any, *, width: int, height: int, fov_degrees: float) -> Cameras:
    """One camera at ``eye`` that looks at ``target`` with z up; ``fov_degrees`` is horizontal.

    Example:
        >>> camera = camera_at([2.0, 0.0, 0.0], [0.0, 0.0, 0.0], width=8, height=6, fov_degrees=60)
        >>> camera.origins.tolist()
        [[2.0, 0.0, 0.0]]
    """
    pose = look_at(np.array([eye], dtype=float), np.array([target], dtype=float))
    focal = 0.5 * width / np.tan(np.radians(fov_degrees) / 2)
    return Cameras.create(pose, np.array([focal, focal, width / 2, height / 2]), width, height)


def _sunlight(depth: Floats) -> Floats:
    """Share of the sun that reaches each cell: slabs swept from the top, each shifted along the sun's slant."""
    with needs_extra("demo", caller="render"):
        from scipy.ndimage import shift

    light = np.ones_like(depth)
    slant = SUN[:2] / SUN[2]
    longer = np.float32(1.0 / SUN[2])
    for z in range(depth.shape[2] - 2, -1, -1):
        above = light[..., z + 1] * np.exp(-depth[..., z + 1] * longer)
        light[..., z] = shift(above, -slant, order=1, mode="nearest")
    return light


def shade(density: Floats, color: Floats, aabb: NDArray[np.float64], pitch: float) -> Volume:
    """Light a density grid.

    Args:
        density: ``(X, Y, Z)`` per scene unit, >= 0.
        color: ``(X, Y, Z, 3)`` albedo in [0, 1].
        aabb: ``(2, 3)``, scene units.
        pitch: side of a cell, scene units.

    Example:
        >>> aabb = np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
        >>> density = np.zeros((8, 8, 8), np.float32)
        >>> density[2:6, 2:6, 2:6] = 20.0
        >>> shade(density, np.full((8, 8, 8, 3), 0.5, np.float32), aabb, 0.25).samples.shape
        (8, 8, 8, 4)
    """
    with needs_extra("demo", caller="render"):
        from scipy.ndimage import gaussian_filter, maximum_filter

    depth = np.minimum(density * pitch, 8.0).astype(np.float32)
    solid = gaussian_filter(1.0 - np.exp(-depth), 1.0)
    gradient = np.stack(np.gradient(solid), axis=-1)
    steep = np.linalg.norm(gradient, axis=-1, keepdims=True)
    normal = -gradient / np.maximum(steep, 1e-6)
    facing = np.clip(normal @ SUN.astype(np.float32), 0.0, 1.0)
    facing = 0.35 + (facing - 0.35) * np.clip(steep[..., 0] / 0.12, 0.0, 1.0)  # fog has no face
    sky = np.clip(1.15 - 1.3 * gaussian_filter(1.0 - np.exp(-depth), 4.0), 0.25, 1.0)
    sun = gaussian_filter(maximum_filter(_sunlight(depth), 3), 0.7)  # a surface must not shade itself
    warm = np.array([1.05, 0.98, 0.88], dtype=np.float32)
    cool = np.array([0.56, 0.60, 0.66], dtype=np.float32)
    light = sky[..., None] * cool + (0.95 * sun * facing)[..., None] * warm
    shaded = np.clip(color * light, 0.0, 1.0) ** np.float32(1 / 1.15)
    return Volume(np.concatenate([shaded, depth[..., None]], axis=-1).astype(np.float32), aabb, pitch)


def _interval(aabb: NDArray[np.float64], origins: Any, directions: Any) -> tuple[Any, Any]:
    """Where each ray enters and leaves the box."""
    with np.errstate(divide="ignore", invalid="ignore"):
        crossings = (aabb[:, None] - origins) / directions
    near = np.nanmax(crossings.min(axis=0), axis=-1)
    return np.maximum(near, 0.0), np.nanmin(crossings.max(axis=0), axis=-1)


def render(volume: Volume, camera: Cameras, *, steps_per_cell: float = 1.6) -> Floats:
    """March every pixel's ray through the volume; ``(height, width, 3)`` in [0, 1] on a paper background.

    Example:
        >>> aabb = np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
        >>> density = np.zeros((8, 8, 8), np.float32)
        >>> density[2:6, 2:6, 2:6] = 20.0
        >>> volume = shade(density, np.full((8, 8, 8, 3), 0.5, np.float32), aabb, 0.25)
        >>> picture = render(volume, camera_at([4.0, 0.0, 0.0], [0.0, 0.0, 0.0], width=16, height=12, fov_degrees=60))
        >>> picture.shape, bool(np.allclose(picture[0, 0], PAPER, atol=1e-6))  # a corner shows the background
        ((12, 16, 3), True)
    """
    with needs_extra("demo", caller="render"):
        from scipy.ndimage import distance_transform_cdt, maximum_filter

    origins, directions = (values.reshape(-1, 3) for values in camera.rays(0))
    near, far = _interval(volume.aabb, origins, directions)
    step = volume.pitch / steps_per_cell
    shape = np.array(volume.samples.shape[:3])
    busy = maximum_filter(volume.samples[..., 3], 3) > 0.004
    # Empty air is leapt over: within so many cells, along every axis, there is nothing.
    leap = distance_transform_cdt(~busy, "chessboard").astype(np.float32) - 1.0
    color, clear = np.zeros((len(near), 3), dtype=np.float32), np.ones(len(near), dtype=np.float32)
    alive = np.flatnonzero(far > near)
    start = ((origins - volume.aabb[0]) / volume.pitch - 0.5).astype(np.float32)
    along = (directions / volume.pitch).astype(np.float32)
    travel = (near + 0.5 * step).astype(np.float32)
    while len(alive):
        where = start[alive] + along[alive] * travel[alive, None]
        cell = np.clip(np.rint(where), 0, shape - 1).astype(np.int32)
        room = leap[cell[:, 0], cell[:, 1], cell[:, 2]]
        hit = room < 0
        rays = alive[hit]
        if len(rays):
            sample = interpolate_grid(volume.samples, where[hit])
            opacity = 1.0 - np.exp(-sample[:, 3] / np.float32(steps_per_cell))
            color[rays] += (clear[rays] * opacity)[:, None] * sample[:, :3]
            clear[rays] *= 1.0 - opacity
        travel[alive] += np.maximum(room * np.float32(volume.pitch), np.float32(step))
        alive = alive[(travel[alive] < far[alive]) & (clear[alive] > 0.01)]
    image = color + clear[:, None] * PAPER
    return np.asarray(np.clip(image, 0, 1).reshape(camera.height, camera.width, 3), dtype=np.float32)
