"""Scenes of the two-trajectory benchmark: synthetic ones, of which everything is known, and real captures."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from unghost.core.cameras import Cameras
from unghost.core.occupancy import FREE_LABEL, SURFACE_LABEL, OccupancyRule, opacity_from_density
from unghost.core.sparse_points import SparsePoints
from unghost.data_recipes.harvest.labels import Truth as Labels
from unghost.evaluation.captures.difficulty import every_nth
from unghost.evaluation.captures.loading import Capture, load_capture
from unghost.evaluation.scoring.conventions import SceneExtent
from unghost.evaluation.scoring.depths import ray_depth
from unghost.evaluation.scoring.pseudo_truth import PseudoTruth, make_pseudo_truth
from unghost.evaluation.scoring.views import Truth
from unghost.fields.rendering import Sampling
from unghost.scenes.generator import PhotographedScene, photograph, photograph_again, random_scene

RULE = OccupancyRule()
POINTS = 300_000  # at which labelled opacity is asked for
FEWEST_SEEN = 0.5  # of an evaluation sweep's pixels must show what the training sweep saw
DepthOf = Callable[[Cameras], NDArray[Any]]


@dataclass(frozen=True)
class Sweep:
    """Cameras and photos ``(n, H, W, 3)``."""

    cameras: Cameras
    photos: NDArray[np.float32]

    def digest(self) -> str:
        """Of every pixel and every number of the cameras."""
        arrays = (self.photos, self.cameras.camera_to_world, self.cameras.intrinsics, self.cameras.distortion)
        return hashlib.sha256(b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)).hexdigest()

    def joined(self, other: Sweep) -> Sweep:
        """Both sweeps."""
        first, second = self.cameras, other.cameras
        parts = [
            np.concatenate([getattr(first, name), getattr(second, name)])
            for name in ("camera_to_world", "intrinsics", "sizes", "distortion", "fisheye")
        ]
        cameras = Cameras.create(parts[0], parts[1], *parts[2].T, *parts[3:])
        return Sweep(cameras, np.concatenate([self.photos, other.photos]))


@dataclass(frozen=True)
class TrajectoryScene:
    """What a method is trained on and scored on.

    Attributes:
        name: of the scene.
        train, evaluation: the two sweeps.
        resolution: of the grid that is fitted.
        sampling: along its rays.
        rays: of a training step.
        photographed, again: what is known of a synthetic scene; None for a capture.
        points: sparse points of the training photos alone, in the frame of ``train.cameras``, whose positions their
            observations use; None as long as nobody asked for them (``points.py``).
        capture, taught, held_out: a capture, and the positions of its training and its evaluation photos in it; None
            for a synthetic scene.
        split: the capture's name of the training sweep; empty where only some of its photos are trained on.
    """

    name: str
    train: Sweep
    evaluation: Sweep
    resolution: int
    sampling: Sampling
    rays: int
    photographed: PhotographedScene | None = None
    again: PhotographedScene | None = None
    points: SparsePoints | None = None
    capture: Capture | None = None
    taught: NDArray[np.int64] | None = None
    held_out: NDArray[np.int64] | None = None
    split: str = ""

    @property
    def extent(self) -> SceneExtent:
        """Its lengths."""
        return SceneExtent.of(self.train.cameras, self.evaluation.cameras)

    def every_nth(self, n: int = 8) -> TrajectoryScene:
        """What most papers score: every n-th photo of the training sweep, which then does not train.

        The points go: those of the photos that are left are triangulated anew.
        """
        taught, held_out = every_nth(len(self.train.photos), n=n)
        parts = [Sweep(self.train.cameras.select(chosen), self.train.photos[chosen]) for chosen in (taught, held_out)]
        first = self.photographed
        known = [None, None] if first is None else [_selected(first, chosen) for chosen in (taught, held_out)]
        return dataclasses.replace(
            self,
            train=parts[0],
            evaluation=parts[1],
            photographed=known[0],
            again=known[1],
            points=None,
            taught=None if self.taught is None else self.taught[taught],
            held_out=None if self.taught is None else self.taught[held_out],
            split="",
        )

    def pseudo(self, depth_of: DepthOf) -> PseudoTruth:
        """Maps of the evaluation views: exact where everything is known, else by ``depth_of`` (along unit rays)."""
        train, seen = self.train.cameras, self.evaluation.cameras
        if self.photographed is None or self.again is None:
            return make_pseudo_truth(seen, train, depth_of(seen), train_depth=depth_of(train))
        first, again = self.photographed, self.again
        seen = again.true_cameras  # not what a held-out photo is told to be of
        depth = ray_depth(again.depth_maps, seen)
        normals = np.full((*depth.shape, 3), np.nan)
        for index in range(len(seen)):
            hit = np.isfinite(depth[index])
            origins, directions = seen.rays(index)
            normals[index][hit] = again.scene.normals((origins + directions * depth[index][..., None])[hit])
        shown = ray_depth(first.depth_maps, first.true_cameras)
        return make_pseudo_truth(seen, first.true_cameras, depth, normals=normals, train_depth=shown)

    def truth(self, pseudo: PseudoTruth) -> Truth:
        """What is scored against: occlusion counts."""
        return pseudo.truth(self.evaluation.photos, occlusion=True)


def _selected(photographed: PhotographedScene, chosen: NDArray[Any]) -> PhotographedScene:
    """Some of the photos."""
    return dataclasses.replace(
        photographed,
        cameras=photographed.cameras.select(chosen),
        true_cameras=photographed.true_cameras.select(chosen),
        images=photographed.images[chosen],
        depth_maps=photographed.depth_maps[chosen],
    )


class LabelledSpace:
    """Random points of a synthetic scene: which are true surface, which free space, by a field before its clean-up."""

    def __init__(self, scene: TrajectoryScene, field: Any, seed: int) -> None:
        if scene.photographed is None or scene.again is None:
            raise ValueError("LabelledSpace: only synthetic scenes have labels")
        rng = np.random.default_rng([seed, 77])
        self.pitch = field.field_pitch
        labels = Labels(scene.photographed, field.aabb, observers=(scene.again.cameras, scene.again.depth_maps))
        self.points = rng.uniform(field.aabb[0], field.aabb[1], (POINTS, 3))
        self.opaque = self.opacity(field) > RULE.threshold
        nothing = np.zeros((1, POINTS), dtype=bool)
        found = labels.labels(self.points[None], self.pitch, self.opaque[None], nothing)[0]
        self.free, self.surface = found == FREE_LABEL, found == SURFACE_LABEL

    def opacity(self, field: Any) -> NDArray[np.float64]:
        """Of a cell of the first field at each point."""
        with torch.no_grad():
            density = field.density_fn(torch.from_numpy(self.points).float())[:, 0].numpy()
        return np.asarray(opacity_from_density(density.astype(np.float64), self.pitch))

    def scores(self, field: Any) -> dict[str, float | None]:
        """Shares of all points of a kind, and the mean opacity of a cell of free space.

        ``floater_recall``: of what was opaque in free space, no longer opaque; ``surface_kept``: of true surface that
        was opaque, still opaque; ``holes_filled``: of true surface that was not, opaque now; ``free_space_error``.
        """
        after = self.opacity(field)
        now = after > RULE.threshold

        def share(values: NDArray[Any], chosen: NDArray[np.bool_]) -> float | None:
            return float(values[chosen].mean()) if chosen.any() else None

        return {
            "floater_recall": share(~now, self.free & self.opaque),
            "surface_kept": share(now, self.surface & self.opaque),
            "holes_filled": share(now, self.surface & ~self.opaque),
            "free_space_error": share(after, self.free),
        }


def synthetic_scene(
    seed: int, name: str, *, photos: int = 20, views: int = 10, width: int = 96, resolution: int = 96
) -> TrajectoryScene:
    """A random room or some objects on a floor, photographed twice.

    Args:
        seed: of all scenes.
        name: ``room-N`` or ``objects-N``: what the seed's scene N is.
        photos, views: of the training and of the evaluation sweep.
        width: of the photos, 4 : 3.
        resolution: of the grid that will be fitted.

    Raises:
        ValueError: scene N is of the other kind, nobody can walk through it twice, or the second sweep sees little of
            what the first one saw.
    """
    number = int(name.rpartition("-")[2])
    rng = np.random.default_rng([seed, number])
    try:
        first = photograph(rng, random_scene(rng), count=photos, width=width, height=width * 3 // 4)
        again = photograph_again(np.random.default_rng([seed, number, 1]), first, count=views)
    except RuntimeError as error:
        raise ValueError(f"synthetic_scene: {name} of seed {seed} has no two free paths ({error})") from None
    kind = "room" if any(solid.inside_out for solid in first.scene.solids) else "objects"
    if name != f"{kind}-{number}":
        raise ValueError(f"synthetic_scene: scene {number} of seed {seed} is {kind}-{number}, not {name}")
    samples = max(48, round(2.4 * (resolution - 1) / 4))
    sampling = Sampling(near_samples=samples, far_samples=max(12, samples // 4))
    scene = TrajectoryScene(
        name,
        Sweep(first.cameras, first.images),
        Sweep(again.cameras, again.images),
        resolution,
        sampling,
        1152,
        first,
        again,
    )
    seen = float(scene.pseudo(lambda cameras: np.zeros(0)).visible(occlusion=True).mean())
    if seen < FEWEST_SEEN:
        raise ValueError(f"synthetic_scene: {seen:.2f} of {name}'s second sweep was seen by its first, too little")
    return scene


def captured_scene(folder: Path, train: str, evaluation: str, *, downscale: float) -> TrajectoryScene:
    """A real capture."""
    capture = load_capture(folder, downscale=downscale)
    taught, held_out = capture.split(train), capture.split(evaluation)
    if set(taught.tolist()) & set(held_out.tolist()):
        raise ValueError(f"{train} and {evaluation} share photos")
    first, second = (Sweep(capture.cameras.select(chosen), capture.images(chosen)) for chosen in (taught, held_out))
    name = f"{folder.resolve().name} {train} to {evaluation} at 1:{downscale:g}"
    known: dict[str, Any] = {"capture": capture, "taught": taught, "held_out": held_out, "split": train}
    return TrajectoryScene(name, first, second, 160, Sampling(), 4096, **known)
