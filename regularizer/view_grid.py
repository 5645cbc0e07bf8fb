"""Who sees what, settled a cell at a time: most of a scene is seen by enough fixed cameras, or by none, cell by cell.

A cell wholly inside a frustum is seen by that camera, one wholly beyond a side of it is not. With distortion, and all
the more with a fisheye, a frustum's sides are bent: each is put between two flat ones (the rectangles inside and about
the undistorted image, ``core/visibility/rectangles.py``).
Cells in which cameras disagree are cut in eight, twice over; points in what is open then are held against the flat
sides themselves, and the few that lie between the inner and the outer one are left to the exact test,
:meth:`Cameras.sees`. Counting up to one view at 32,768 points with 100 cameras takes .3 ms (.6 ms with distortion),
up to 50 views 33 ms (57 ms), where projecting every point with :meth:`Cameras.project` takes 180 to 355 ms (one core).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from ..core.cameras import Cameras
from ..core.visibility.rectangles import image_rectangles as image_rectangles
from ..core.visibility.rectangles import side_normals

COARSEST, LEVELS = 8, 3  # cells along an axis at first, and in how many sizes: down to 32 along it
CHUNK = 16384  # cells looked at together
GROUP = 128  # cameras asked together: what enough of them see is not held against the others
SLACK = 1e-5  # of the distances involved: float32 rounds
PAIRS = 1 << 17  # of a camera and a point, held against the lens itself together
OPEN = -1
FloatArray = NDArray[np.float64]


def _planes(cameras: Cameras, rectangles: FloatArray) -> NDArray[np.float32]:
    """``(4, N, 4)``: unit normal and offset of each side; a point ``(p, 1)`` is within it if the product is >= 0."""
    normals = side_normals(cameras, rectangles).swapaxes(0, 1)  # an unbounded side is 0: 0 >= 0
    normals = normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    offsets = -np.einsum("sna,na->sn", normals, cameras.origins)
    return np.concatenate([normals, offsets[..., None]], axis=-1).astype(np.float32)


def _within(
    planes: NDArray[np.float32], centers: FloatArray, half: FloatArray | float, slack: np.float32
) -> NDArray[np.bool_]:
    """On the inner side of all four planes ``(4, N, 4)`` by ``slack`` and the extent of a box; ``(N, M)``."""
    places = np.concatenate([centers.T, np.ones((1, len(centers)))]).astype(np.float32)
    extent, sign = np.broadcast_to(half, 3).astype(np.float32), np.sign(slack)
    bounds = sign * (np.abs(planes[:, :, :3]) @ extent) + slack
    product = np.empty((planes.shape[1], len(centers)), dtype=np.float32)
    within, beyond = np.ones(product.shape, dtype=bool), np.empty(product.shape, dtype=bool)
    for side, bound in zip(planes, bounds):
        np.matmul(side, places, out=product)
        within &= np.greater_equal(product, bound[:, None], out=beyond)
    return within


class ViewGrid:
    """A box cut into 32^3 cells; each holds the views of all its points, up to ``min_views``, or ``OPEN``.

    Args:
        cameras: fixed.
        aabb: ``(2, 3)``.
        min_views: where counting stops.
        levels: sizes of cells: 1 to 4 give 8, 16, 32 or 64 along a side.
    """

    def __init__(self, cameras: Cameras, aabb: FloatArray, *, min_views: int, levels: int = LEVELS) -> None:
        self._cameras, self._levels = cameras, levels
        self.aabb, self.min_views = np.asarray(aabb, dtype=np.float64), min_views
        sure, possible = image_rectangles(cameras)
        reliable = np.asarray(np.isfinite(sure).all(axis=1))
        inner, outer = _planes(cameras, sure), _planes(cameras, possible)
        inner[:, ~reliable] = [0.0, 0.0, 0.0, -1.0]  # nothing is surely within those
        count = -(-len(cameras) // GROUP)  # every so-many-th camera: neighbours see alike
        self._groups = [
            (g, inner[:, g], outer[:, g]) for g in (np.arange(first, len(cameras), count) for first in range(count))
        ]
        reach = np.abs(self.aabb).max() + np.abs(cameras.origins).max(initial=0.0)
        self._slack = np.float32(SLACK * reach)
        self.cells = np.full((COARSEST << (levels - 1),) * 3, OPEN, dtype=np.int16)
        open_ = np.stack(np.meshgrid(*[np.arange(COARSEST)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        for level in range(levels):
            open_ = self._settle(open_, level)
            children = np.stack(np.meshgrid(*[np.arange(2)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
            open_ = (2 * open_[:, None] + children).reshape(-1, 3)

    def _settle(self, cells: NDArray[np.int64], level: int) -> NDArray[np.int64]:
        """Write down those cells of a level whose points all have the same count; the others come back."""
        side = (self.aabb[1] - self.aabb[0]) / (COARSEST << level)
        left = []
        for start in range(0, len(cells), CHUNK):
            part = cells[start : start + CHUNK]
            centers = self.aabb[0] + (part + 0.5) * side
            least = self._surely(centers, side / 2)
            settled = least >= self.min_views
            few = np.flatnonzero(~settled)
            most = sum(
                (perhaps.sum(axis=0, dtype=np.int32) for _, perhaps in self._perhaps(centers[few], side / 2)), start=0
            )
            settled[few] = least[few] == most
            size = 1 << (self._levels - 1 - level)
            blocks = self.cells.reshape(*(n for _ in range(3) for n in (COARSEST << level, size)))
            x, y, z = part[settled].T
            blocks[x, :, y, :, z, :] = np.minimum(least[settled], self.min_views)[:, None, None, None]
            left.append(part[~settled])
        return np.concatenate(left) if left else cells[:0]

    def _surely(self, centers: FloatArray, half: FloatArray | float) -> NDArray[np.int64]:
        """How many cameras see every point of each box about ``centers (M, 3)``, up to ``min_views`` at least."""
        total, open_ = np.zeros(len(centers), dtype=np.int64), np.arange(len(centers))
        for _, inner, _ in self._groups:
            if open_.size == 0:
                break
            total[open_] += _within(inner, centers[open_], half, self._slack).sum(axis=0, dtype=np.int32)
            open_ = open_[total[open_] < self.min_views]
        return total

    def _perhaps(
        self, centers: FloatArray, half: FloatArray | float
    ) -> Iterator[tuple[NDArray[np.int64], NDArray[np.bool_]]]:
        """Groups of cameras, and which of a group may see some point of which box, ``(G, M)``."""
        for group, _, outer in self._groups:
            yield group, _within(outer, centers, half, -self._slack)

    def look_up(self, positions: FloatArray) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """What the cells of points ``(N, 3)`` say, ``OPEN`` outside the box; and which points are inside; ``(N,)``."""
        count = self.cells.shape[0]
        scale = count / (self.aabb[1] - self.aabb[0])
        inside, index = np.ones(len(positions), dtype=bool), np.zeros(len(positions), dtype=np.int32)
        with np.errstate(invalid="ignore", over="ignore"):
            for axis in range(3):
                local = ((positions[:, axis] - self.aabb[0, axis]) * scale[axis]).astype(np.float32)
                inside &= (local >= 0) & (local < count)
                index = index * count + local.astype(np.int32)
        index[~inside] = 0
        found = self.cells.reshape(-1)[index].astype(np.int64)
        found[~inside] = OPEN
        return found, inside

    def count(self, positions: FloatArray) -> NDArray[np.int64]:
        """``min(view count, min_views)`` of points ``(N, 3)``, ``OPEN`` outside the box; ``(N,)``."""
        found, inside = self.look_up(positions)
        left = np.flatnonzero((found == OPEN) & inside)
        for start in range(0, len(left), CHUNK):
            part = left[start : start + CHUNK]
            total = self._surely(positions[part], 0.0)
            unsure = np.flatnonzero(total < self.min_views)
            total[unsure] = 0  # counted anew, by the exact test
            for group, perhaps in self._perhaps(positions[part[unsure]], 0.0):
                camera, point = np.nonzero(perhaps)
                for first in range(0, len(camera), PAIRS):
                    row = unsure[point[first : first + PAIRS]]
                    seen = self._cameras.sees(group[camera[first : first + PAIRS]], positions[part[row]])
                    total += np.bincount(row[seen], minlength=len(part))
            found[part] = np.minimum(total, self.min_views)
        return found
