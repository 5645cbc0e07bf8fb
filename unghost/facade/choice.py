"""Which shipped denoiser fits what is known of a scene."""

from __future__ import annotations

from ..core.cameras import Cameras
from ..core.sparse_points import SparsePoints
from ..denoisers import shipped_names


def choose_denoiser(cameras: Cameras | None, points: SparsePoints | None) -> str:
    """Name of the shipped denoiser for a call that names none.

    Args:
        cameras: of the training photos, or None.
        points: their sparse points, or None.

    Returns:
        ``"evidence"`` where there are cameras and points that they observed, else ``"default"``. View counts alone
        choose nothing: ``"views"`` does worse with cameras than without where every ghost is visible to one.

    Example:
        >>> choose_denoiser(None, None)
        'default'
    """
    observed = cameras is not None and len(cameras) > 0 and points is not None and len(points.point) > 0
    return "evidence" if observed and "evidence" in shipped_names() else "default"
