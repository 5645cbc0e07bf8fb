"""Three-valued labels of a photographed scene of known geometry, and how bad a field is by them.

surface  within three quarters of a field cell of a surface that some training photo sees, and what is
         opaque up to four cells behind such a surface, as long as some light gets out from there: a field
         spreads a surface over several of its cells, and what lies behind the front is part of what makes it
         opaque, but not what lies behind all that (nobody sees whether it is there)
free     more than one and a half cells outside every solid; and what is opaque there is a ghost if a viewer can look
         at it: a training photo, or one of another sweep through the scene
ignore   the rest of solids and walls, surfaces that no photo sees, opacity that no viewer sees, the band between,
         outside the box
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ...core.aabb import contains
from ...core.cameras import Cameras
from ...core.occupancy import DEFAULT_OPACITY_THRESHOLD, FREE_LABEL, IGNORE_LABEL, SURFACE_LABEL, opacity_from_signed

HIDDEN = 0.05  # share of light from a place that no training camera gets more of
Observers = tuple[Cameras, NDArray[np.float64]]
SURFACE_BAND, FREE_BAND, BEHIND_BAND = 0.75, 1.5, 4.0  # in field cells


class Geometry(Protocol):
    """A scene of known shape."""

    def signed_distance(self, positions: NDArray[Any]) -> NDArray[Any]:
        """``positions (..., 3)`` to ``(...)``: negative inside solids and walls."""


class Photographed(Protocol):
    """A scene and what its photos saw; :class:`unghost.scenes.generator.PhotographedScene` is one."""

    @property
    def scene(self) -> Geometry:
        """The truth."""

    @property
    def cameras(self) -> Cameras:
        """As a field is told."""

    @property
    def true_cameras(self) -> Cameras:
        """Where the photos were really taken."""

    @property
    def depth_maps(self) -> NDArray[np.float64]:
        """``(N, H, W)`` depth along the optical axis, inf for sky."""


class Labeller(Protocol):
    """Who says what is true: :class:`Truth`, or whatever knows better than the field that cubes are cut from."""

    @property
    def cameras(self) -> Cameras:
        """Those of the training photos, as the field was told."""

    def labels(
        self, positions: NDArray[np.float64], field_pitch: float, opaque: NDArray[np.bool_], hidden: NDArray[np.bool_]
    ) -> NDArray[np.uint8]:
        """Three-valued labels ``(...)`` of world ``positions (..., 3)``.

        ``opaque`` and ``hidden``, both ``(...)``, are of the field: whether a place is opaque in it, and whether no
        training camera gets any light from there.
        """


class Truth:
    """The labels of a photographed scene; a coarse grid of exact distances settles most points.

    A signed distance changes by no more than one goes, so that a node far from any surface speaks for its cell.

    Args:
        photographed: the scene.
        aabb: ``(2, 3)``, outside of which nothing counts.
        observers: cameras of another sweep and their true depth maps.
        nodes: of the coarse grid, along an axis.
    """

    def __init__(
        self,
        photographed: Photographed,
        aabb: NDArray[np.float64],
        *,
        observers: Observers | None = None,
        nodes: int = 64,
    ) -> None:
        self.photographed, self.aabb = photographed, aabb
        self.observers: list[Observers] = [(photographed.true_cameras, photographed.depth_maps)]
        self.observers += [] if observers is None else [observers]
        axes = [np.linspace(aabb[0, axis], aabb[1, axis], nodes) for axis in range(3)]
        self._coarse = photographed.scene.signed_distance(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1))
        self._cell = (aabb[1] - aabb[0]) / (nodes - 1)

    @property
    def cameras(self) -> Cameras:
        """Those of the photos, as a field is told."""
        return self.photographed.cameras

    def distances(self, points: NDArray[np.float64], margin: float | NDArray[np.float64]) -> NDArray[np.float64]:
        """Signed distance of ``points (N, 3)``: exact where it is at most ``margin``, else some value beyond it.

        ``margin`` is one number or one for each point ``(N,)``.
        """
        index = np.rint((points - self.aabb[0]) / self._cell).astype(np.int64)
        index = np.clip(index, 0, np.array(self._coarse.shape) - 1)
        distance: NDArray[np.float64] = self._coarse[index[:, 0], index[:, 1], index[:, 2]]
        slack = np.linalg.norm(points - (self.aabb[0] + index * self._cell), axis=1)
        close = np.flatnonzero(np.abs(distance) - slack <= margin)
        distance[close] = self.photographed.scene.signed_distance(points[close])
        return distance

    def labels(
        self, positions: NDArray[np.float64], field_pitch: float, opaque: NDArray[np.bool_], hidden: NDArray[np.bool_]
    ) -> NDArray[np.uint8]:
        """Three-valued labels ``(...)`` of world ``positions (..., 3)``; see :class:`Labeller`."""
        labels = np.full(positions.shape[:-1], IGNORE_LABEL, dtype=np.uint8)
        inside = contains(self.aabb, positions)
        flat = positions[inside]
        distance = self.distances(flat, np.where(opaque[inside], BEHIND_BAND, FREE_BAND) * field_pitch)
        found = np.full(len(flat), IGNORE_LABEL, dtype=np.uint8)
        found[distance > FREE_BAND * field_pitch] = FREE_LABEL
        ghosts = np.flatnonzero(opaque[inside] & (found == FREE_LABEL))
        found[ghosts[~self._observed(flat[ghosts])]] = IGNORE_LABEL
        near = np.abs(distance) <= SURFACE_BAND * field_pitch
        behind = (opaque & ~hidden)[inside] & (distance < 0) & (distance >= -BEHIND_BAND * field_pitch) & ~near
        for band, reach in ((near, 2.0), (behind, 2.0 + BEHIND_BAND)):
            chosen = np.flatnonzero(band)
            found[chosen[self._seen(flat[chosen], reach * field_pitch)]] = SURFACE_LABEL
        labels[inside] = found
        return labels

    def _observed(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether some viewer has ``points (N, 3)`` in the frustum and before the true surface."""
        views = sum(cameras.view_count(points, depth_maps=depth, tolerance=0.0) for cameras, depth in self.observers)
        return np.asarray(views > 0)

    def _seen(self, points: NDArray[np.float64], reach: float) -> NDArray[np.bool_]:
        """Whether some photo shows ``points (N, 3)``, or a surface at most ``reach`` in front of them."""
        relaxed = self.photographed.depth_maps + reach
        seen: NDArray[np.bool_] = (
            self.photographed.true_cameras.view_count(points, depth_maps=relaxed, tolerance=0.02) > 0
        )
        return seen


def severity_of(inputs: NDArray[np.float32], labels: NDArray[np.uint8]) -> NDArray[np.float32]:
    """One minus the IoU of opaque input and surface label over voxels that count: ``(N,)`` in [0, 1]."""
    valid = labels != IGNORE_LABEL
    opaque = (opacity_from_signed(inputs) > DEFAULT_OPACITY_THRESHOLD) & valid
    surface = labels == SURFACE_LABEL
    union = (opaque | surface).sum(axis=(1, 2, 3))
    both = (opaque & surface).sum(axis=(1, 2, 3))
    return (1.0 - np.where(union > 0, both / np.maximum(union, 1), 1.0)).astype(np.float32)


def check_fit(
    inputs: NDArray[np.float32], labels: NDArray[np.uint8], *, fewest_opaque: float, most_ghosts: float
) -> None:
    """Raise RuntimeError if a field holds too little of the surface, or too many ghosts: its fit has failed.

    Args:
        inputs, labels: ``(N, R, R, R)``, of all of its cubes.
        fewest_opaque: share of the surface that must be opaque.
        most_ghosts: share of what is opaque (and counts) that may be ghosts.
    """
    opaque = opacity_from_signed(inputs) > DEFAULT_OPACITY_THRESHOLD
    surface = labels == SURFACE_LABEL
    true, ghosts = int((opaque & surface).sum()), int((opaque & (labels == FREE_LABEL)).sum())
    if true < fewest_opaque * surface.sum():
        raise RuntimeError(f"failed fit: {true / surface.sum():.0%} of the surface is opaque")
    if ghosts > most_ghosts * (true + ghosts):
        raise RuntimeError(f"failed fit: {ghosts / (true + ghosts):.0%} of what is opaque are ghosts")
