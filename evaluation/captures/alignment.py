"""The similarity between two worlds in which the same cameras are known."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...core.errors import InvalidFile

MOST_ANGLE = 2.0  # degrees between a camera and its aligned counterpart, in the median
MOST_OFFSET = 0.02  # of the extent of the cameras' positions, the same


def align_poses(source: NDArray[np.float64], target: NDArray[np.float64], *, label: str) -> NDArray[np.float64]:
    """Estimate the similarity that takes the poses of some cameras in one world to theirs in another.

    The rotation is the mean of the cameras' own (so that a straight path determines it too), the scale and the shift
    are those of least squares over their positions.

    Args:
        source, target: ``(N, 3, 4)`` camera-to-world of the same cameras, N >= 2.
        label: names the source in errors.

    Returns:
        ``(4, 4)`` from the world of ``source`` to that of ``target``.

    Raises:
        InvalidFile: fewer than two cameras, all in one place, or poses that no similarity takes to each other.

    Example:
        >>> poses = np.concatenate([np.tile(np.eye(3), (2, 1, 1)), np.array([[[0.0], [0], [0]], [[1.0], [0], [0]]])], 2)
        >>> moved = poses.copy()
        >>> moved[:, :, 3] = 2 * poses[:, :, 3] + 1
        >>> align_poses(poses, moved, label="model").diagonal().round(6).tolist()
        [2.0, 2.0, 2.0, 1.0]
    """
    first, second = source[:, :, 3], target[:, :, 3]
    spread = first - first.mean(axis=0)
    if len(source) < 2 or not np.linalg.norm(spread, axis=1).max() > 0:
        raise InvalidFile(f"{label}: at least two photos from different places must be among the cameras")
    left, _, right = np.linalg.svd(np.einsum("nij,nkj->ik", target[:, :, :3], source[:, :, :3]))
    rotation = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    turned = spread @ rotation.T
    scale = float((turned * (second - second.mean(axis=0))).sum() / (turned**2).sum())
    motion = np.eye(4)
    motion[:3, :3] = scale * rotation
    motion[:3, 3] = second.mean(axis=0) - scale * rotation @ first.mean(axis=0)
    cosine = (
        np.trace(np.einsum("nji,jk,nkl->nil", target[:, :, :3], rotation, source[:, :, :3]), axis1=1, axis2=2) - 1
    ) / 2
    angle = float(np.median(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))))
    offset = np.linalg.norm(first @ motion[:3, :3].T + motion[:3, 3] - second, axis=1)
    extent = float(np.linalg.norm(np.ptp(second, axis=0)))
    if not scale > 0 or angle > MOST_ANGLE or np.median(offset) > MOST_OFFSET * extent:
        raise InvalidFile(
            f"{label}: its photos are posed otherwise than the cameras ({angle:.1f} degrees and "
            f"{np.median(offset) / max(extent, 1e-300):.1%} of their extent apart in the median): "
            "it must be the model that the cameras come from"
        )
    return motion
