"""Which triangles may touch a box: a wide tree of bounding boxes over triangles sorted along a Morton curve."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

_WIDTH = 16  # children of a node
_BITS = 10  # of the Morton code, a coordinate


def morton_codes(points: Array) -> Array:
    """Position of each of ``points (N, 3)`` along a Z-order curve through their bounding box, ``(N,)`` int64."""
    low, high = points.min(axis=0), points.max(axis=0)
    cells = ((points - low) / np.where(high > low, high - low, 1.0) * (2**_BITS - 1)).astype(np.int64)
    codes = np.zeros(len(points), dtype=np.int64)
    for bit in range(_BITS):
        for axis in range(3):
            codes |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return codes


@dataclass(frozen=True)
class BoxTree:
    """Boxes within boxes, from one level of at most 16 down to the triangles' own.

    Attributes:
        rows: ``(F,)``, the triangle of each leaf.
        levels: ``(6, n)`` float32 each, the least x, y, z and the negated greatest ones, rounded outwards;
            node i holds nodes 16 i to 16 i + 15 of the next level.
    """

    rows: Array
    levels: tuple[Array, ...]

    @classmethod
    def build(cls, triangles: Array) -> BoxTree:
        """A tree over ``triangles (F >= 1, 3, 3)``."""
        lows, highs = triangles.min(axis=1), triangles.max(axis=1)
        rows = np.argsort(morton_codes((lows + highs) / 2), kind="stable")
        exact = np.concatenate([lows[rows], -highs[rows]], axis=1).T
        boxes = np.nextafter(exact.astype(np.float32), np.float32(-np.inf))
        levels = [boxes]
        while levels[0].shape[1] > _WIDTH:
            starts = np.arange(0, levels[0].shape[1], _WIDTH)
            levels.insert(0, np.minimum.reduceat(levels[0], starts, axis=1))
        return cls(rows, tuple(levels))

    def touching(self, lows: Array, highs: Array) -> tuple[Array, Array]:
        """Triangles whose bounding boxes touch boxes (a few that only come close may be among them).

        Args:
            lows, highs: ``(N, 3)``, corners of the boxes.

        Returns:
            ``query (M,)``, ascending, and ``triangle (M,)``: one entry a pair.
        """
        wanted = np.nextafter(np.concatenate([highs, -lows], axis=1).T.astype(np.float32), np.float32(np.inf))
        count = self.levels[0].shape[1]
        query, node = np.divmod(np.arange(len(lows) * count), count)
        for number, boxes in enumerate(self.levels):
            if number:
                query = np.repeat(query, _WIDTH)
                node = (node[:, None] * _WIDTH + np.arange(_WIDTH)).reshape(-1)
                real = node < boxes.shape[1]
                query, node = query[real], node[real]
            for side in range(6):
                kept = np.flatnonzero(boxes[side][node] <= wanted[side][query])
                query, node = query[kept], node[kept]
        return query, self.rows[node]
