"""Cameras as nerfstudio's ``transforms.json`` has them.

OpenGL camera-to-world (+X right, +Y up, looking along -Z), pixel centres at +0.5, OPENCV distortion
``(k1, k2, k3, k4, p1, p2)`` or an OPENCV_FISHEYE lens ``(k1, k2, k3, k4, 0, 0)``, a size and a lens for each camera.
numpy throughout; the counting function takes tensors too.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .arrays import is_tensor, to_numpy
from .errors import InvalidArgument
from .lenses import distort as distort
from .lenses import fisheye_angle, fisheye_radius, widest_angle
from .lenses import largest_radius as largest_radius
from .lenses import undistort as undistort

FloatArray = NDArray[np.float64]

FEW_CAMERAS, FEW_POINTS = 48, 6  # looked at, and along each axis of a box, where a glance is enough
LEAST_SEEN, FARTHEST = 0.1, 8.0  # cameras of a scene see more of its box, and stand nearer to it (in diagonals)


@dataclass(frozen=True, init=False)
class Cameras:
    """``N`` cameras.

    Attributes:
        camera_to_world: ``(N, 3, 4)``, OpenGL, scene units.
        intrinsics: ``(N, 4)`` fx, fy, cx, cy in pixels.
        sizes: ``(N, 2)`` width, height of each camera's image in pixels; where all are alike, ``width`` and
            ``height`` are these as numbers.
        distortion: ``(N, 6)`` k1, k2, k3, k4, p1, p2.
        fisheye: ``(N,)`` bool: OPENCV_FISHEYE (``core/lenses.py``), with p1 = p2 = 0; False: OPENCV.

    Example:
        >>> poses = look_at(np.array([[2.0, 0.0, 0.0], [0.0, 2.0, 0.0]]), np.zeros((2, 3)))
        >>> cameras = Cameras.create(poses, np.array([10.0, 10.0, 8.0, 6.0]), width=16, height=12)
        >>> cameras.view_count(np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]])).tolist()  # behind the first, not the other
        [2, 0]
        >>> mixed = Cameras.create(poses, np.array([10.0, 10.0, 6.0, 6.0]), width=[16, 12], height=[12, 16])
        >>> mixed.size(1), [group.tolist() for group in mixed.by_size()]
        ((12, 16), [[0], [1]])
    """

    camera_to_world: FloatArray
    intrinsics: FloatArray
    sizes: NDArray[np.int64]
    distortion: FloatArray
    fisheye: NDArray[np.bool_]
    _common: tuple[int, int] | None = field(init=False, repr=False, compare=False)  # the size, where all have one

    def __init__(
        self,
        camera_to_world: FloatArray,
        intrinsics: FloatArray,
        width: int | NDArray[np.integer[Any]] | None = None,
        height: int | NDArray[np.integer[Any]] | None = None,
        distortion: FloatArray | None = None,
        fisheye: NDArray[np.bool_] | None = None,
        *,
        sizes: NDArray[np.int64] | None = None,
    ) -> None:
        """Not validated: see :meth:`create`. ``sizes`` is for :func:`dataclasses.replace`."""
        count = len(camera_to_world)
        if sizes is not None:
            width, height = sizes[:, 0] if width is None else width, sizes[:, 1] if height is None else height
        if width is None or height is None:
            raise InvalidArgument("Cameras: width and height must be given")
        sides = [np.broadcast_to(np.asarray(side, dtype=np.int64), count) for side in (width, height)]
        sizes = np.stack(sides, axis=1)
        # Of no cameras at all, a size that was given as two numbers is remembered.
        common = sizes[0] if count and (sizes == sizes[:1]).all() else None
        if count == 0 and np.ndim(width) == np.ndim(height) == 0:
            common = np.array([width, height])
        state = {
            "camera_to_world": camera_to_world,
            "intrinsics": intrinsics,
            "sizes": sizes,
            "distortion": np.zeros((count, 6)) if distortion is None else distortion,
            "fisheye": np.zeros(count, dtype=bool) if fisheye is None else fisheye,
            "_common": None if common is None else (int(common[0]), int(common[1])),
        }
        for name, value in state.items():
            object.__setattr__(self, name, value)

    @classmethod
    def create(
        cls,
        camera_to_world: NDArray[Any],
        intrinsics: NDArray[Any],
        width: int | Sequence[int] | NDArray[Any],
        height: int | Sequence[int] | NDArray[Any],
        distortion: NDArray[Any] | None = None,
        fisheye: bool | Sequence[bool] | NDArray[np.bool_] = False,
    ) -> Cameras:
        """Validate and broadcast.

        Args:
            camera_to_world: ``(N, 3, 4)`` or ``(N, 4, 4)``.
            intrinsics: ``(4,)`` or ``(N, 4)``, fx, fy, cx, cy in pixels.
            width, height: in pixels, >= 1; a number, or ``(N,)``.
            distortion: ``(6,)`` or ``(N, 6)``; None for none.
            fisheye: for all, or ``(N,)``: the lens is OPENCV_FISHEYE, and has no p1 and p2.

        Raises:
            ValueError: shapes, values that are not finite, poses that are no rigid motions, a fisheye with p1 or p2.
        """
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
        sides = [np.asarray(to_numpy(side)) for side in (width, height)]
        if any(side.shape not in ((), (count,)) for side in sides):
            shapes = " and ".join(str(side.shape) for side in sides)
            raise InvalidArgument(f"Cameras: width and height must be numbers or have shape ({count},), got {shapes}")
        if not all((side >= 1).all() and (side < np.inf).all() for side in sides):
            raise InvalidArgument(f"Cameras: width and height must be >= 1, got {width} x {height}")
        wide, high = (side.astype(np.int64) for side in sides)
        bend = np.zeros(6) if distortion is None else np.asarray(to_numpy(distortion), dtype=np.float64)
        bend = np.broadcast_to(bend, (count, 6)).copy()
        round_ = np.broadcast_to(np.asarray(to_numpy(fisheye), dtype=bool), (count,)).copy()
        if bend[round_, 4:].any():
            raise InvalidArgument("Cameras: a fisheye (OPENCV_FISHEYE) must have p1 = p2 = 0")
        if wide.ndim == high.ndim == 0:
            return cls(poses[:, :3].copy(), lens.copy(), int(wide), int(high), bend, round_)
        return cls(poses[:, :3].copy(), lens.copy(), wide, high, bend, round_)

    def __len__(self) -> int:
        return len(self.camera_to_world)

    @property
    def width(self) -> int:
        """Width of every image in pixels.

        Raises:
            ValueError: the cameras differ in size: see :attr:`sizes`, :meth:`size` and :meth:`by_size`.
        """
        return self._one_size("width")[0]

    @property
    def height(self) -> int:
        """Height of every image in pixels; as :attr:`width`."""
        return self._one_size("height")[1]

    @property
    def same_size(self) -> bool:
        """Whether all images have one size, so that ``width`` and ``height`` can be had."""
        return self._common is not None

    def _one_size(self, name: str) -> tuple[int, int]:
        if self._common is None:
            told = ", ".join("{} x {}: {} cameras".format(*self.size(g[0]), len(g)) for g in self.by_size())
            raise InvalidArgument(
                f"Cameras.{name}: the cameras differ in size ({told or 'there are none'}); use one size at a time: "
                "cameras.select(group) for group in cameras.by_size()"
            )
        return self._common

    def size(self, index: int | np.integer[Any]) -> tuple[int, int]:
        """Width and height of one camera's image in pixels."""
        return int(self.sizes[index, 0]), int(self.sizes[index, 1])

    def by_size(self) -> list[NDArray[np.int64]]:
        """Positions of the cameras of each size, the size that occurs first before the others."""
        _, first, which = np.unique(self.sizes, axis=0, return_index=True, return_inverse=True)
        return [np.flatnonzero(which.reshape(-1) == group) for group in np.argsort(first)]

    @property
    def canvas(self) -> tuple[int, int]:
        """Height and width that hold every image: those of arrays of views that differ in size.

        Such arrays hold each view in their upper left corner (:meth:`window`); what lies right of it and below is no
        part of it.
        """
        if self.same_size:
            return self.height, self.width
        width, height = self.sizes.max(axis=0, initial=0)
        return int(height), int(width)

    def window(self, index: int | np.integer[Any]) -> tuple[slice, slice]:
        """Rows and columns of one camera's image on the :attr:`canvas`."""
        width, height = self.size(index)
        return slice(0, height), slice(0, width)

    @property
    def shapes(self) -> list[tuple[int, int]]:
        """Height and width of each image."""
        return [(height, width) for width, height in self.sizes.tolist()]

    @property
    def flat_sided(self) -> NDArray[np.bool_]:
        """``(N,)`` bool: pinholes, whose field of view has four flat sides."""
        return ~(self.fisheye | self.distortion.any(axis=1))

    @property
    def origins(self) -> FloatArray:
        """``(N, 3)`` camera centres."""
        return self.camera_to_world[:, :, 3]

    def select(self, indices: Any) -> Cameras:
        """The cameras at ``indices`` (anything numpy indexes with, keeping the axis)."""
        index = np.atleast_1d(np.arange(len(self))[indices])
        width, height = (self.width, self.height) if self.same_size else self.sizes[index].T
        return Cameras(
            self.camera_to_world[index],
            self.intrinsics[index],
            width,
            height,
            self.distortion[index],
            self.fisheye[index],
        )

    def moved(self, camera_to_world: FloatArray) -> Cameras:
        """The same lenses at other poses ``(N, 3, 4)``, which are not checked."""
        width, height = (self.width, self.height) if self.same_size else self.sizes.T
        return Cameras(camera_to_world, self.intrinsics, width, height, self.distortion, self.fisheye)

    def resized(self, factor: float) -> Cameras:
        """The same cameras for images of ``factor`` times the size (rounded to whole pixels)."""
        if self.same_size:
            width, height = max(1, round(self.width * factor)), max(1, round(self.height * factor))
            scale = np.array([width / self.width, height / self.height] * 2)
            return Cameras(self.camera_to_world, self.intrinsics * scale, width, height, self.distortion, self.fisheye)
        sizes = np.maximum(1, np.rint(self.sizes * factor).astype(np.int64))
        scale = np.tile(sizes / self.sizes, 2)
        return Cameras(
            self.camera_to_world, self.intrinsics * scale, sizes[:, 0], sizes[:, 1], self.distortion, self.fisheye
        )

    def rays(self, index: int, pixels: NDArray[Any] | None = None) -> tuple[FloatArray, FloatArray]:
        """Origins and unit directions through pixel centres.

        A pixel of a fisheye beyond its widest angle (in a corner outside the image circle) shows nothing; its ray is
        that of the widest angle, which does not project back onto it.

        Args:
            index: which camera.
            pixels: ``(..., 2)`` column, row in pixels (the centre of the first pixel is 0.5, 0.5);
                None for the whole image, shape ``(height, width, 2)``.

        Returns:
            origins ``(..., 3)``, directions ``(..., 3)``.
        """
        if pixels is None:
            width, height = self.size(index)
            columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
            pixels = np.stack([columns, rows], axis=-1)
        fx, fy, cx, cy = self.intrinsics[index]
        u, v = (pixels[..., 0] - cx) / fx, (pixels[..., 1] - cy) / fy
        if self.fisheye[index]:
            local = _fisheye_directions(u, v, self.distortion[index])
        else:
            x, y = undistort(u, v, self.distortion[index])
            local = np.stack([x, -y, -np.ones_like(x)], axis=-1)
        world = local @ self.camera_to_world[index, :, :3].T
        world /= np.linalg.norm(world, axis=-1, keepdims=True)
        return np.broadcast_to(self.origins[index], world.shape).copy(), world

    def project(self, index: int, positions: NDArray[Any]) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
        """World ``(..., 3)`` to pixels ``(..., 2)``, depth along the optical axis ``(...)``, and whether it is in view.

        In view: depth > 0 (a fisheye may see beyond 90 degrees, where the depth is negative), inside the image, and
        not folded back by the distortion polynomial.
        """
        local = (np.asarray(positions, dtype=np.float64) - self.origins[index]) @ self.camera_to_world[index, :, :3]
        lens = self.intrinsics[index], self.distortion[index], self.sizes[index]
        if self.fisheye[index]:
            column, row, depth, visible = _project_fisheye(local, *lens, widest_angle(self.distortion[index]))
        else:
            column, row, depth, visible = _project(local, *lens, largest_radius(self.distortion[index]))
        return np.stack([column, row], axis=-1), depth, visible

    def sees(self, indices: NDArray[np.integer], positions: NDArray[Any]) -> NDArray[np.bool_]:
        """Whether camera ``indices[k]`` has ``positions[k]`` in view, by the rule of :meth:`project`: ``(K,)``."""
        points, poses = np.asarray(positions, dtype=np.float64), self.camera_to_world[indices]
        local = np.einsum("ka,kab->kb", points - poses[:, :, 3], poses[:, :, :3])
        lenses, which = np.unique(self.distortion, axis=0, return_inverse=True)
        radius = np.array([largest_radius(bend) for bend in lenses])[which.reshape(-1)][indices]
        sizes: Any = np.array([self.width, self.height]) if self.same_size else self.sizes[indices].T
        if not self.fisheye.any():
            return _project(local, self.intrinsics[indices].T, self.distortion[indices].T, sizes, radius)[-1]
        seen, round_ = np.zeros(len(local), dtype=bool), self.fisheye[indices]
        for chosen, project in ((~round_, _project), (round_, _project_fisheye)):
            part = indices[chosen]
            lens = self.intrinsics[part].T, self.distortion[part].T, self.sizes[part].T
            limit = radius[chosen] if project is _project else np.minimum(radius[chosen], np.pi)
            seen[chosen] = project(local[chosen], *lens, limit)[-1]
        return seen

    def view_count(
        self,
        positions: Any,
        *,
        depth_maps: NDArray[Any] | Sequence[NDArray[Any]] | None = None,
        tolerance: float = 0.05,
    ) -> NDArray[np.int64]:
        """How many cameras see each of ``positions (..., 3)``: the paper's frustum check, ``sum_j v_ij``.

        Args:
            positions: numpy array or tensor, scene units. No gradient.
            depth_maps: ``(N, height, width)``, or ``N`` maps ``(height, width)``: depth along the optical axis, inf for
                "nothing" (a fisheye's is negative beyond 90 degrees): makes the count occlusion-aware (a point counts
                if it lies at most ``tolerance`` of the depth behind).
            tolerance: relative depth tolerance.
        """
        points = to_numpy(positions) if is_tensor(positions) else np.asarray(positions)
        counts = np.zeros(points.shape[:-1], dtype=np.int64)
        for index in range(len(self)):
            pixels, depth, visible = self.project(index, points)
            if depth_maps is not None:
                width, height = self.size(index)
                column = np.clip(np.floor(pixels[..., 0]), 0, width - 1).astype(np.int64)
                row = np.clip(np.floor(pixels[..., 1]), 0, height - 1).astype(np.int64)
                limit = depth_maps[index][row, column]
                if self.fisheye[index]:  # along a ray beyond 90 degrees the depth falls
                    depth, limit = np.abs(depth), np.abs(limit)
                visible &= depth <= limit * (1.0 + tolerance)
            counts += visible
        return counts


def _project(
    local: FloatArray, intrinsics: FloatArray, distortion: FloatArray, size: Any, radius: FloatArray | float
) -> tuple[FloatArray, FloatArray, FloatArray, NDArray[np.bool_]]:
    """Points in a camera's axes ``(..., 3)`` to columns, rows, depths and whether they are in view, each ``(...)``.

    ``intrinsics (4,)``, ``distortion (6,)``, ``size (2,)`` and ``radius`` are those of one camera, or have a last axis
    of one camera a point. Every projection goes through here or through :func:`_project_fisheye` but the counting of
    views, which needs no pixels: there a frustum is four planes (``core/visibility/``, ``regularizer/view_grid.py``).
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
    visible = front & (column >= 0) & (column <= size[0]) & (row >= 0) & (row <= size[1])
    return column, row, depth, visible


def _project_fisheye(
    local: FloatArray, intrinsics: FloatArray, distortion: FloatArray, size: Any, widest: FloatArray | float
) -> tuple[FloatArray, FloatArray, FloatArray, NDArray[np.bool_]]:
    """:func:`_project` for OPENCV_FISHEYE; ``widest`` is the lens's :func:`~.lenses.widest_angle`."""
    x, y, depth = local[..., 0], -local[..., 1], -local[..., 2]
    across = np.hypot(x, y)
    angle = np.arctan2(across, depth)
    within = (angle < widest) & ((across > 0) | (depth > 0))  # the camera's own centre has no direction
    radius = fisheye_radius(np.where(within, angle, 0.0), distortion)
    stretch = np.where(across > 0, radius / np.where(across > 0, across, 1.0), 0.0)
    fx, fy, cx, cy = intrinsics
    column, row = x * stretch * fx + cx, y * stretch * fy + cy
    visible = within & (column >= 0) & (column <= size[0]) & (row >= 0) & (row <= size[1])
    return column, row, depth, visible


def _fisheye_directions(u: FloatArray, v: FloatArray, distortion: FloatArray) -> FloatArray:
    """Unit directions ``(..., 3)`` in a camera's axes of OPENCV_FISHEYE's image coordinates."""
    radius = np.hypot(u, v)
    angle = fisheye_angle(radius, distortion)
    stretch = np.where(radius > 0, np.sin(angle) / np.where(radius > 0, radius, 1.0), 0.0)
    return np.stack([u * stretch, -v * stretch, -np.cos(angle)], axis=-1)


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
    other = some.moved(turned)
    counts, reverse = some.view_count(lattice), other.view_count(lattice)
    return float(counts.mean()) / len(some), float(reverse.mean()) / len(some), float((counts > 0).mean())
