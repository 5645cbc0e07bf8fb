"""COLMAP models in text form, and similarities between worlds."""

import numpy as np

from unghost.core.frames import random_rotations

TO_COLMAP = np.diag([1.0, -1.0, -1.0])


def motion(rng, scale):
    result = np.eye(4)
    result[:3, :3] = scale * random_rotations(rng, 1)[0]
    result[:3, 3] = rng.normal(size=3)
    return result


def moved(poses, similarity):
    """Poses in another world: their rotations stay rotations."""
    scale = np.linalg.norm(similarity[:3, 0])
    result = np.einsum("ij,njk->nik", similarity[:3, :3], poses)
    result[:, :, :3] /= scale
    result[:, :, 3] += similarity[:3, 3]
    return result


def quaternion(rotation):
    w = np.sqrt(max(0.0, 1 + np.trace(rotation))) / 2
    return w, *(
        np.array([rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]])
        / (4 * w)
    )


def write_model(folder, poses, names, points, tracks):
    """COLMAP's text model of cameras ``poses`` with a photo of 200 x 150."""
    folder.mkdir(parents=True)
    (folder / "cameras.txt").write_text("1 PINHOLE 200 150 180 180 100 75\n")
    lines = []
    for number, (pose, name) in enumerate(zip(poses, names), 1):
        turned = TO_COLMAP @ pose[:, :3].T
        values = [*quaternion(turned), *(-turned @ pose[:, 3])]
        lines.append(f"{number} {' '.join(map(repr, map(float, values)))} 1 {name}\n\n")
    (folder / "images.txt").write_text("".join(lines))
    rows = [
        f"{number} {' '.join(map(repr, map(float, xyz)))} 9 9 9 0.4 {' '.join(f'{camera + 1} 0' for camera in seen)}\n"
        for number, (xyz, seen) in enumerate(zip(points, tracks), 1)
    ]
    (folder / "points3D.txt").write_text("".join(rows))
