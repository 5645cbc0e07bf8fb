"""How far an evaluation sweep is from the training photos: the paper's measure of a capture (its appendix A.1)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.cameras import Cameras
from ...core.errors import InvalidArgument

TIE = 1e-9  # in normalised units: nearer than that is the same place
TWO_SWEEPS = "the other sweep"
PUBLISHED = (("Nerfbusters", 0.62, 28.51), ("MipNeRF-360", 0.07, 10.49))  # the paper's table of datasets, in part


@dataclass(frozen=True, eq=False)
class Difficulty:
    """Of each evaluation view, against its nearest training view.

    Attributes:
        translation: ``(n,)`` distance between the origins, in units in which the farthest coordinate of any origin of
            both sweeps is 1 from their mean. 0 if the views are in one place.
        rotation_deg: ``(n,)`` angle in degrees, in [0, 180], between the two orientations (rolls count).
        nearest: ``(n,)`` which training view that is.
    """

    translation: NDArray[np.float64]
    rotation_deg: NDArray[np.float64]
    nearest: NDArray[np.int64]


def normalising_factor(*sweeps: Cameras) -> float:
    """What brings all origins, about their mean, into [-1, 1]: 1 over the farthest coordinate (1 if all are one place).

    As in nerfstudio it is the farthest *coordinate*, so it depends a little on how the world is turned.
    """
    origins = np.concatenate([cameras.origins for cameras in sweeps])
    reach = float(np.abs(origins - origins.mean(axis=0)).max()) if len(origins) else 0.0
    return 1.0 / reach if reach > 0 else 1.0


def difficulty(train: Cameras, evaluation: Cameras, *, factor: float | None = None) -> Difficulty:
    """Translation and rotation from each evaluation view to the nearest training view.

    Nearest is meant by position; among training views in the same place, the one that looks most alike. The mean over
    the views is what the paper tabulates. Differences of lenses do not count.

    Args:
        train, evaluation: in one world, any unit.
        factor: normalised units for one unit of that world; None: :func:`normalising_factor` of both sweeps.

    Raises:
        ValueError: a sweep without cameras.
    """
    for name, cameras in (("train", train), ("evaluation", evaluation)):
        if len(cameras) == 0:
            raise InvalidArgument(f"difficulty: {name} has no cameras: the measure is not defined")
    unit = normalising_factor(train, evaluation) if factor is None else factor
    distance = np.linalg.norm(evaluation.origins[:, None] - train.origins[None], axis=-1) * unit
    turned = evaluation.camera_to_world[:, None, :, :3] - train.camera_to_world[None, :, :, :3]
    # |R - R'| = 2 sqrt(2) sin(angle / 2); exact at 0, where the arc cosine of the trace is not
    half_sine = np.clip(np.linalg.norm(turned, axis=(-2, -1)) / np.sqrt(8.0), 0.0, 1.0)
    angle = np.degrees(2.0 * np.arcsin(half_sine))
    same_place = distance <= distance.min(axis=1, keepdims=True) + TIE
    nearest = np.where(same_place, angle, np.inf).argmin(axis=1)
    views = np.arange(len(evaluation))
    return Difficulty(distance[views, nearest], angle[views, nearest], nearest)


def every_nth(count: int, *, n: int = 8) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The split that the paper argues against: every n-th photo of one sweep, from the first on, is held out.

    Args:
        count: photos of the sweep, in the order in which they were taken.
        n: at least 2.

    Returns:
        positions that train, positions that are scored. The first is empty if there is but one photo.
    """
    if n < 2 or count < 0:
        raise InvalidArgument(f"every_nth: count must be >= 0 and n >= 2, got {count} and {n}")
    everything = np.arange(count)
    return everything[everything % n != 0], everything[everything % n == 0]


def difficulty_rows(train: Cameras, evaluation: Cameras, *, n: int = 8) -> list[dict[str, Any]]:
    """A results row for the two sweeps and, if it has two photos or more, one for every n-th photo of ``train``.

    Both are in the units of the two sweeps together, so that they compare.
    """
    unit = normalising_factor(train, evaluation)
    rows = [_row(TWO_SWEEPS, difficulty(train, evaluation, factor=unit), len(train))]
    taught, held_out = every_nth(len(train), n=n)
    if len(taught):
        found = difficulty(train.select(taught), train.select(held_out), factor=unit)
        rows.append(_row(f"every {n}th training photo", found, len(taught)))
    return rows


def _row(method: str, found: Difficulty, train_photos: int) -> dict[str, Any]:
    return {
        "method": method,
        "train_photos": train_photos,
        "photos": len(found.nearest),
        "translation_to_nearest": float(found.translation.mean()),
        "translation_to_nearest_largest": float(found.translation.max()),
        "rotation_to_nearest_deg": float(found.rotation_deg.mean()),
        "rotation_to_nearest_deg_largest": float(found.rotation_deg.max()),
    }


def difficulty_text(rows: Sequence[Mapping[str, Any]]) -> str:
    """The rows of :func:`difficulty_rows` as a table to print, and what must be said of them."""
    lines = [f"{'scored on':<26} {'photos':>6} {'translation (largest)':>23} {'rotation (largest)':>23}"]
    for row in rows:
        translation = f"{row['translation_to_nearest']:.3f} ({row['translation_to_nearest_largest']:.3f})"
        rotation = f"{row['rotation_to_nearest_deg']:.1f} ({row['rotation_to_nearest_deg_largest']:.1f}) deg"
        lines.append(f"{row['method']:<26} {row['photos']:>6} {translation:>23} {rotation:>23}")
    lines += [f"{'paper: ' + name:<26} {'':>6} {moved:>15.2f} {turned:>21.1f}" for name, moved, turned in PUBLISHED]
    lines.append("means over the scored photos, to the nearest training view; all cameras of both sweeps in [-1, 1]")
    if rows[0]["translation_to_nearest_largest"] <= TIE:
        lines.append("every evaluation view stands where a training photo was taken: this is no test of novel views")
    return "\n".join(lines)
