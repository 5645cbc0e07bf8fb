"""The cubes of the reference measurement: nothing in them was trained on."""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unghost.core.occupancy import (
    FREE_LABEL,
    IGNORE_LABEL,
    SURFACE_LABEL,
    opacity_from_density,
    signed_from_occupancy,
    signed_from_opacity,
)
from unghost.core.shards.finding import find_shards
from unghost.core.shards.packing import dequantize_signed, unpack_labels
from unghost.core.shards.storage import Shard, read_shard
from unghost.data_recipes.corruptions.structured import CORRUPTIONS, corrupt
from unghost.data_recipes.curation import curate
from unghost.data_recipes.recipe import load_recipe
from unghost.data_recipes.solids.compose import dilate
from unghost.fields.adapters.sdf import laplace_density

from .capture_cubes import capture_shards, cubes_folder

SEED = 77
SEVERITIES = (0.1, 0.3, 0.5, 0.8, 1.0)
MIXED = "mixed"
BUBBLES = ("bits", "soft")  # the families of the set of that name
FIELD_EDGE, IN_A_FIELD = 0.5, 0.8  # the edge fraction, and the severity of the mixed corruption shown at it
KNOWN = ("surroundings", "view_count", "transmittance", "support", "crossings")  # beside the opacity
CAPTURE_CUBES = 160  # of each of three fields


@dataclass(frozen=True)
class CubeSet:
    """Labelled cubes.

    Attributes:
        name: ``clean``, ``bubbles``, ``synthetic``, ``synthetic-soft``, ``capture`` or ``harvest`` (``-many-points``,
            ``-few-points``, ``-unseen-field``).
        about: what tells rows of one set apart: ``family`` and ``severity`` of the corruption.
        signed: ``(N, 32, 32, 32)`` float32 signed opacity.
        labels: ``(N, 32, 32, 32)`` uint8.
        edge_fraction: ``(N,)`` float32.
        group: ``(N,)`` int32, mesh or scene.
        surroundings: ``(N, 16, 16, 16)`` uint8, or None.
        view_count: ``(N, 32, 32, 32)`` uint8, or None.
        transmittance: ``(N, 16, 16, 16)`` uint8, or None.
        support, crossings: ``(N, 32, 32, 32)`` uint8, or None.
    """

    name: str
    about: dict[str, Any]
    signed: NDArray[np.float32]
    labels: NDArray[np.uint8]
    edge_fraction: NDArray[np.float32]
    group: NDArray[np.int32]
    surroundings: NDArray[np.uint8] | None = None
    view_count: NDArray[np.uint8] | None = None
    transmittance: NDArray[np.uint8] | None = None
    support: NDArray[np.uint8] | None = None
    crossings: NDArray[np.uint8] | None = None

    def __len__(self) -> int:
        return len(self.signed)

    def first(self, count: int) -> CubeSet:
        """The first ``count`` cubes of it."""
        arrays: dict[str, Any] = {
            item.name: value[:count]
            for item in dataclasses.fields(self)
            if isinstance(value := getattr(self, item.name), np.ndarray)
        }
        return dataclasses.replace(self, **arrays)


def blind(cubes: CubeSet) -> CubeSet:
    """The set with every optional channel unknown."""
    unknown: dict[str, Any] = dict.fromkeys(KNOWN)
    return dataclasses.replace(cubes, **unknown)


def tells_more(cubes: CubeSet) -> bool:
    """Whether the set knows more of its cubes than their opacity."""
    return any(getattr(cubes, name) is not None for name in KNOWN)


def from_shards(name: str, shards: list[Shard], count: int, **about: Any) -> CubeSet:
    """Some ``count`` cubes with any surface, as many from each shard."""
    parts = []
    for number, shard in enumerate(shards):
        wanted = count * (number + 1) // len(shards) - count * number // len(shards)
        labels = unpack_labels(np.array(shard.labels))
        rows = np.flatnonzero((labels == SURFACE_LABEL).any(axis=(1, 2, 3)))
        rows = rows[np.linspace(0, len(rows) - 1, min(wanted, len(rows))).round().astype(int)] if len(rows) else rows
        parts.append((shard, labels[rows], rows))
    arrays: dict[str, Any] = {
        "signed": np.concatenate([dequantize_signed(shard.inputs[rows]) for shard, _, rows in parts]),
        "labels": np.concatenate([labels for _, labels, _ in parts]),
    }
    for key in ("edge_fraction", "group"):
        arrays[key] = np.concatenate([getattr(shard, key)[rows] for shard, _, rows in parts])
    for key in KNOWN:
        if all(getattr(shard, key) is not None for shard in shards):
            arrays[key] = np.concatenate([getattr(shard, key)[rows] for shard, _, rows in parts])
    return CubeSet(name, about, **arrays)


def damaged(clean: CubeSet, family: str, severity: float) -> CubeSet:
    """``clean`` cubes with one family of corruption, or ``mixed`` as recipes have it."""
    function = corrupt if family == MIXED else CORRUPTIONS[family]
    surface = clean.labels == SURFACE_LABEL
    place = 1000 * SEVERITIES.index(severity) + [MIXED, *CORRUPTIONS].index(family)
    signed = np.stack(
        [
            signed_from_occupancy(function(np.random.default_rng([SEED, place, row]), cube, severity))
            for row, cube in enumerate(surface)
        ]
    )
    about = {"family": family, "severity": severity}
    return dataclasses.replace(clean, name="synthetic", about=about, signed=signed.astype(np.float32))


def _with_bubbles(rng: np.random.Generator, surface: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """``(R, R, R)`` surface and one to three smooth ellipsoids, radii 2 to 6 voxels, two voxels clear of it."""
    grid, free = np.indices(surface.shape).transpose(1, 2, 3, 0).astype(float), ~dilate(surface, 2)
    result, wanted = surface.copy(), int(rng.integers(1, 4))
    for _ in range(12):  # places tried
        center, radii = rng.uniform(0, surface.shape[0] - 1, 3), rng.uniform(2.0, 6.0, 3)
        turned = (grid - center) @ np.linalg.qr(rng.normal(size=(3, 3)))[0]
        body = ((turned / radii) ** 2).sum(axis=-1) < 1.0
        if wanted and body.any() and free[body].all():
            result, wanted = result | body, wanted - 1
    return result


def as_in_a_field(cubes: CubeSet) -> CubeSet:
    """Cubes at the edge fraction of a window of ``clean`` in a field of 64 cells, larger than any that curated
    cubes have: a prior that takes it for a hint about the content does worse."""
    edges = np.full_like(cubes.edge_fraction, FIELD_EDGE)
    about = {"severity": cubes.about["severity"]} if "severity" in cubes.about else cubes.about
    name = "synthetic-in-a-field" if "severity" in about else cubes.name
    return dataclasses.replace(cubes, name=name, about=about, edge_fraction=edges)


def bubble_sets(clean: CubeSet) -> Iterator[CubeSet]:
    """What a learned distance grows where no photo looks: closed smooth bodies in free space, beside clean surface.

    As bits, and as the opacity of VolSDF's Laplace density of both (scale .7 of a voxel). Such bodies are no
    corruption of the recipes, whose blobs are lumpy. The edge fraction is a field's. Of soft cubes the two voxels about
    a surface, its skirt, do not count.
    """
    from scipy.ndimage import distance_transform_edt

    surface = clean.labels == SURFACE_LABEL
    seen = np.stack([_with_bubbles(np.random.default_rng([SEED, 31, row]), cube) for row, cube in enumerate(surface)])
    bits = signed_from_occupancy(seen).astype(np.float32)
    distance = np.stack([distance_transform_edt(~cube) - distance_transform_edt(cube) for cube in seen])
    density = laplace_density(distance.astype(np.float32), beta=0.7)
    soft = signed_from_opacity(opacity_from_density(density, 1.0))
    for family, signed in zip(BUBBLES, (bits, soft)):
        labels = clean.labels.copy()
        if family == "soft":
            skirt = np.stack([dilate(cube, 2) for cube in surface]) & ~surface
            labels[skirt] = IGNORE_LABEL
        bubbles = dataclasses.replace(clean, name="bubbles", about={"family": family}, signed=signed, labels=labels)
        yield as_in_a_field(bubbles)


def mesh_sets(meshes: Path | None, count: int, few: int) -> Iterator[CubeSet]:
    """Cubes of meshes of the ``test`` split: untouched, with bubbles, corrupted as bits, and as soft opacities.

    Args:
        meshes: folder with a manifest.csv; None: procedural cubes in place of meshes'.
        count: cubes of the mixed corruption and of the untouched.
        few: cubes of each single family.
    """
    base = dataclasses.replace(
        load_recipe("procedural" if meshes is None else "meshes"), empty_share=0.0, on_share=0.8, near_share=0.2
    )
    if meshes is not None:
        licences = ("CC0-1.0", "MIT-0", "CC-BY-3.0")
        base = dataclasses.replace(base, split="test", licences=licences, cubes_per_mesh=4)
    with tempfile.TemporaryDirectory() as folder:

        def cut(name: str, **changes: Any) -> CubeSet:
            recipe, out = dataclasses.replace(base, **changes), Path(folder) / f"{name}-{len(changes)}"
            shards = curate(recipe, out, count=round(1.3 * count), seed=SEED, mesh_root=meshes)
            return from_shards(name, [read_shard(path) for path in shards], count)

        clean = cut("clean", clean_share=1.0, soft_share=0.0)
        soft = cut("synthetic-soft", clean_share=0.0, soft_share=1.0)
    # the truth of an untouched cube is the cube: none of its voxels is left out
    known = dataclasses.replace(clean, labels=np.where(clean.signed > 0, SURFACE_LABEL, FREE_LABEL).astype(np.uint8))
    yield known
    yield from bubble_sets(known)
    for severity in SEVERITIES:
        yield damaged(known, MIXED, severity)
    yield as_in_a_field(damaged(known, MIXED, IN_A_FIELD))
    for family in CORRUPTIONS:
        for severity in SEVERITIES:
            yield damaged(known.first(few), family, severity)
    yield soft


def harvest_set(name: str, folder: Path, count: int) -> CubeSet:
    """Cubes of harvested shards, as many from each scene."""
    return from_shards(name, [read_shard(path) for path in find_shards(folder)], count)


def capture_set(capture: Path, cache: Path, count: int, fields: int, steps: int, downscale: float) -> CubeSet:
    """Cubes of fields of a real capture (its first sweep), a seed each, labelled by a field that saw the third too."""
    shards = capture_shards(
        capture,
        cubes_folder(cache, CAPTURE_CUBES, steps, downscale),
        train="trajectory_1",
        better=("trajectory_3",),
        cubes=CAPTURE_CUBES,
        seeds=tuple(range(fields)),
        cache=cache,
        steps=steps,
        downscale=downscale,
    )
    return from_shards("capture", [read_shard(path) for path in shards], count)
