"""Lens models of normalised image coordinates (x right, y down): OPENCV and OPENCV_FISHEYE.

OPENCV bends the tangent plane, ``(X / Z, Y / Z)``; OPENCV_FISHEYE (equidistant, Kannala and Brandt 2006, as OpenCV,
COLMAP, nerfstudio and instant-ngp have it) draws a point that stands at the angle ``theta`` to the optical axis at the
radius ``theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)``, also beyond 90 degrees.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

NEWTON_STEPS = 60  # at most; 5 do for most lenses
UNDISTORTED = 1e-9  # how far from an image coordinate, normalised, its inverse may land again
WIDEST_TANGENT = 100.0  # 89.4 degrees off the axis: nothing farther out is looked for


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
    """Inverse of :func:`distort` by fixed-point iteration, and by Newton's method where that is off by more than 1e-9.

    It is for wide lenses (a phone's have none). Image coordinates that the lens reaches from nowhere, or only from
    beyond :func:`largest_radius`, come back as the iteration leaves them, or where it runs away at that radius.
    """
    if not k.any():
        return u, v
    x, y = u.copy(), v.copy()
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(iterations):
            du, dv = distort(x, y, k)
            x, y = x + (u - du), y + (v - dv)
        du, dv = distort(x, y, k)
        off = np.asarray(~(np.hypot(u - du, v - dv) < UNDISTORTED))
    if off.any():
        x, y = np.array(x), np.array(y)
        x[off], y[off] = _undistort_newton(np.asarray(u)[off], np.asarray(v)[off], k, x[off], y[off])
    return x, y


def _undistort_newton(
    u: FloatArray, v: FloatArray, k: FloatArray, x: FloatArray, y: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """:func:`undistort` from the radial inverse on; ``x`` and ``y`` where that comes to nothing."""
    radius, limit = np.hypot(u, v), min(largest_radius(k), WIDEST_TANGENT)
    low, high = np.zeros_like(radius), np.full_like(radius, limit)
    for _ in range(NEWTON_STEPS):
        middle = (low + high) / 2
        beyond = fisheye_radius(middle, k) > radius  # the radial terms are the same polynomial
        low, high = np.where(beyond, low, middle), np.where(beyond, middle, high)
    stretch = low / np.maximum(radius, 1e-12)
    a, b = u * stretch, v * stretch
    lost = ~(np.isfinite(x) & np.isfinite(y))
    x, y = np.where(lost, a, x), np.where(lost, b, y)
    k1, k2, k3, k4, p1, p2 = k
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        for _ in range(8):
            du, dv = distort(a, b, k)
            r2 = a * a + b * b
            radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
            slope = k1 + r2 * (2 * k2 + r2 * (3 * k3 + r2 * 4 * k4))  # of radial, by r2
            ua = radial + 2 * a * a * slope + 2 * p1 * b + 6 * p2 * a
            ub = 2 * a * b * slope + 2 * p1 * a + 2 * p2 * b
            vb = radial + 2 * b * b * slope + 2 * p2 * a + 6 * p1 * b
            determinant = ua * vb - ub * ub
            a, b = (
                a + (vb * (u - du) - ub * (v - dv)) / determinant,
                b + (ua * (v - dv) - ub * (u - du)) / determinant,
            )
        du, dv = distort(a, b, k)
        good = (np.hypot(u - du, v - dv) < UNDISTORTED) & (np.hypot(a, b) < limit)
    return np.where(good, a, x), np.where(good, b, y)


def largest_radius(k: FloatArray) -> float:
    """Radius (normalised) up to which the radial polynomial is monotonic: beyond it, points fold back in."""
    if not k[:4].any():
        return np.inf
    coefficients = [9.0 * k[3], 0.0, 7.0 * k[2], 0.0, 5.0 * k[1], 0.0, 3.0 * k[0], 0.0, 1.0]
    roots = np.roots(np.trim_zeros(coefficients, "f"))
    real = roots[np.abs(roots.imag) < 1e-9].real
    positive = real[real > 0]
    return float(positive.min()) if positive.size else np.inf


def widest_angle(k: FloatArray) -> float:
    """Angle to the optical axis (radians, at most pi) up to which a fisheye's radius grows: beyond, nothing is seen."""
    return min(largest_radius(k), float(np.pi))


def fisheye_radius(angle: FloatArray, k: FloatArray) -> FloatArray:
    """Radius (normalised) at which OPENCV_FISHEYE draws what stands at ``angle`` (radians) to the optical axis."""
    squared = angle * angle
    radius: FloatArray = angle * (1.0 + squared * (k[0] + squared * (k[1] + squared * (k[2] + squared * k[3]))))
    return radius


def fisheye_angle(radius: FloatArray, k: FloatArray) -> FloatArray:
    """Inverse of :func:`fisheye_radius` by Newton's method between bounds, to rounding.

    A radius that no angle reaches (a corner beyond the image circle) gives :func:`widest_angle`.
    """
    widest = widest_angle(k)
    if not k[:4].any():
        return np.minimum(radius, widest)
    target = np.minimum(radius, fisheye_radius(np.float64(widest), k))  # type: ignore[arg-type]
    low, high = np.zeros_like(target), np.full_like(target, widest)
    angle = np.minimum(target, widest)
    for _ in range(NEWTON_STEPS):
        missed, squared = fisheye_radius(angle, k) - target, angle * angle
        low, high = np.where(missed <= 0, angle, low), np.where(missed >= 0, angle, high)
        slope = 1.0 + squared * (3 * k[0] + squared * (5 * k[1] + squared * (7 * k[2] + squared * 9 * k[3])))
        newton = angle - missed / np.maximum(slope, 1e-12)
        closer = np.where((newton >= low) & (newton <= high), newton, (low + high) / 2)
        moved, angle = np.abs(closer - angle).max(initial=0.0), closer
        if moved < 1e-14:
            break
    return angle
