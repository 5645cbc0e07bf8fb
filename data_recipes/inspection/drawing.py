"""Pictures of cubes: their voxels seen from one corner, lit from above, in a box that gives them depth.

One fixed, orthographic view: which voxels each pixel's ray passes is worked out once, so that a picture of
another cube is a few gathers. Opacities are composited as they are: a surface looks solid, fog like fog.
"""

from __future__ import annotations

import struct
import zlib
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...core.errors import InvalidArgument

Floats = NDArray[np.float32]
Image = NDArray[np.uint8]

SURFACE = (0.62, 0.68, 0.75)
GHOST = (0.98, 0.50, 0.12)
MISSING = (0.22, 0.52, 0.95)
UNJUDGED = (0.77, 0.71, 0.81)
PAPER = (1.0, 1.0, 1.0)

_EYE = np.array([0.78, -1.0, 0.74]) / np.linalg.norm([0.78, -1.0, 0.74])  # from the cube's centre
_SIDES = np.sign(_EYE).astype(int)  # the side of each axis that the eye sees
_FACES = np.array([0.80, 0.92, 1.12], dtype=np.float32)  # brightness of the faces across x, y, z
_WALLS = np.array([0.900, 0.925, 0.955], dtype=np.float32)
_SLANT = (-0.45, 0.30)  # how far light moves along x and y while it falls by one voxel
_LINES = 8  # voxels between the lines on the walls


class _View(NamedTuple):
    """Rays of one picture, ``P`` of them, that pass at most ``S`` voxels."""

    voxels: NDArray[np.int32]  # (P, S) flat index, nearest first; R^3 where there is none
    faces: NDArray[np.int8]  # (P, S) axis of the face through which a voxel is entered
    pixels: NDArray[np.int64]  # (P,) place in the flat picture
    wall: NDArray[np.int64]  # (P,) axis of the wall behind
    behind: NDArray[np.int64]  # (P,) flat index of the voxel before the wall
    grid: Floats  # (P,) 1 on a line of the wall, 0 between


def _screen() -> tuple[NDArray[Any], NDArray[Any]]:
    right = np.cross([0.0, 0.0, 1.0], _EYE)
    right /= np.linalg.norm(right)
    return right, np.cross(_EYE, right)


@lru_cache(maxsize=4)
def _view(resolution: int, width: int) -> _View:
    """Which voxels every pixel's ray passes."""
    right, up = _screen()
    corners = (np.array(list(np.ndindex(2, 2, 2))) - 0.5) * resolution
    reach = 1.02 * max(np.abs(corners @ right).max(), np.abs(corners @ up).max())
    across = ((np.arange(width) + 0.5) / width * 2 - 1) * reach
    origins = (across[None, :, None] * right - across[:, None, None] * up).reshape(-1, 3) + _EYE * 2 * resolution
    origins = origins.astype(np.float32)
    planes = (np.arange(resolution + 1) - resolution / 2).astype(np.float32)
    times = (planes[None, None] - origins[:, :, None]) / -_EYE[None, :, None].astype(np.float32)  # (P, 3, R + 1)
    near, far = times.min(axis=2).max(axis=1), times.max(axis=2).min(axis=1)
    hit = np.flatnonzero(far > near + 1e-6)
    origins, times, near, far = origins[hit], times[hit], near[hit], far[hit]
    flat = np.clip(times.reshape(len(hit), -1), near[:, None], far[:, None])
    stops = np.sort(flat, axis=1)
    middle = 0.5 * (stops[:, 1:] + stops[:, :-1])
    inside = stops[:, 1:] - stops[:, :-1] > 1e-4
    steps = int(inside.sum(axis=1).max())
    first = np.argsort(~inside, axis=1, kind="stable")[:, :steps]
    inside, middle = np.take_along_axis(inside, first, axis=1), np.take_along_axis(middle, first, axis=1)
    places = origins[:, None, :] - middle[..., None] * _EYE.astype(np.float32) + np.float32(resolution / 2)
    index = np.clip(np.floor(places), 0, resolution - 1).astype(np.int32)
    voxels = (index[..., 0] * resolution + index[..., 1]) * resolution + index[..., 2]
    before = np.concatenate([voxels[:, :1], voxels[:, :-1]], axis=1)
    moved = np.abs(voxels - before)
    faces = np.where(moved >= resolution**2, 0, np.where(moved >= resolution, 1, 2))
    faces[:, 0] = np.argmax(times.min(axis=2), axis=1)
    last = inside.sum(axis=1) - 1
    rows = np.arange(len(hit))
    wall = np.argmin(times.max(axis=2), axis=1)
    ends = origins - far[:, None] * _EYE + resolution / 2
    off = np.abs(ends / _LINES - np.rint(ends / _LINES)) * _LINES
    off[rows, wall] = np.inf
    grid = np.clip(1.6 - off.min(axis=1) * width / (2 * reach), 0.0, 1.0).astype(np.float32)
    behind = voxels[rows, last].astype(np.int64)
    voxels = np.where(inside, voxels, resolution**3).astype(np.int32)
    return _View(voxels, faces.astype(np.int8), hit, wall, behind, grid)


def _shifted(grid: Floats, axis: int, step: int, outside: float) -> Floats:
    """``result[i] = grid[i + step]`` along an axis for a step of one voxel; beyond the cube lies ``outside``."""
    result = np.full_like(grid, outside)
    ahead, behind = [slice(None)] * 3, [slice(None)] * 3
    ahead[axis], behind[axis] = slice(1, None), slice(None, -1)
    source, target = (ahead, behind) if step > 0 else (behind, ahead)
    result[tuple(target)] = grid[tuple(source)]
    return result


def _blur(grid: Floats, rounds: int) -> Floats:
    """Smoothed by (1, 2, 1) / 4 along each axis, ``rounds`` times; beyond the cube lies nothing."""
    for _ in range(rounds):
        for axis in range(3):
            grid = 0.5 * grid + 0.25 * (_shifted(grid, axis, 1, 0.0) + _shifted(grid, axis, -1, 0.0))
    return grid


def _moved(slab: Floats, shift: float, axis: int) -> Floats:
    """A slab moved by less than one voxel along an axis; what enters is lit."""
    step = 1 if shift > 0 else -1
    rolled = np.roll(slab, step, axis=axis)
    edge = [slice(None)] * 2
    edge[axis] = slice(0, 1) if step > 0 else slice(-1, None)
    rolled[tuple(edge)] = 1.0
    return (1 - abs(shift)) * slab + abs(shift) * rolled


def _light(opacity: Floats) -> Floats:
    """Share of the light from above that reaches each voxel's top."""
    light = np.ones_like(opacity)
    for z in range(opacity.shape[2] - 2, -1, -1):
        through = light[:, :, z + 1] * (1.0 - opacity[:, :, z + 1])
        light[:, :, z] = _moved(_moved(through, _SLANT[0], 0), _SLANT[1], 1)
    return light


def _brightness(opacity: Floats) -> Floats:
    """``(R^3 + 1, 3)``: how bright the three visible faces of every voxel are."""
    open_air = 1.0 - np.clip((_blur(opacity, 4) - 0.2) * 1.1, 0.0, 0.5)
    light = _light(opacity)
    sides = []
    for axis in range(3):
        seen = light if axis == 2 else _shifted(light, axis, _SIDES[axis], 1.0)
        sides.append(_FACES[axis] * _shifted(open_air, axis, _SIDES[axis], 1.0) * (0.72 + 0.28 * seen))
    faces = np.stack([side.ravel() for side in sides], axis=1)
    return np.concatenate([faces, np.ones((1, 3), dtype=np.float32)]).astype(np.float32)


def render_cube(opacity: NDArray[Any], colors: NDArray[Any], *, width: int = 168, smooth: int = 2) -> Image:
    """Draw one cube.

    Args:
        opacity: ``(R, R, R)`` in [0, 1]: what one voxel absorbs.
        colors: ``(R, R, R, 3)`` in [0, 1].
        width: of the picture in pixels, which is square.
        smooth: rays per pixel along each side.

    Returns:
        ``(width, width, 3)`` uint8: z up, x to the right and towards the eye, y away from it.

    Raises:
        ValueError: other shapes.
    """
    resolution = opacity.shape[0]
    if opacity.shape != (resolution,) * 3 or colors.shape != (resolution,) * 3 + (3,):
        raise InvalidArgument(
            f"render_cube: opacity must be (R, R, R) and colors (R, R, R, 3), got {opacity.shape} and {colors.shape}"
        )
    view = _view(resolution, width * smooth)
    solid = np.clip(opacity, 0.0, 1.0).astype(np.float32)
    absorbed = np.append(solid.ravel(), np.float32(0.0))[view.voxels]
    clear = np.cumprod(1.0 - absorbed, axis=1)
    weight = absorbed.copy()
    weight[:, 1:] *= clear[:, :-1]
    rays, steps = np.nonzero(weight > 0.002)
    voxel, face = view.voxels[rays, steps], view.faces[rays, steps]
    before = np.where(steps > 0, absorbed[rays, np.maximum(steps - 1, 0)], 0.0)
    edge = np.clip(absorbed[rays, steps] - before, 0.0, 1.0)  # a face shows where opacity jumps
    bright = _brightness(solid)
    shade = bright[voxel, face] * edge + bright[voxel].mean(axis=1) * (1.0 - edge)
    picture = _room(solid, view) * clear[:, -1:]
    tint = colors.reshape(-1, 3).astype(np.float32)
    for channel in range(3):
        light = weight[rays, steps] * shade * tint[voxel, channel]
        picture[:, channel] += np.bincount(rays, light, minlength=len(picture))
    canvas = np.tile(np.array(PAPER, dtype=np.float32), ((width * smooth) ** 2, 1))
    canvas[view.pixels] = np.clip(picture, 0.0, 1.0)
    fine = canvas.reshape(width, smooth, width, smooth, 3).mean(axis=(1, 3))
    image: Image = np.rint(fine * 255).astype(np.uint8)
    return image


def _room(opacity: Floats, view: _View) -> Floats:
    """Colour ``(P, 3)`` of the walls and the floor behind a cube; the floor takes its shadow."""
    fallen = np.repeat((_light(opacity) * (1.0 - opacity))[:, :, :1], opacity.shape[2], axis=2).ravel()
    shadow = np.where(view.wall == 2, 0.72 + 0.28 * fallen[view.behind], 1.0)
    tone = _WALLS[view.wall] * shadow * (1.0 - 0.07 * view.grid)
    colors: Floats = (tone[:, None] * np.array([1.0, 0.995, 0.985])).astype(np.float32)
    return colors


def best_turn(opacity: NDArray[Any], interest: NDArray[Any]) -> int:
    """The number of quarter turns about z (0 to 3) that shows most of ``interest (R, R, R)``."""
    view = _view(opacity.shape[0], 48)
    shown = []
    for turn in range(4):
        absorbed = np.append(np.rot90(opacity, turn).ravel(), 0.0)[view.voxels]
        clear = np.cumprod(1.0 - absorbed, axis=1)
        absorbed[:, 1:] *= clear[:, :-1]
        shown.append(float((absorbed * np.append(np.rot90(interest, turn).ravel(), 0.0)[view.voxels]).sum()))
    return int(np.argmax(shown))


def png_bytes(image: Image) -> bytes:
    """A PNG file of ``(H, W, 3)`` uint8.

    Written here because ``unghost clean --preview`` runs on the base install and ``unghost sample`` on ``[torch]``,
    neither of which has Pillow; and so that a picture's bytes do not depend on what is installed. Flat pictures need
    no filters: a picture of a cube takes 14.1 kB (Pillow 17.4 kB, with ``optimize`` 16.9 kB), a preview of 512 x 1536
    pixels 38.8 kB in 156 ms (Pillow 44.1 kB in 40 ms, 42.7 kB in 246 ms).
    """

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    height, width = image.shape[:2]
    rows = np.zeros((height, 1 + 3 * width), dtype=np.uint8)  # the first byte of a row names its filter: none
    rows[:, 1:] = image.reshape(height, -1)
    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    body = chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(rows.tobytes(), 9)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + body
