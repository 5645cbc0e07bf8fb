"""Cubes of synthetic rooms as a perfect field would show them; and which meshes stand in a scene."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ...core.aabb import scene_extent
from ...core.frames import RESOLUTION, CubeFrame, random_rotations
from ...core.shards.packing import pack_labels, quantize_signed
from .config import HarvestConfig
from .labels import Geometry

if TYPE_CHECKING:
    from ...core.distances.sampled import SampledDistance

OBJECT_STREAM = 0x6F626A  # keeps the choice of meshes apart from a scene's own generator


def draw_objects_of(
    seed: int, index: int, config: HarvestConfig, mesh_root: str | Path | None
) -> tuple[list[SampledDistance], list[dict[str, Any]]]:
    """The meshes of a scene, drawn apart from all else; none without a folder."""
    if mesh_root is None:
        return [], []
    from ..meshes.objects import draw_objects

    rng = np.random.default_rng([seed, index, OBJECT_STREAM])
    return draw_objects(rng, mesh_root, int(rng.integers(config.objects[0], config.objects[1] + 1)))


def room_cubes(rng: np.random.Generator, scene: Geometry, config: HarvestConfig) -> dict[str, NDArray[Any]]:
    """Cubes of a scene as a perfect field would show it, with synthetic corruption: a shard's arrays, less ``group``.

    Whole rooms at the pitch of a field's cells: several things in a cube, thin legs, walls.
    """
    from ..curation import damage
    from ..recipe import load_recipe
    from ..solids.compose import shell_from_distance

    recipe, aabb = load_recipe("rooms"), np.array([[-1.0] * 3, [1.0] * 3])
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
    return {
        "inputs": quantize_signed(np.stack([signed for signed, _, _ in pairs])),
        "labels": pack_labels(np.stack([labels for _, labels, _ in pairs])),
        "severity": np.array([severity for _, _, severity in pairs], dtype=np.float32),
        "edge_fraction": (edges / scene_extent(aabb)).astype(np.float32),
        "frames": np.concatenate([centers, edges[:, None], rotations.reshape(count, 9)], axis=1),
    }
