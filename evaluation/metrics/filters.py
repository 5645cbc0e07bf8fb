"""Separable image filters in numpy, so that the metrics need no more than the base install.

``scipy.ndimage.correlate1d`` twice gives the same (to 4e-16) in 10 ms for 480 x 640 x 3 values and 11 taps, 16 ms here.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


def gaussian_taps(radius: int, width: float) -> FloatArray:
    """A Gaussian of standard deviation ``width`` pixels at ``-radius .. radius``, summing to 1."""
    offsets = np.arange(-radius, radius + 1)
    taps = np.exp(-0.5 * (offsets / width) ** 2)
    return np.asarray(taps / taps.sum(), dtype=np.float64)


def correlate(image: FloatArray, rows: FloatArray, columns: FloatArray, *, border: str) -> FloatArray:
    """Correlate ``(H, W, ...)`` with ``rows`` down the first axis and ``columns`` along the second.

    Args:
        image: any trailing axes are filtered one by one.
        rows, columns: odd numbers of taps.
        border: what stands outside the image: a mode of :func:`numpy.pad` (``symmetric`` mirrors the edge
            pixel too, ``reflect`` does not, ``edge`` repeats it, ``constant`` is 0), or ``valid``: only windows
            that lie wholly inside, so that the result is smaller by the taps less one.
    """
    for axis, taps in enumerate((rows, columns)):
        if border != "valid":
            radius = len(taps) // 2
            padding = [(radius, radius) if axis == each else (0, 0) for each in range(image.ndim)]
            image = np.pad(image, padding, mode=border)  # type: ignore[call-overload]
        image = np.lib.stride_tricks.sliding_window_view(image, len(taps), axis=axis) @ taps
    return image
