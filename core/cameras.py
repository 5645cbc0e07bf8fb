"""Cameras as nerfstudio's ``transforms.json`` has them.

OpenGL camera-to-world (+X right, +Y up, looking along -Z), pixel centres at +0.5, OPENCV distortion
``(k1, k2, k3, k4, p1, p2)``. numpy throughout; the counting function takes tensors too.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .arrays import is_tensor, to_numpy
from .errors import InvalidArgument

FloatArray = NDArray[np.float64]

FEW_CAMERAS, FEW_POINTS = 48, 6  # looked at, and along each axis of a box, where a glance is enough
LEAST_SEEN, FARTHEST = 0.1, 8.0  # cameras of a scene see more of its box, and stand nearer to it (in diagonals)


def distort(x: FloatArray, y: FloatArray, k: FloatArray) -> tuple[FloatArray, FloatArray]:
    """OPENCV distortion of normalised image coordinates (x right, y down); ``k`` is ``(6,)``."""
    k1, k2, k3, k4, p1, p2 = k
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
    return (
        x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
        y * radial + 2.0 * p2 * x * y + p1 * (r2 + 2.0 * y * y),
    )


def undistort(u: FloatArray, v: FloatArray, k: FloatArray, *, iterations: int = 12) -> tuple[FloatArray, FloatArray]:
    """Inverse of :func:`distort` by fixed-point iteration (error < 1e-9 for phone lenses)."""
    if not k.any():
        return u, v
    x, y = u.copy(), v.copy()
    for _ in range(iterations):
        du, dv = distort(x, y, k)
        x, y = x + (u - du), y + (v - dv)
    return x, y


def largest_radius(k: FloatArray) -> float:
    """Radius (normalised) up to which the radial polynomial is monotonic: beyond it, points fold back in."""
    if not k[:4].any():
        return np.inf
    coefficients = [9.0 * k[3], 0.0, 7.0 * k[2], 0.0, 5.0 * k[1], 0.0, 3.0 * k[0], 0.0, 1.0]
    roots = np.roots(np.trim_zeros(coefficients, "f"))
    real = roots[np.abs(roots.imag) < 1e-9].real
    positive = real[real > 0]
    return float(positive.min()) if positive.size else np.inf


@dataclass(frozen=True)
class Cameras:
    """``N`` cameras.

    Attributes:
        camera_to_world: ``(N, 3, 4)``, OpenGL, scene units.
        intrinsics: ``(N, 4)`` fx, fy, cx, cy in pixels.
        width, height: image size in pixels, the same for all.
        distortion: ``(N, 6)`` k1, k2, k3, k4, p1, p2.

    Example:
        >>> poses = look_at(np.array([[2.0, 0.0, 0.0], [0.0, 2.0, 0.0]]), np.zeros((2, 3)))
        >>> cameras = Cameras.create(poses, np.array([10.0, 10.0, 8.0, 6.0]), width=16, height=12)
        >>> cameras.view_count(np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]])).tolist()  # behind the first, not the other
        [2, 0]
    """

    camera_to_world: FloatArray
    intrinsics: FloatArray
    width: int
    height: int
    distortion: FloatArray

    @classmethod
    def create(
        cls,
        camera_to_world: NDArray[Any],
        intrinsics: NDArray[Any],
        width: int,
        height: int,
        distortion: NDArray[Any] | None = None,
    ) -> Cameras:
        """Validate and broadcast: ``(N, 3|4, 4)`` poses, ``(4,)`` or ``(N, 4)`` intrinsics, ``(6,)`` or ``(N, 6)``."""
        poses = np.asarray(to_numpy(camera_to_world), dtype=np.float64)
        if poses.ndim != 3 or poses.shape[1] not in (3, 4) or poses.shape[2] != 4:
            raise InvalidArgument(f"Cameras: camera_to_world must have shape (N, 3, 4) or (N, 4, 4), got {poses.shape}")
        if not np.isfinite(poses).all():
            raise InvalidArgument("Cameras: camera_to_world must be finite")
        rotation = poses[:, :3, :3]
        if not np.allclose(rotation @ rotation.swapaxes(1, 2), np.eye(3), atol=1e-3):
            raise InvalidArgument(
                "Cameras: camera_to_world must hold rotations (orthonormal to 1e-3); undo any scaling first"
            )
        count = len(poses)
        lens = np.broadcast_to(np.asarray(to_numpy(intrinsics), dtype=np.float64), (count, 4))
        if not (np.isfinite(lens).all() and (lens[:, :2] > 0).all()):
            raise InvalidArgument("Cameras: intrinsics fx, fy, cx, cy must be finite with fx, fy > 0")
        if width < 1 or height < 1:
            raise InvalidArgument(f"Cameras: width and height must be >= 1, got {width} x {height}")
        bend = np.zeros(6) if distortion is None else np.asarray(to_numpy(distortion), dtype=np.float64)
        return cls(poses[:, :3].copy(), lens.copy(), int(width), int(height), np.broadcast_to(bend, (count, 6)).copy())

    def __len__(self) -> int:
        return len(self.camera_to_world)

    @property
    def origins(self) -> FloatArray:
        """``(N, 3)`` camera centres."""
        return self.camera_to_world[:, :, 3]

    def select(self, indices: Any) -> Cameras:
        """The cameras at ``indices`` (anything numpy indexes with, keeping the axis)."""
        index = np.atleast_1d(np.arange(len(self))[indices])
        return Cameras(
            self.camera_to_world[index], self.intrinsics[index], self.width, self.height, self.distortion[index]
        )

    def resized(self, factor: float) -> Cameras:
        """The same cameras for images of ``factor`` times the size (rounded to whole pixels)."""
        width, height = max(1, round(self.width * factor)), max(1, round(self.height * factor))
        scale = np.array([width / self.width, height / self.height] * 2)
        return Cameras(self.camera_to_world, self.intrinsics * scale, width, height, self.distortion)

    def rays(self, index: int, pixels: NDArray[Any] | None = None) -> tuple[FloatArray, FloatArray]:
        """Origins and unit directions through pixel centres.

        Args:
            index: which camera.
            pixels: ``(..., 2)`` column, row in pixels (the centre of the first pixel is 0.5, 0.5);
                None for the whole image, shape ``(height, width, 2)``.

        Returns:
            origins ``(..., 3)``, directions ``(..., 3)``.
        """
        if pixels is None:
            columns, rows = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5)
            pixels = np.stack([columns, rows], axis=-1)
        fx, fy, cx, cy = self.intrinsics[index]
        x, y = undistort((pixels[..., 0] - cx) / fx, (pixels[..., 1] - cy) / fy, self.distortion[index])
        local = np.stack([x, -y, -np.ones_like(x)], axis=-1)
        world = local @ self.camera_to_world[index, :, :3].T
        world /= np.linalg.norm(world, axis=-1, keepdims=True)
        return np.broadcast_to(self.origins[index], world.shape).copy(), world

    def project(self, index: int, positions: NDArray[Any]) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
        """World ``(..., 3)`` to pixels ``(..., 2)``, depth along the optical axis ``(...)``, and whether it is in view.

        In view: depth > 0, inside the image, and not folded back by the distortion polynomial.
        """
        local = (np.asarray(positions, dtype=np.float64) - self.origins[index]) @ self.camera_to_world[index, :, :3]
        bend = self.distortion[index]
        column, row, depth, visible = self._project(local, self.intrinsics[index], bend, largest_radius(bend))
        return np.stack([column, row], axis=-1), depth, visible

    def sees(self, indices: NDArray[np.integer], positions: NDArray[Any]) -> NDArray[np.bool_]:
        """Whether camera ``indices[k]`` has ``positions[k]`` in view, by the rule of :meth:`project`: ``(K,)``."""
        points, poses = np.asarray(positions, dtype=np.float64), self.camera_to_world[indices]
        local = np.einsum("ka,kab->kb", points - poses[:, :, 3], poses[:, :, :3])
        lenses, which = np.unique(self.distortion, axis=0, return_inverse=True)
        radius = np.array([largest_radius(bend) for bend in lenses])[which.reshape(-1)][indices]
        return self._project(local, self.intrinsics[indices].T, self.distortion[indices].T, radius)[-1]

    def _project(
        self, local: FloatArray, intrinsics: FloatArray, distortion: FloatArray, radius: FloatArray | float
    ) -> tuple[FloatArray, FloatArray, FloatArray, NDArray[np.bool_]]:
        """Points in a camera's axes ``(..., 3)`` to columns, rows, depths and whether they are in view, each ``(...)``.

        ``intrinsics (4,)``, ``distortion (6,)`` and ``radius`` are those of one camera, or have a last axis of one
        camera a point. Every projection goes through here but the counting of views, which needs no pixels: there a
        frustum is four planes (``core/visibility/view_counts.py``, ``regularizer/view_grid.py``).
        """
        depth = -local[..., 2]
        front = depth > 0
        safe = np.where(front, depth, 1.0)
        x, y = local[..., 0] / safe, -local[..., 1] / safe
        front &= x * x + y * y < radius**2
        x, y = np.where(front, x, 0.0), np.where(front, y, 0.0)
        u, v = distort(x, y, distortion)
        fx, fy, cx, cy = intrinsics
        column, row = u * fx + cx, v * fy + cy
        visible = front & (column >= 0) & (column <= self.width) & (row >= 0) & (row <= self.height)
        return column, row, depth, visible

    def view_count(
        self, positions: Any, *, depth_maps: NDArray[Any] | None = None, tolerance: float = 0.05
    ) -> NDArray[np.int64]:
        """How many cameras see each of ``positions (..., 3)``: the paper's frustum check, ``sum_j v_ij``.

        Args:
            positions: numpy array or tensor, scene units. No gradient.
            depth_maps: ``(N, height, width)`` depth along the optical axis, inf for "nothing": makes the
                count occlusion-aware (a point counts if it lies at most ``tolerance`` of the depth behind).
            tolerance: relative depth tolerance.
        """
        points = to_numpy(positions) if is_tensor(positions) else np.asarray(positions)
        counts = np.zeros(points.shape[:-1], dtype=np.int64)
        for index in range(len(self)):
            pixels, depth, visible = self.project(index, points)
            if depth_maps is not None:
                column = np.clip(np.floor(pixels[..., 0]), 0, self.width - 1).astype(np.int64)
                row = np.clip(np.floor(pixels[..., 1]), 0, self.height - 1).astype(np.int64)
                visible &= depth <= depth_maps[index][row, column] * (1.0 + tolerance)
            counts += visible
        return counts


def look_at(origins: FloatArray, targets: FloatArray) -> FloatArray:
    """OpenGL camera-to-world ``(N, 3, 4)`` for cameras at ``origins (N, 3)`` facing ``targets (N, 3)``, z up.

    A camera that looks straight up or down has its right along +X.

    Example:
        >>> look_at(np.array([[2.0, 0.0, 0.0]]), np.zeros((1, 3)))[0, :, 2].tolist()  # backwards
        [1.0, 0.0, 0.0]
    """
    back = origins - targets
    back /= np.linalg.norm(back, axis=1, keepdims=True)
    right = np.cross(np.array([0.0, 0.0, 1.0]), back)
    length = np.linalg.norm(right, axis=1, keepdims=True)
    right = np.where(length < 1e-9, np.array([1.0, 0.0, 0.0]), right / np.maximum(length, 1e-9))
    return np.stack([right, np.cross(back, right), back, origins], axis=-1)


def warn_if_turned_away(cameras: Cameras | None, aabb: FloatArray, *, caller: str) -> None:
    """Warn if the cameras see next to nothing of a box, and would see it if their y and z axes were turned round.

    OpenCV's poses (+Y down, looking along +Z) given as OpenGL's look exactly away from what they photographed. Cameras
    that look outwards from the middle see as much either way: of them nothing can be said.

    Args:
        cameras: None for nothing to say.
        aabb: ``(2, 3)``, where the scene is.
        caller: for the text.
    """
    if cameras is None or len(cameras) == 0:
        return
    here, there, _ = _glance(cameras, aabb)
    if _looks_away(here, there):
        warnings.warn(
            f"{caller}: the cameras have {here:.1%} of the aabb in view, and would have {there:.1%} with their y and z "
            "axes turned round: poses must be OpenGL's (+Y up, looking along -Z), not OpenCV's",
            stacklevel=3,
        )


def warn_if_elsewhere(cameras: Cameras | None, aabb: FloatArray, *, caller: str) -> None:
    """Warn if the cameras do not seem to belong to a box: they see hardly any of it, or stand very far from it.

    Cameras of another world than the scene's (another unit, origin or orientation) do. Where
    :func:`warn_if_turned_away` has the reason, nothing is said.

    Args:
        cameras: None for nothing to say.
        aabb: ``(2, 3)``, where the scene is.
        caller: for the text.
    """
    if cameras is None or len(cameras) == 0:
        return
    here, there, seen = _glance(cameras, aabb)
    nearest = np.clip(cameras.origins, aabb[0], aabb[1])
    away = np.linalg.norm(cameras.origins - nearest, axis=1) / max(float(np.linalg.norm(aabb[1] - aabb[0])), 1e-300)
    far = float(np.median(away))
    if _looks_away(here, there) or (seen >= LEAST_SEEN and far <= FARTHEST):
        return
    warnings.warn(
        f"{caller}: the cameras do not fit the scene: together they have {seen:.0%} of its aabb in view, and half of "
        f"them stand more than {far:.1f} of its diagonals away; they must be in the scene's own world (what nerfstudio "
        "trained or exported is moved by its dataparser_transforms.json)",
        stacklevel=3,
    )


def _looks_away(here: float, there: float) -> bool:
    """Whether the share of a box in view, as the cameras are and turned round, says that they are turned round."""
    return here < 0.1 * there and there > 0.02


def _glance(cameras: Cameras, aabb: FloatArray) -> tuple[float, float, float]:
    """Mean share of a box that a camera sees, that share with y and z turned round, and the share that any sees."""
    some = cameras.select(np.unique(np.linspace(0, len(cameras) - 1, FEW_CAMERAS).round().astype(int)))
    along = (np.arange(FEW_POINTS) + 0.5) / FEW_POINTS
    lattice = aabb[0] + np.stack(np.meshgrid(along, along, along, indexing="ij"), axis=-1) * (aabb[1] - aabb[0])
    turned = some.camera_to_world * np.array([1.0, -1.0, -1.0, 1.0])
    other = Cameras(turned, some.intrinsics, some.width, some.height, some.distortion)
    counts, reverse = some.view_count(lattice), other.view_count(lattice)
    return float(counts.mean()) / len(some), float(reverse.mean()) / len(some), float((counts > 0).mean())
