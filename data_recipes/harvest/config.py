"""What a harvest varies from scene to scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...core.errors import InvalidArgument

KINDS = ("dense", "hash", "mlp")  # of field, as fields.kinds has them


@dataclass(frozen=True)
class HarvestConfig:
    """What a harvest varies, each value drawn per scene.

    Attributes:
        kinds, shares: kinds of field, and how often each is drawn (relative to their sum). A frequency-encoded
            ``mlp`` is left out by default: it is there to be harvested for evaluation.
        resolutions: cells along an axis of the contracted cube (of the finest level, of half the shortest wavelength).
        photos: lowest and highest number of photos that a field sees.
        photo_width: lowest and highest width of a photo, pixels (4:3).
        observer_photos: views of a second sweep; only their depth is traced, for the labels: what no photo of either
            sweep sees is not judged.
        observer_width: width of those views, pixels (4:3).
        steps: fitting steps, log-uniform; cubes are also taken after ``EARLY`` of them.
        rays: rays a step.
        objects: how many meshes stand in a scene, where there is a folder of them.
        cubes: cubes per snapshot (two snapshots a scene).
        voxel_pitch: voxel side in field cells, log-uniform.
        rotated_share: share of cubes with a random rotation.
        room_pitch: voxel side of :func:`room_scene`'s cubes, scene units, log-uniform.
        point_sets: sets of simulated sparse points a snapshot (:mod:`unghost.scenes.sparse_points`), of very
            different numbers; each serves its share of the cubes. 0: the channels support and crossings are not stored.
        fewest_opaque: a fit has failed, and its scene is given up, if a smaller share of the surface is opaque.
        most_ghosts: the same if a larger share of what is opaque are ghosts.
    """

    kinds: tuple[str, ...] = ("dense", "hash")
    shares: tuple[float, ...] = (0.6, 0.4)
    resolutions: tuple[int, ...] = (64, 80, 96, 112, 128, 160)
    photos: tuple[int, int] = (12, 32)
    photo_width: tuple[int, int] = (80, 128)
    observer_photos: int = 16
    observer_width: int = 64
    steps: tuple[int, int] = (250, 900)
    rays: int = 1152
    objects: tuple[int, int] = (0, 5)
    cubes: int = 240
    voxel_pitch: tuple[float, float] = (0.5, 2.0)
    rotated_share: float = 0.5
    room_pitch: tuple[float, float] = (0.008, 0.05)
    point_sets: int = 4
    fewest_opaque: float = 0.1
    most_ghosts: float = 0.9

    def __post_init__(self) -> None:
        unknown = sorted(set(self.kinds) - set(KINDS))
        if unknown or not self.kinds or len(set(self.kinds)) < len(self.kinds):
            raise InvalidArgument(
                f"HarvestConfig: kinds must be different ones of {', '.join(KINDS)}, got {self.kinds}"
            )
        if len(self.shares) != len(self.kinds) or not all(0 < share < np.inf for share in self.shares):
            raise InvalidArgument(
                f"HarvestConfig: shares must be one finite number > 0 for each of {self.kinds}, got {self.shares}"
            )
        for name in ("photos", "photo_width", "steps", "voxel_pitch", "room_pitch"):
            low, high = getattr(self, name)
            if not 0 < low <= high:
                raise InvalidArgument(
                    f"HarvestConfig: {name} must be (low, high) with 0 < low <= high, got {(low, high)}"
                )
        if not 0 <= self.objects[0] <= self.objects[1]:
            raise InvalidArgument(
                f"HarvestConfig: objects must be (low, high) with 0 <= low <= high, got {self.objects}"
            )
        if min(self.rays, self.cubes) < 1:
            raise InvalidArgument(f"HarvestConfig: rays and cubes must be >= 1, got {self.rays} and {self.cubes}")
        if self.point_sets < 0:
            raise InvalidArgument(f"HarvestConfig: point_sets must be >= 0, got {self.point_sets}")
        if self.observer_photos < 0 or self.observer_width < 4:
            raise InvalidArgument(
                "HarvestConfig: observer_photos must be >= 0 and observer_width >= 4, got "
                f"{self.observer_photos} and {self.observer_width}"
            )
