"""``cameras.json``, which the code of 3D Gaussian Splatting (Inria) and tools after it write beside a scene."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from ...core.errors import InvalidFile

FILE = "cameras.json"
KEYS = ("position", "rotation", "fx", "fy", "width", "height")


def cameras_as_frames(cameras: Sequence[Any], label: str) -> dict[str, Any]:
    """The list of an Inria ``cameras.json`` as the object of a ``transforms.json``.

    Each entry has ``position`` (centre), ``rotation`` (rows of camera-to-world, OpenCV axes: +Y down, looking along
    +Z), ``fx``, ``fy``, ``width`` and ``height`` in pixels, and ``img_name``. The principal point is the middle, and
    there is no distortion: the photos were undistorted.

    Args:
        cameras: entries of the file.
        label: name of the file, for an error.

    Raises:
        ValueError: an entry that lacks a key, or holds no numbers of the right shape.

    Example:
        >>> entry = {"id": 0, "img_name": "a", "width": 64, "height": 48, "fx": 60.0, "fy": 61.0,
        ...          "position": [1, 2, 3], "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}
        >>> frame, = cameras_as_frames([entry], "cameras.json")["frames"]
        >>> np.array(frame["transform_matrix"]).diagonal().tolist()  # looks along its -Z, which is +Z of the world
        [1.0, -1.0, -1.0, 1.0]
    """
    names = [each.get("img_name") if isinstance(each, dict) else None for each in cameras]
    times = Counter(names)
    frames = []
    for number, (each, name) in enumerate(zip(cameras, names)):
        lacking = [key for key in KEYS if not isinstance(each, dict) or key not in each]
        if lacking:
            raise InvalidFile(
                f"load_cameras: entry {number} of {label} has no {', '.join(lacking)}: a list must be Inria's "
                "cameras.json"
            )
        pose = np.eye(4)
        try:
            pose[:3, :3] = np.asarray(each["rotation"], dtype=np.float64) * np.array([1.0, -1.0, -1.0])
            pose[:3, 3] = np.asarray(each["position"], dtype=np.float64)
            lens = {"fl_x": float(each["fx"]), "fl_y": float(each["fy"])}
            size = {"w": int(each["width"]), "h": int(each["height"])}
        except (TypeError, ValueError):
            raise InvalidFile(
                f"load_cameras: entry {number} of {label} must hold a position of 3 numbers, a rotation of 3 x 3, "
                "and fx, fy, width and height"
            ) from None
        unique = isinstance(name, str) and times[name] == 1
        frames.append({"file_path": name if unique else f"{number}", **size, **lens, "transform_matrix": pose.tolist()})
    return {"frames": frames}
