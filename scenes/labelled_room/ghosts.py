"""Labelled ghosts for the demo's room: what badly constrained training leaves in free space.

Blobs that hang free or sit on a surface, wide fog without an edge, faint volumes, and streaks drawn
out towards a camera. Optical depths are per cell, so that opacity is ``1 - exp(-depth)``.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.distances import signed as sd
from ...core.errors import needs_extra
from ...core.frames import random_rotations

Floats = NDArray[np.float32]
KINDS = ("detached", "touching", "fog", "faint", "streak")
COUNTS = {"detached": 26, "touching": 14, "fog": 3, "faint": 6, "streak": 10}
CAMERAS = np.array([[2.3, -2.3, 1.5], [0.2, -2.4, 1.2], [2.4, 0.3, 1.7]])  # where a person would have stood


def sigmoid(values: Any) -> Floats:
    """Logistic function, float32.

    Example:
        >>> sigmoid(np.array([0.0])).tolist()
        [0.5]
    """
    return np.asarray(0.5 * (1.0 + np.tanh(0.5 * values)), dtype=np.float32)


def smooth_noise(rng: np.random.Generator, shape: tuple[int, ...], cells: float) -> Floats:
    """Gaussian noise of ``shape``, blurred over ``cells``, mean 0, standard deviation 1."""
    with needs_extra("demo", caller="smooth_noise"):
        from scipy.ndimage import gaussian_filter

    noise = gaussian_filter(rng.normal(size=shape).astype(np.float32), cells, mode="wrap")
    return np.asarray((noise - noise.mean()) / noise.std(), dtype=np.float32)


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


class _Canvas:
    """Collects ghosts: the densest one at a cell gives the cell its kind; optical depths add up."""

    def __init__(self, positions: Floats, distance: Floats, pitch: float) -> None:
        self.positions, self.distance, self.pitch = positions, distance, pitch
        self.optical_depth = np.zeros(distance.shape, dtype=np.float32)
        self.kind = np.full(distance.shape, -1, dtype=np.int8)
        self._densest = np.zeros(distance.shape, dtype=np.float32)
        self._low = positions[0, 0, 0]

    def window(self, center: NDArray[Any], radius: float) -> tuple[slice, slice, slice]:
        """Cells within ``radius`` of ``center`` along each axis."""
        low = np.floor((center - radius - self._low) / self.pitch).astype(int)
        high = np.ceil((center + radius - self._low) / self.pitch).astype(int) + 1
        x, y, z = (slice(max(a, 0), max(b, 0)) for a, b in zip(low, high))
        return x, y, z

    def add(self, kind: str, window: tuple[slice, slice, slice], depth: Any) -> None:
        """Add ``depth`` (optical, per cell) in free space."""
        free = sigmoid(self.distance[window] / (0.2 * self.pitch))  # nothing inside solids
        depth = (depth * free).astype(np.float32)
        self.optical_depth[window] += depth
        denser = depth > np.maximum(self._densest[window], 0.02)
        self._densest[window] = np.where(denser, depth, self._densest[window])
        self.kind[window] = np.where(denser, np.int8(KINDS.index(kind)), self.kind[window])

    def free_place(self, rng: np.random.Generator, low: float, high: float) -> NDArray[np.float64]:
        """A random cell centre whose distance from every surface lies in [low, high]."""
        cells = np.argwhere((self.distance >= low) & (self.distance <= high))
        if not len(cells):
            cells = np.argwhere(self.distance == self.distance.max())
        return np.asarray(self.positions[tuple(cells[rng.integers(len(cells))])], dtype=np.float64)


def _blob(canvas: _Canvas, rng: np.random.Generator, noise: Floats, kind: str, low: float, high: float) -> None:
    radius = _log_uniform(rng, low, high)
    detached = kind != "touching"
    clearance = (1.35 * radius + 0.08, np.inf) if detached else (-0.02, 0.35 * radius)
    center = canvas.free_place(rng, *clearance)
    window = canvas.window(center, 2.2 * radius + 0.1)
    stretch = np.exp(rng.uniform(-0.3, 0.3, size=3))
    local = (canvas.positions[window] - center) @ random_rotations(rng, 1)[0] / stretch
    distance = np.sqrt((local**2).sum(-1)) - radius * (1.0 + 0.18 * noise[window])
    depth = -np.log1p(-rng.uniform(0.3, 0.95)) if kind != "faint" else rng.uniform(0.14, 0.32)
    canvas.add(kind, window, depth * sigmoid(-distance / (_log_uniform(rng, 0.3, 1.0) * canvas.pitch)))


def _fog(canvas: _Canvas, rng: np.random.Generator, coarse: Floats) -> None:
    spread = rng.uniform(0.28, 0.45, size=3)
    center = canvas.free_place(rng, 0.4, np.inf)
    window = canvas.window(center, 3.0 * float(spread.max()))
    local = (canvas.positions[window] - center) / spread
    body = np.exp(-0.5 * (local**2).sum(-1)) * np.maximum(1.0 + 0.45 * coarse[window], 0.0)
    canvas.add("fog", window, rng.uniform(0.3, 0.6) * body)


def _streak(canvas: _Canvas, rng: np.random.Generator, noise: Floats) -> None:
    grounded = rng.random() < 0.5
    start = canvas.free_place(rng, *((-0.02, 0.05) if grounded else (0.15, np.inf)))
    toward = CAMERAS[rng.integers(len(CAMERAS))] - start
    length = min(_log_uniform(rng, 0.4, 1.2), 0.8 * float(np.linalg.norm(toward)))
    end = start + toward / np.linalg.norm(toward) * length
    radius = _log_uniform(rng, 0.03, 0.07)
    window = canvas.window((start + end) / 2, length / 2 + 3 * radius + 0.1)
    distance = sd.capsule(canvas.positions[window], start, end, radius) - 0.3 * radius * noise[window]
    depth = -np.log1p(-rng.uniform(0.3, 0.85))
    canvas.add("streak", window, depth * sigmoid(-distance / (0.4 * canvas.pitch)))


def add_ghosts(
    rng: np.random.Generator, positions: Floats, distance: Floats, pitch: float
) -> tuple[Floats, NDArray[np.int8]]:
    """Draw every ghost of ``COUNTS``.

    Args:
        rng: decides places, shapes and densities; nothing else does.
        positions: cell centres ``(X, Y, Z, 3)``, metres.
        distance: signed distance to the true solids ``(X, Y, Z)``, metres.
        pitch: side of a cell, metres.

    Returns:
        Ghost density ``(X, Y, Z)`` per metre, and kind ``(X, Y, Z)`` int8: index into ``KINDS``, -1 for none.
    """
    canvas = _Canvas(positions, distance, pitch)
    fine, coarse = smooth_noise(rng, distance.shape, 2.5), smooth_noise(rng, distance.shape, 6.0)
    for _ in range(COUNTS["fog"]):
        _fog(canvas, rng, coarse)
    for _ in range(COUNTS["faint"]):
        _blob(canvas, rng, coarse, "faint", 0.12, 0.32)
    for _ in range(COUNTS["detached"]):
        _blob(canvas, rng, fine, "detached", 0.05, 0.28)
    for _ in range(COUNTS["touching"]):
        _blob(canvas, rng, fine, "touching", 0.07, 0.20)
    for _ in range(COUNTS["streak"]):
        _streak(canvas, rng, fine)
    return canvas.optical_depth / np.float32(pitch), canvas.kind
