"""What a prior must beat: clean-up that needs no training, behind the interface of a denoiser.

Bits are treated as bits. Of soft cubes the filters smooth the opacity itself (their ranking of voxels is what counts
there), while components and morphology judge its bits and keep the opacity of what stays.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ..core.errors import InvalidArgument, needs_extra
from ..core.manifest import Manifest
from ..core.occupancy import (
    DEFAULT_OPACITY_THRESHOLD,
    opacity_from_signed,
    signed_from_occupancy,
    signed_from_opacity,
)

Bits = NDArray[np.bool_]
Values = NDArray[np.float32]
TOUCHING = np.ones((3, 3, 3))
SMALLEST = 64  # voxels of a component that stays
PAD = 2


def largest_component(occupied: Bits) -> Bits:
    """The piece (26 neighbours) with the most voxels.

    Example:
        >>> occupied = np.zeros((16, 16, 16), dtype=bool)
        >>> occupied[:8, :8, :8] = occupied[14, 14, 14] = True
        >>> int(occupied.sum()), int(largest_component(occupied).sum())
        (513, 512)
    """
    labels, count = ndimage.label(occupied, structure=TOUCHING)
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    sizes[0] = 0
    return (labels == sizes.argmax()) & occupied


def large_components(occupied: Bits) -> Bits:
    """Pieces of ``SMALLEST`` voxels or more.

    Example:
        >>> occupied = np.zeros((16, 16, 16), dtype=bool)
        >>> occupied[:8, :8, :8] = occupied[14, 14, 14] = True
        >>> int(occupied.sum()), int(large_components(occupied).sum())
        (513, 512)
    """
    labels, count = ndimage.label(occupied, structure=TOUCHING)
    large = np.bincount(labels.ravel(), minlength=count + 1) >= SMALLEST
    large[0] = False
    kept: Bits = large[labels]
    return kept


def _padded(operation: Callable[..., Any], occupied: Bits) -> Bits:
    """A morphological operation by the six neighbours, the cube continued by its sides."""
    wide = np.pad(occupied, PAD, mode="edge")
    result: Bits = operation(wide)[PAD:-PAD, PAD:-PAD, PAD:-PAD]
    return result


def opening(occupied: Bits) -> Bits:
    """Erosion, then dilation: takes away what is thinner than three voxels.

    Example:
        >>> occupied = np.zeros((16, 16, 16), dtype=bool)
        >>> occupied[:8, :8, :8] = occupied[14, 14, 14] = True
        >>> bool(opening(occupied)[14, 14, 14])
        False
    """
    return _padded(ndimage.binary_opening, occupied)


def closing(occupied: Bits) -> Bits:
    """Dilation, then erosion: fills gaps of one or two voxels.

    Example:
        >>> occupied = np.ones((16, 16, 16), dtype=bool)
        >>> occupied[8, 8, 8] = False
        >>> bool(closing(occupied).all())
        True
    """
    return _padded(ndimage.binary_closing, occupied) | occupied


def components_and_closing(occupied: Bits) -> Bits:
    """Small pieces removed, then a closing.

    Example:
        >>> occupied = np.zeros((16, 16, 16), dtype=bool)
        >>> occupied[:8, :8, :8] = occupied[14, 14, 14] = True
        >>> occupied[4, 4, 4] = False
        >>> components_and_closing(occupied)[[4, 14], [4, 14], [4, 14]].tolist()
        [True, False]
    """
    return closing(large_components(occupied))


def gaussian(values: Values) -> Values:
    """Standard deviation of one voxel.

    Example:
        >>> values = np.zeros((5, 5, 5), np.float32)
        >>> values[2, 2, 2] = 1.0
        >>> round(float(gaussian(values)[2, 2, 2]), 4)
        0.0635
    """
    smoothed: Values = ndimage.gaussian_filter(values, 1.0, mode="nearest")
    return smoothed


def median(values: Values) -> Values:
    """Over 3 x 3 x 3 voxels.

    Example:
        >>> values = np.zeros((5, 5, 5), np.float32)
        >>> values[2, 2, 2] = 1.0
        >>> float(median(values).max())
        0.0
    """
    middle: Values = ndimage.median_filter(values, 3, mode="nearest")
    return middle


def total_variation(values: Values) -> Values:
    """Chambolle's, at a weight of .6 (not tuned).

    Example:
        >>> values = np.zeros((5, 5, 5), np.float32)
        >>> values[2, 2, 2] = 1.0
        >>> bool(total_variation(values).max() < 1)
        True
    """
    with needs_extra("eval", caller="total_variation"):
        from skimage.restoration import denoise_tv_chambolle

    result: Values = denoise_tv_chambolle(  # type: ignore[no-untyped-call]
        values.astype(np.float64), weight=0.6, max_num_iter=60
    ).astype(np.float32)
    return result


OF_BITS: dict[str, Callable[[Bits], Bits]] = {
    "largest component": largest_component,
    "components": large_components,
    "opening": opening,
    "closing": closing,
    "components+closing": components_and_closing,
}
OF_VALUES: dict[str, Callable[[Values], Values]] = {"gaussian": gaussian, "median": median, "tv": total_variation}


def decided(signed: Values) -> Values:
    """Signed opacity so bent that the opacity which counts as opaque is at 0; increasing, [-1, 1] onto itself.

    Example:
        >>> decided(np.array([-1.0, -0.8, 1.0], np.float32)).tolist()  # an opacity of 0.1 is at 0
        [-1.0, 0.0, 1.0]
    """
    zero = float(signed_from_opacity(np.float32(DEFAULT_OPACITY_THRESHOLD)))
    bent: Values = np.interp(signed, [-1.0, zero, 1.0], [-1.0, 0.0, 1.0]).astype(np.float32)
    return bent


class Classical:
    """A filter as a denoiser of one channel; ``input`` changes nothing.

    Example:
        >>> cubes = np.full((1, 1, 32, 32, 32), -1.0, np.float32)
        >>> cubes[0, 0, :8, :8, :8] = cubes[0, 0, 30, 30, 30] = 1.0
        >>> cleaned = Classical("largest component")(cubes, 0, 0.1)
        >>> int((cubes > 0).sum()), int((cleaned > 0).sum())
        (513, 512)
    """

    kind = "numpy"

    def __init__(self, name: str) -> None:
        if name != "input" and name not in OF_BITS and name not in OF_VALUES:
            raise InvalidArgument(f"Classical: name must be one of {self.names()}, got {name!r}")
        self.manifest = Manifest(name)

    @staticmethod
    def names() -> list[str]:
        """All there are."""
        return ["input", *OF_BITS, *OF_VALUES]

    def _cube(self, signed: Values) -> Values:
        name, bits = self.manifest.name, bool((np.abs(signed) == 1.0).all())
        if name in OF_VALUES:
            filtered = OF_VALUES[name](signed)
            return filtered if bits else decided(filtered)
        if name == "input":
            return signed if bits else decided(signed)
        opaque = opacity_from_signed(signed) > DEFAULT_OPACITY_THRESHOLD
        kept = OF_BITS[name](opaque)
        if bits:
            return signed_from_occupancy(kept)
        rank = decided(signed)  # what stays is above what goes, and each in the order of its opacity
        return np.where(kept, (1.0 + np.maximum(rank, 0.0)) / 2.0, (rank - 1.0) / 2.0)

    def __call__(self, channels: Any, timestep: Any, edge_fraction: Any) -> NDArray[np.float32]:
        """See ``core.manifest.Denoiser``."""
        return np.stack([self._cube(cube) for cube in channels[:, 0]])[:, None].astype(np.float32)
