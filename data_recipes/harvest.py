"""Harvested pairs: cubes of badly constrained fields, beside the truth of the scenes they were fitted to.

A radiance field is fitted to a few photos of a synthetic scene; cubes of its opacity are inputs, the
scene's signed distance gives three-valued labels:

    surface  within three quarters of a field cell of a surface that some training photo sees, and what is
             opaque up to four cells behind such a surface: a field spreads a surface over several of its cells,
             and what lies behind the front is part of what makes it opaque
    free     more than one and a half cells outside every solid: whatever is opaque there is a ghost
    ignore   the rest of solids and walls, surfaces that no photo sees, the band between, outside the box
"""

from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..core.aabb import contains, scene_extent
from ..core.frames import RESOLUTION, CubeFrame, cube_lattices, random_rotations
from ..core.occupancy import (
    DEFAULT_OPACITY_THRESHOLD,
    EMPTY,
    FREE_LABEL,
    IGNORE_LABEL,
    SURFACE_LABEL,
    opacity_from_density,
    opacity_from_signed,
    signed_from_opacity,
)
from ..core.shards import (
    dequantize_signed,
    pack_labels,
    quantize_signed,
    read_shard,
    unpack_labels,
    write_shard,
)

if TYPE_CHECKING:
    from ..fields.radiance import RadianceField
    from ..fields.scenes import PhotographedScene

SURFACE_BAND, FREE_BAND, BEHIND_BAND = 0.75, 1.5, 4.0  # in field cells
EARLY = 0.45  # share of the fit at which the first cubes are taken


@dataclass(frozen=True)
class HarvestConfig:
    """What a harvest varies, each value drawn per scene.

    Attributes:
        resolutions: density nodes along an axis of the contracted cube.
        photos, photo_width: how many photos a field sees, and their width in pixels (4:3).
        steps: fitting steps, log-uniform; cubes are also taken after ``EARLY`` of them.
        rays: rays a step.
        cubes: cubes per snapshot (two snapshots a scene).
        voxel_pitch: voxel side in field cells, log-uniform.
        rotated_share: share of cubes with a random rotation.
        room_pitch: voxel side of :func:`room_scene`'s cubes, scene units, log-uniform.
        fewest_opaque, most_ghosts: a fit has failed, and its scene is given up, if a smaller share of the surface is
            opaque, or a larger share of what is opaque are ghosts.
    """

    resolutions: tuple[int, ...] = (64, 80, 96, 112, 128, 160)
    photos: tuple[int, int] = (12, 32)
    photo_width: tuple[int, int] = (80, 128)
    steps: tuple[int, int] = (250, 900)
    rays: int = 1152
    cubes: int = 144
    voxel_pitch: tuple[float, float] = (0.5, 2.0)
    rotated_share: float = 0.5
    room_pitch: tuple[float, float] = (0.008, 0.05)
    fewest_opaque: float = 0.1
    most_ghosts: float = 0.9

    def __post_init__(self) -> None:
        for name in ("photos", "photo_width", "steps", "voxel_pitch", "room_pitch"):
            low, high = getattr(self, name)
            if not 0 < low <= high:
                raise ValueError(f"HarvestConfig: {name} must be (low, high) with 0 < low <= high, got {(low, high)}")
        if min(self.rays, self.cubes) < 1:
            raise ValueError(f"HarvestConfig: rays and cubes must be >= 1, got {self.rays} and {self.cubes}")


class Truth:
    """The labels of a photographed scene; a coarse grid of exact distances settles most points.

    A signed distance changes by no more than one goes, so that a node far from any surface speaks for its cell.
    """

    def __init__(self, photographed: PhotographedScene, aabb: NDArray[np.float64], *, nodes: int = 64) -> None:
        self.photographed, self.aabb = photographed, aabb
        axes = [np.linspace(aabb[0, axis], aabb[1, axis], nodes) for axis in range(3)]
        self._coarse = photographed.scene.signed_distance(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1))
        self._cell = (aabb[1] - aabb[0]) / (nodes - 1)

    def distances(self, points: NDArray[np.float64], margin: float | NDArray[np.float64]) -> NDArray[np.float64]:
        """Signed distance of ``points (N, 3)``: exact where it is at most ``margin``, else some value beyond it.

        ``margin`` is one number or one for each point ``(N,)``.
        """
        index = np.rint((points - self.aabb[0]) / self._cell).astype(np.int64)
        index = np.clip(index, 0, np.array(self._coarse.shape) - 1)
        distance: NDArray[np.float64] = self._coarse[index[:, 0], index[:, 1], index[:, 2]]
        slack = np.linalg.norm(points - (self.aabb[0] + index * self._cell), axis=1)
        close = np.flatnonzero(np.abs(distance) - slack <= margin)
        distance[close] = self.photographed.scene.signed_distance(points[close])
        return distance

    def labels(
        self, positions: NDArray[np.float64], field_pitch: float, opaque: NDArray[np.bool_]
    ) -> NDArray[np.uint8]:
        """Three-valued labels ``(...)`` of world ``positions (..., 3)``, ``opaque (...)`` in the field or not."""
        labels = np.full(positions.shape[:-1], IGNORE_LABEL, dtype=np.uint8)
        inside = contains(self.aabb, positions)
        flat = positions[inside]
        distance = self.distances(flat, np.where(opaque[inside], BEHIND_BAND, FREE_BAND) * field_pitch)
        found = np.full(len(flat), IGNORE_LABEL, dtype=np.uint8)
        found[distance > FREE_BAND * field_pitch] = FREE_LABEL
        near = np.abs(distance) <= SURFACE_BAND * field_pitch
        behind = opaque[inside] & (distance < 0) & (distance >= -BEHIND_BAND * field_pitch) & ~near
        for band, reach in ((near, 2.0), (behind, 2.0 + BEHIND_BAND)):
            chosen = np.flatnonzero(band)
            found[chosen[self._seen(flat[chosen], reach * field_pitch)]] = SURFACE_LABEL
        labels[inside] = found
        return labels

    def _seen(self, points: NDArray[np.float64], reach: float) -> NDArray[np.bool_]:
        """Whether some photo shows ``points (N, 3)``, or a surface at most ``reach`` in front of them."""
        relaxed = self.photographed.depth_maps + reach
        seen: NDArray[np.bool_] = (
            self.photographed.true_cameras.view_count(points, depth_maps=relaxed, tolerance=0.02) > 0
        )
        return seen


def severity_of(inputs: NDArray[np.float32], labels: NDArray[np.uint8]) -> NDArray[np.float32]:
    """One minus the IoU of opaque input and surface label over voxels that count: ``(N,)`` in [0, 1]."""
    valid = labels != IGNORE_LABEL
    opaque = (opacity_from_signed(inputs) > DEFAULT_OPACITY_THRESHOLD) & valid
    surface = labels == SURFACE_LABEL
    union = (opaque | surface).sum(axis=(1, 2, 3))
    both = (opaque & surface).sum(axis=(1, 2, 3))
    return (1.0 - np.where(union > 0, both / np.maximum(union, 1), 1.0)).astype(np.float32)


def check_fit(inputs: NDArray[np.float32], labels: NDArray[np.uint8], config: HarvestConfig) -> None:
    """Raise RuntimeError if a field's cubes (both ``(N, R, R, R)``) hold too little surface, or too many ghosts."""
    opaque = opacity_from_signed(inputs) > DEFAULT_OPACITY_THRESHOLD
    surface = labels == SURFACE_LABEL
    true, ghosts = int((opaque & surface).sum()), int((opaque & (labels == FREE_LABEL)).sum())
    if true < config.fewest_opaque * surface.sum():
        raise RuntimeError(f"failed fit: {true / surface.sum():.0%} of the surface is opaque")
    if ghosts > config.most_ghosts * (true + ghosts):
        raise RuntimeError(f"failed fit: {ghosts / (true + ghosts):.0%} of what is opaque are ghosts")


def _propose(rng: np.random.Generator, field: RadianceField, count: int) -> NDArray[np.float64]:
    """Cube centres ``(count, 3)`` in the field's box: nine in ten where it is opaque, the rest anywhere."""
    import torch

    aabb = field.aabb
    candidates = rng.uniform(aabb[0], aabb[1], size=(60_000, 3))
    with torch.no_grad():
        density = field.density_fn(torch.from_numpy(candidates).float()).numpy()[:, 0]
    opacity = opacity_from_density(density, field.field_pitch)
    weight = np.where(opacity > DEFAULT_OPACITY_THRESHOLD, 1.0, 0.02 * opacity) + 1e-6
    chosen = rng.choice(len(candidates), size=count, p=weight / weight.sum())
    anywhere = rng.random(count) < 0.1
    chosen[anywhere] = rng.integers(len(candidates), size=int(anywhere.sum()))
    return candidates[chosen]


def harvest_cubes(
    rng: np.random.Generator, field: RadianceField, truth: Truth, config: HarvestConfig
) -> dict[str, NDArray[Any]]:
    """Cut ``config.cubes`` cubes out of a fitted field and label them: a shard's arrays, less ``group``."""
    import torch

    count = config.cubes
    centers = _propose(rng, field, count)
    low, high = np.log(config.voxel_pitch)
    pitches = field.field_pitch * np.exp(rng.uniform(low, high, size=count))
    edges = pitches * RESOLUTION
    rotations = random_rotations(rng, count)
    rotations[rng.random(count) >= config.rotated_share] = np.eye(3)
    lattice = cube_lattices(centers, edges, rotations)
    with torch.no_grad():
        density = field.density_fn(torch.from_numpy(lattice).float()).numpy()[..., 0]
    assumed_pitch = field.field_pitch * np.exp(rng.uniform(-0.3, 0.3, size=(count, 1, 1, 1)))
    inputs = signed_from_opacity(opacity_from_density(density, assumed_pitch)).astype(np.float32)
    inputs[~contains(field.aabb, lattice)] = EMPTY
    opaque = opacity_from_signed(inputs) > DEFAULT_OPACITY_THRESHOLD
    labels = truth.labels(lattice, field.field_pitch, opaque)
    return {
        "inputs": quantize_signed(inputs),
        "labels": pack_labels(labels),
        "severity": severity_of(inputs, labels),
        "edge_fraction": (edges / scene_extent(field.aabb)).astype(np.float32),
    }


def harvest_scene(seed: int, index: int, config: HarvestConfig) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Build, photograph, fit and cut scene ``index``: shard arrays and provenance. Depends on (seed, index) alone."""
    from ..fields.radiance import RadianceConfig, RadianceField
    from ..fields.rendering import Sampling
    from ..fields.scenes import photograph, random_scene
    from ..fields.training import TrainingConfig, train_field

    rng = np.random.default_rng([seed, index])
    width = int(rng.integers(config.photo_width[0], config.photo_width[1] + 1))
    photos = int(rng.integers(config.photos[0], config.photos[1] + 1))
    photographed = photograph(rng, random_scene(rng), count=photos, width=width, height=width * 3 // 4)
    resolution = int(rng.choice(config.resolutions))
    steps = int(np.exp(rng.uniform(*np.log(config.steps))))
    opacity = float(np.exp(rng.uniform(np.log(0.002), np.log(0.03))))
    field = RadianceField(RadianceConfig(resolution, max(48, resolution * 3 // 4), opacity))
    samples = max(48, round(2.4 / field.field_pitch))
    fitting = TrainingConfig(
        rays=config.rays,
        distortion_weight=float(rng.choice([0.0, 0.002, 0.01])),
        sampling=Sampling(near_samples=samples, far_samples=max(12, samples // 4)),
    )
    truth = Truth(photographed, field.aabb)
    parts: list[dict[str, NDArray[Any]]] = []

    def snapshot(fitted: RadianceField, step: int) -> None:
        if step == round(EARLY * steps):
            parts.append(harvest_cubes(rng, fitted, truth, config))

    report = train_field(
        field, photographed.cameras, photographed.images, steps=steps, seed=index, config=fitting, regularizer=snapshot
    )
    parts.append(harvest_cubes(rng, field, truth, config))
    arrays = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    arrays["group"] = np.full(len(arrays["inputs"]), index, dtype=np.int32)
    check_fit(dequantize_signed(arrays["inputs"]), unpack_labels(arrays["labels"]), config)
    provenance = {
        "recipe": "harvest", "seed": seed, "scene": index, "photos": photos, "photo_width": width, "steps": steps,
        "field": "dense grid", "resolution": resolution, "psnr": round(float(report["psnr"]), 3),
        "config": dataclasses.asdict(config), "licence": "generated",
    }  # fmt: skip
    return arrays, provenance


def room_scene(seed: int, index: int, config: HarvestConfig) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Cubes of scene ``index`` as a perfect field would show them, with synthetic corruption; nothing is fitted.

    Whole rooms at the pitch of a field's cells: several things in a cube, thin legs, walls.
    """
    from ..fields.scenes import random_scene
    from .compose import shell_from_distance
    from .curate import damage
    from .recipe import load_recipe

    rng, recipe = np.random.default_rng([seed, index, 1]), load_recipe("rooms")
    scene, aabb = random_scene(rng), np.array([[-1.0] * 3, [1.0] * 3])
    count = config.cubes
    low, high = np.log(config.room_pitch)
    edges = RESOLUTION * np.exp(rng.uniform(low, high, size=count))
    candidates = rng.uniform(aabb[0], aabb[1], size=(12 * count, 3))
    close = np.abs(scene.signed_distance(candidates)) < 0.1
    centers = np.concatenate([candidates[close], candidates[~close]])[:count]
    rotations = random_rotations(rng, count)
    rotations[rng.random(count) >= config.rotated_share] = np.eye(3)
    pairs = []
    for center, edge, rotation in zip(centers, edges, rotations):
        distance = scene.signed_distance(CubeFrame(center, float(edge), rotation).lattice())
        clean = shell_from_distance(distance, thickness=float(rng.uniform(*recipe.shell_thickness)))
        clean |= (distance < 0) & (rng.random() < recipe.solid_share)
        pairs.append(damage(rng, clean, recipe))
    arrays: dict[str, NDArray[Any]] = {
        "inputs": quantize_signed(np.stack([signed for signed, _, _ in pairs])),
        "labels": pack_labels(np.stack([labels for _, labels, _ in pairs])),
        "severity": np.array([severity for _, _, severity in pairs], dtype=np.float32),
        "edge_fraction": (edges / scene_extent(aabb)).astype(np.float32),
        "group": np.full(count, index, dtype=np.int32),
    }
    provenance: dict[str, Any] = {"recipe": "rooms", "seed": seed, "scene": index, "config": dataclasses.asdict(config)}
    return arrays, provenance | {"licence": "generated"}


def _work(folder: str, seed: int, index: int, config: HarvestConfig, fit: bool) -> tuple[int, str]:
    try:
        if fit:
            import torch

            torch.set_num_threads(1)
        arrays, provenance = (harvest_scene if fit else room_scene)(seed, index, config)
    except RuntimeError as error:  # a scene without a free path, a failed fit; reported, not fatal
        return index, str(error)
    write_shard(Path(folder) / f"scene-{index:05d}", arrays, provenance)
    return index, ""


def harvest(
    out: str | Path,
    *,
    scenes: int,
    seed: int = 0,
    first: int = 0,
    workers: int = 1,
    config: HarvestConfig | None = None,
    fit: bool = True,
    progress: bool = False,
    log: Callable[[str], None] | None = None,
) -> int:
    """Harvest scenes ``first .. first + scenes - 1``, one shard each; those already there are skipped.

    A run can be killed at any time and started again. Without ``fit``, cubes are of perfect fields with synthetic
    corruption (:func:`room_scene`): quick, and needs no torch. ``log`` hears of scenes that were given up.

    Returns:
        The number of pairs now in ``out``.
    """
    from tqdm import tqdm

    folder, config = Path(out), config or HarvestConfig()
    if scenes < 1 or workers < 1:
        raise ValueError(f"harvest: scenes and workers must be >= 1, got {scenes} and {workers}")
    folder.mkdir(parents=True, exist_ok=True)
    todo = [index for index in range(first, first + scenes) if not (folder / f"scene-{index:05d}").exists()]
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    started = time.perf_counter()
    with (
        ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool,
        tqdm(total=len(todo), disable=not progress, unit="scene") as bar,
    ):
        for index, problem in (
            pool.map(_work, *zip(*((str(folder), seed, index, config, fit) for index in todo))) if todo else ()
        ):
            if problem and log is not None:
                log(f"scene {index}: {problem}")
            bar.update(1)
    if log is not None:
        log(f"{len(todo)} scenes in {time.perf_counter() - started:.0f} s")
    return sum(len(read_shard(path)) for path in sorted(folder.glob("scene-*")) if path.suffix != ".partial")
