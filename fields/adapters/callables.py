"""Small adapters: what a stranger's function gives, as the density callable that unghost takes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core.aabb import as_aabb
from ...core.arrays import Array, is_tensor, namespace, to_numpy
from ...core.errors import InvalidArgument, InvalidType
from ...core.occupancy import check_density_shape

DensityFn = Callable[[Array], Array]


def numpy_density_fn(
    function: Callable[[NDArray[Any]], ArrayLike], *, aabb: ArrayLike | None = None, chunk: int = 1 << 18
) -> DensityFn:
    """A function of a flat list of points, as a field that takes any shape, arrays and tensors alike.

    Args:
        function: ``positions (M, 3) float64 -> density (M,) or (M, 1)``; anything that numpy can read as floats
            (a list, float16, integers). Never called with more than ``chunk`` points, nor with none.
        aabb: ``(2, 3)``; outside, ``function`` is not asked and the density is 0. None: it is asked everywhere.

    Returns:
        ``positions (..., 3) -> density (..., 1)`` float32, an array or a tensor (on the same device) like the
        positions. No gradient flows: it is for ``clean``, not for training.

    Raises:
        ValueError: (when asked) densities of the wrong shape.

    Example:
        >>> field = numpy_density_fn(lambda p: (np.abs(p) < 0.5).all(-1) * 40, aabb=[[-1] * 3, [1] * 3])
        >>> field(np.zeros((2, 2, 3))).shape
        (2, 2, 1)
    """
    if not callable(function):
        raise InvalidType(f"numpy_density_fn: function must be callable, got {type(function).__name__}")
    if chunk < 1:
        raise InvalidArgument(f"numpy_density_fn: chunk must be >= 1, got {chunk}")
    box = None if aabb is None else as_aabb(aabb, caller="numpy_density_fn")

    def density_fn(positions: Array) -> Array:
        points = np.asarray(to_numpy(positions), dtype=np.float64)
        if points.shape[-1:] != (3,):
            raise InvalidArgument(f"numpy_density_fn: positions must have shape (..., 3), got {points.shape}")
        flat = points.reshape(-1, 3)
        asked = np.arange(len(flat)) if box is None else np.flatnonzero(((flat >= box[0]) & (flat <= box[1])).all(1))
        density = np.zeros(len(flat), dtype=np.float32)
        for start in range(0, len(asked), chunk):
            part = asked[start : start + chunk]
            values = np.asarray(function(flat[part]))
            density[part] = check_density_shape(values, flat[part], caller="numpy_density_fn")
        result = density.reshape(*points.shape[:-1], 1)
        if is_tensor(positions):
            return namespace(positions).from_numpy(result).to(positions.device)
        return result

    return density_fn


def occupancy_density_fn(occupancy_fn: Callable[[Array], Array], *, pitch: float, most: float = 0.999) -> DensityFn:
    """Occupancy networks and bit grids: probabilities (or booleans) as the density whose cells absorb that share.

    ``-ln(1 - probability) / pitch``, the inverse of ``opacity = 1 - exp(-density * pitch)``.

    Args:
        occupancy_fn: ``positions (..., 3) -> probability (...) or (..., 1)`` in [0, 1], arrays or tensors.
        pitch: side of the occupancy's own cells, scene units: pass it to ``clean`` as ``field_pitch``.
        most: probabilities above count as this one, in (0, 1): certainty would be an infinite density.

    Raises:
        ValueError: (when asked) probabilities outside [0, 1] or NaN.

    Example:
        >>> field = occupancy_density_fn(lambda positions: np.array([0.0, 0.5, 1.0]), pitch=0.1)
        >>> field(np.zeros((3, 3))).round(2).tolist()
        [0.0, 6.93, 69.08]
    """
    if not 0.0 < pitch < np.inf:
        raise InvalidArgument(f"occupancy_density_fn: pitch must be finite and > 0, got {pitch}")
    if not 0.0 < most < 1.0:
        raise InvalidArgument(f"occupancy_density_fn: most must lie in (0, 1), got {most}")

    def density_fn(positions: Array) -> Array:
        share = occupancy_fn(positions)
        xp = namespace(share)
        if not is_tensor(share):
            share = np.asarray(share, dtype=np.float32) if np.asarray(share).dtype.kind in "biu" else np.asarray(share)
        elif not share.is_floating_point():
            share = share.float()
        if not bool(((share >= 0) & (share <= 1)).all()):
            raise InvalidArgument("occupancy_density_fn: occupancy_fn must return probabilities in [0, 1]")
        return -xp.log1p(-xp.clip(share, None, most)) / pitch

    return density_fn


def transformed_density_fn(density_fn: DensityFn, transform: ArrayLike) -> DensityFn:
    """A field in other coordinates: moved, turned and uniformly resized, its density per unit of the new ones.

    Args:
        density_fn: a field in its own coordinates.
        transform: ``(3, 4)`` or ``(4, 4)``, from the new coordinates to the field's own: a rotation (or
            reflection) times one factor, and a shift.

    Raises:
        ValueError: not such a matrix: under a shear a density has no meaning without a direction.

    Example:
        >>> half = transformed_density_fn(lambda p: p[..., 0], np.diag([2.0, 2.0, 2.0, 1.0]))
        >>> half(np.array([[1.0, 0.0, 0.0]]))  # asked at x = 2; a unit is twice as long as the field's own
        array([4.])
    """
    matrix = np.asarray(to_numpy(transform), dtype=np.float64)
    if matrix.shape not in ((3, 4), (4, 4)) or not np.isfinite(matrix).all():
        raise InvalidArgument(
            f"transformed_density_fn: transform must be a finite (3, 4) or (4, 4), got {matrix.shape}"
        )
    turn, shift = matrix[:3, :3], matrix[:3, 3]
    factor = float(np.cbrt(abs(np.linalg.det(turn))))
    if factor == 0 or not np.allclose(turn @ turn.T, factor**2 * np.eye(3), rtol=0, atol=1e-5 * factor**2):
        raise InvalidArgument(
            f"transformed_density_fn: transform must be a rotation times one factor, got {turn.round(6).tolist()}"
        )

    def moved(positions: Array) -> Array:
        if is_tensor(positions):
            place = positions @ positions.new_tensor(turn.T) + positions.new_tensor(shift)
        else:
            place = np.asarray(positions) @ turn.T + shift
        return density_fn(place) * factor

    return moved
