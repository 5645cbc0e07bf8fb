"""Which shipped denoiser fits what is known of a scene."""

from __future__ import annotations

from ..core.cameras import Cameras
from ..core.sparse_points import SparsePoints

# A model is chosen by itself only if it is no worse than `default` on every validation set. At the threshold that it
# ships with, `evidence` removes fewer of the solid floaters of the labelled rooms (docs/prior.md).
EVIDENCE_QUALIFIES = False


def choose_denoiser(cameras: Cameras | None, points: SparsePoints | None) -> str:
    """Name of the shipped denoiser for a call that names none.

    Args:
        cameras: of the training photos, or None.
        points: their sparse points, or None.

    Returns:
        ``"default"``, as long as ``"evidence"``, which would be chosen where there are cameras and points that they
        observed, does worse on any validation set. ``"views"`` is never chosen: it does worse with cameras than without
        where every ghost is visible to one.

    Example:
        >>> choose_denoiser(None, None)
        'default'
    """
    observed = cameras is not None and len(cameras) > 0 and points is not None and len(points.point) > 0
    return "evidence" if observed and EVIDENCE_QUALIFIES else "default"
