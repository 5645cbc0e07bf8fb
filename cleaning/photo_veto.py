"""Give removed density back where the training photos need it. numpy only."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import to_numpy
from ..core.cameras import Cameras
from ..core.errors import InvalidArgument
from ..core.occupancy import opacity_from_signed
from .components import dilate
from .keep_mask import KeepMask

Render = Callable[[Callable[[Any], Any], int], Any]

LEAST_WEIGHT = 1e-3  # share of a pixel's light from which a cell counts as seen by it
FLOOR = 1e-4  # squared error (40 dB) below which no rise matters
STEP = 3.0  # factor from one round's threshold to the next
STEPS_PER_CELL = 1.0


@dataclass(frozen=True)
class PhotoVeto:
    """Training photos that may veto a removal; they never justify one, because a field agrees with its own photos.

    Attributes:
        photos: ``(N, H, W, 3)`` in [0, 1], of the training cameras, in their order.
        render: ``render(density_fn, index) -> rgb (H, W, 3)`` in [0, 1]: renders photo ``index`` with the field's
            colours and the given density callable, which takes and gives what the field's own does.
        max_psnr_drop: dB by which the mean PSNR of the photos may fall, >= 0.
        rounds: attempts at giving back the cells with the most blame, >= 0, before every cell that a photo sees is
            given back.
        rays: most pixels whose cells are looked up in a round, >= 1.

    Example:
        >>> veto = PhotoVeto(np.zeros((1, 4, 4, 3)), lambda density_fn, index: np.zeros((4, 4, 3)))
        >>> veto.max_psnr_drop
        0.5
    """

    photos: NDArray[Any]
    render: Render
    max_psnr_drop: float = 0.5
    rounds: int = 8
    rays: int = 1 << 16

    def __post_init__(self) -> None:
        if np.ndim(self.photos) != 4 or np.shape(self.photos)[-1] != 3:
            raise InvalidArgument(f"PhotoVeto: photos must have shape (N, H, W, 3), got {np.shape(self.photos)}")
        for name, holds, rule in (
            ("max_psnr_drop", 0 <= self.max_psnr_drop < np.inf, "finite and >= 0"),
            ("rounds", self.rounds >= 0, ">= 0"),
            ("rays", self.rays >= 1, ">= 1"),
        ):
            if not holds:
                raise InvalidArgument(f"PhotoVeto: {name} must be {rule}, got {getattr(self, name)!r}")


def apply_veto(
    mask: KeepMask,
    veto: PhotoVeto,
    density_fn: Callable[[Any], Any],
    signed: NDArray[np.float32],
    cameras: Cameras,
    *,
    seed: int = 0,
) -> KeepMask:
    """Give cells back until the training photos are rendered about as well as before.

    A cell's blame is the mean rise of the squared error over the pixels that see it, weighted by how much of the
    pixel's light comes from the cell. Each round gives back the cells with more than a third of the largest blame, and
    of the threshold before; after the last one every cell that any photo sees is given back. So the photos lose about
    ``veto.max_psnr_drop`` dB at most (errors below 40 dB count as 40 dB), and what no photo sees stays removed.

    Args:
        mask: what would be removed.
        veto: photos and how to render them.
        density_fn: the field.
        signed: ``(X, Y, Z)`` signed opacity of the mask's cells.
        cameras: of the photos.
        seed: seed for the choice of pixels.

    Returns:
        A mask that keeps at least what ``mask`` keeps; ``details["veto"]`` holds ``psnr_before``, ``psnr_cleaned``
        (before the veto), ``psnr_after``, ``given_back`` (cells) and ``rounds``.

    Raises:
        ValueError: photos, renders and cameras disagree in number or size.
    """
    count = len(cameras)
    if len(veto.photos) != count:
        raise InvalidArgument(f"clean: photos must be one for each of the {count} cameras, got {len(veto.photos)}")
    before = _errors(veto, density_fn, cameras)
    most = max(float(before.mean()), FLOOR) * 10 ** (veto.max_psnr_drop / 10)
    cells, rounds = mask.cells.copy(), 0
    after = first = _errors(veto, mask.apply(density_fn), cameras)
    opacity = opacity_from_signed(signed)
    threshold = np.inf
    while after.mean() > most:
        last = rounds >= veto.rounds
        blame, seen = _blame(mask, opacity, after - before, cameras, veto, seed=seed + rounds, all_pixels=last)
        threshold = min(threshold, float(blame.max())) / STEP
        cells |= dilate(seen) if last else blame > threshold  # a ray may cut a corner between two samples
        rounds += 1
        after = _errors(veto, dataclasses.replace(mask, cells=cells).apply(density_fn), cameras)
        if last:
            break
    details = {
        "psnr_before": _psnr(before),
        "psnr_cleaned": _psnr(first),
        "psnr_after": _psnr(after),
        "given_back": int((cells & ~mask.cells).sum()),
        "rounds": rounds,
    }
    return dataclasses.replace(mask, cells=cells, details={**mask.details, "veto": details})


def _psnr(errors: NDArray[np.float64]) -> float:
    return float(-10 * np.log10(max(float(errors.mean()), 1e-12)))


def _errors(veto: PhotoVeto, density_fn: Callable[[Any], Any], cameras: Cameras) -> NDArray[np.float64]:
    """Mean squared error of each pixel of each photo ``(N, H, W)``."""
    height, width = np.shape(veto.photos)[1:3]
    errors = np.zeros((len(cameras), height, width))
    for index in range(len(cameras)):
        rgb = np.asarray(to_numpy(veto.render(density_fn, index)), dtype=np.float64)
        if rgb.shape != (height, width, 3):
            raise InvalidArgument(
                f"clean: render must return ({height}, {width}, 3) as the photos are, got {rgb.shape} for {index}"
            )
        errors[index] = ((rgb - np.asarray(veto.photos[index], dtype=np.float64)) ** 2).mean(axis=-1)
    return errors


def _blame(
    mask: KeepMask,
    opacity: NDArray[np.float32],
    rise: NDArray[np.float64],
    cameras: Cameras,
    veto: PhotoVeto,
    *,
    seed: int,
    all_pixels: bool,
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Mean rise of the error of the pixels that see each cell of the removal, and which of these any pixel sees."""
    removed = ~mask.cells
    weighted, weights = np.zeros(removed.size), np.zeros(removed.size)
    total = rise.size
    rng = np.random.default_rng([seed, 23])
    chosen = np.arange(total) if all_pixels or total <= veto.rays else np.sort(rng.choice(total, veto.rays, False))
    pixels = np.stack(np.unravel_index(chosen, rise.shape), axis=1)
    for index in range(len(cameras)):
        mine = pixels[pixels[:, 0] == index]
        scale = np.array(cameras.size(index)) / np.array(rise.shape[:0:-1])  # photos may be smaller than the cameras
        for start in range(0, len(mine), 4096):
            part = mine[start : start + 4096]
            origins, directions = cameras.rays(index, (part[:, :0:-1] + 0.5) * scale)
            place, weight = _light(mask, opacity, origins, directions)
            hit = removed.ravel()[place] & (weight > LEAST_WEIGHT)
            amounts = np.broadcast_to(rise[index, part[:, 1], part[:, 2]][:, None], weight.shape)[hit]
            weighted += np.bincount(place[hit], weights=weight[hit] * amounts, minlength=removed.size)
            weights += np.bincount(place[hit], weights=weight[hit], minlength=removed.size)
    blame = np.divide(weighted, weights, out=np.zeros_like(weights), where=weights > 0)
    return blame.reshape(removed.shape), (weights > 0).reshape(removed.shape)


def _light(
    mask: KeepMask, opacity: NDArray[np.float32], origins: NDArray[np.float64], directions: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Cells along rays in the box, and the share of the pixel's light that comes from each: ``(N, S)`` both."""
    shape = np.array(opacity.shape)
    low, high = mask.origin, mask.origin + shape * mask.pitch
    with np.errstate(divide="ignore", invalid="ignore"):
        near, far = (low - origins) / directions, (high - origins) / directions
    enter = np.maximum(np.nanmax(np.minimum(near, far), axis=1), 0.0)
    leave = np.maximum(np.nanmin(np.maximum(near, far), axis=1), enter)
    steps = max(1, int(np.ceil(STEPS_PER_CELL * float((leave - enter).max()) / mask.pitch)))
    spacing = (leave - enter) / steps
    along = enter[:, None] + (np.arange(steps) + 0.5) * spacing[:, None]
    places = origins[:, None] + along[..., None] * directions[:, None]
    index = np.clip(((places - low) / mask.pitch).astype(np.int64), 0, shape - 1)
    flat = (index[..., 0] * shape[1] + index[..., 1]) * shape[2] + index[..., 2]
    through = np.maximum(1.0 - opacity.ravel()[flat].astype(np.float64), 1e-9) ** (spacing[:, None] / mask.pitch)
    before = np.cumprod(np.concatenate([np.ones((len(flat), 1)), through[:, :-1]], axis=1), axis=1)
    return flat, before * (1.0 - through)
