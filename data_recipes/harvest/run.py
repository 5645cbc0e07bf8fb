"""Harvested pairs: cubes of badly constrained fields, beside the truth of the scenes they were fitted to.

A radiance field of one of several kinds is fitted to a few photos of a synthetic scene, and not for long; cubes
of its opacity are inputs, the scene's signed distance gives three-valued labels (see :mod:`.labels`).
Each is stored with its surroundings, its frame, and how many photos saw each voxel (:mod:`.context`).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ...core.aabb import scene_extent
from ...core.channels import full_channel
from ...core.config import to_dict
from ...core.errors import InvalidArgument, needs_extra
from ...core.frames import RESOLUTION, cube_lattices, random_rotations
from ...core.occupancy import DEFAULT_OPACITY_THRESHOLD, opacity_from_density, opacity_from_signed
from ...core.progress import progress_bar
from ...core.shards.packing import (
    dequantize_share,
    dequantize_signed,
    pack_labels,
    quantize_share,
    quantize_signed,
    unpack_labels,
)
from ...core.shards.storage import TRANSMITTANCE_RESOLUTION, read_shard, write_shard
from ...core.visibility.transmittance import TransmittanceMaps
from ...core.visibility.view_counts import count_views
from ..engines import Engine, LocalEngine, open_engine
from ..folder_lock import locked
from .config import HarvestConfig
from .context import evidence, signed_opacity, surroundings
from .evidence import TOGETHER, easy_matching, lines_of, point_sets, room_evidence
from .labels import HIDDEN, Labeller, Truth, check_fit, severity_of
from .resume import finished, scene_folder
from .rooms import draw_objects_of, room_cubes

if TYPE_CHECKING:
    from ...core.distances.sampled import SampledDistance
    from ...core.sparse_points import SparsePoints
    from ...fields.kinds import TrainableField
    from ...scenes.generator import PhotographedScene

OBSERVER_STREAM = 0x6F6273  # keeps the other sweep apart from all else
ROOM_PHOTOS = 0x70686F  # the same for the photos of rooms without a field
EARLY = 0.45  # share of the fit at which the first cubes are taken
QUERY = 1 << 17  # points that are worked on at a time


@contextmanager
def _one_thread() -> Iterator[None]:
    """torch in one thread: gradients summed in several differ from run to run in their last bits."""
    with needs_extra("torch", caller="harvest"):
        import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _density_fn(field: TrainableField) -> Callable[[NDArray[Any]], NDArray[np.float32]]:
    """The field for numpy arrays ``(M, 3)`` float32 to ``(M,)``, without gradients."""
    import torch

    def density_fn(positions: NDArray[Any]) -> NDArray[np.float32]:
        with torch.no_grad():
            parts = [field.density_fn(part)[:, 0] for part in torch.split(torch.from_numpy(positions), QUERY)]
        density: NDArray[np.float32] = torch.cat(parts).numpy()
        return density

    return density_fn


def _propose(rng: np.random.Generator, field: TrainableField, count: int) -> NDArray[np.float64]:
    """Cube centres ``(count, 3)`` in the field's box: nine in ten where it is opaque, the rest anywhere."""
    candidates = rng.uniform(field.aabb[0], field.aabb[1], size=(60_000, 3))
    density = _density_fn(field)(candidates.astype(np.float32))
    opacity = opacity_from_density(density, field.field_pitch)
    weight = np.where(opacity > DEFAULT_OPACITY_THRESHOLD, 1.0, 0.02 * opacity) + 1e-6
    chosen = rng.choice(len(candidates), size=count, p=weight / weight.sum())
    anywhere = rng.random(count) < 0.1
    chosen[anywhere] = rng.integers(len(candidates), size=int(anywhere.sum()))
    return candidates[chosen]


def harvest_cubes(
    rng: np.random.Generator,
    field: TrainableField,
    truth: Labeller,
    config: HarvestConfig,
    *,
    points: Sequence[SparsePoints] = (),
) -> dict[str, NDArray[Any]]:
    """Cut ``config.cubes`` cubes out of a fitted field and label them: a shard's arrays, less ``group``.

    ``points``: sets of sparse points, each for as many of the cubes; without any, there is no evidence.
    """
    count = config.cubes
    centers = _propose(rng, field, count)
    low, high = np.log(config.voxel_pitch)
    edges = field.field_pitch * np.exp(rng.uniform(low, high, size=count)) * RESOLUTION
    rotations = random_rotations(rng, count)
    rotations[rng.random(count) >= config.rotated_share] = np.eye(3)
    assumed_pitch = field.field_pitch * np.exp(rng.uniform(-0.3, 0.3, size=count))
    density_fn = _density_fn(field)
    maps = TransmittanceMaps.build(density_fn, truth.cameras, aabb=field.aabb, field_pitch=field.field_pitch)
    parts: list[dict[str, NDArray[Any]]] = []
    lines = lines_of(list(points), truth.cameras, aabb=field.aabb, pitch=field.field_pitch)
    for number, start in enumerate(range(0, count, TOGETHER)):
        some = slice(start, start + TOGETHER)
        frames = (centers[some], edges[some], rotations[some])
        lattice = cube_lattices(*frames)
        stored = quantize_signed(signed_opacity(density_fn, lattice, assumed_pitch[some], field.aabb))
        inputs = dequantize_signed(stored)  # labels are of what a shard holds
        opaque = opacity_from_signed(inputs) > DEFAULT_OPACITY_THRESHOLD
        coarse = cube_lattices(*frames, resolution=TRANSMITTANCE_RESOLUTION)
        light = quantize_share(maps.best_view(coarse))
        hidden = full_channel(dequantize_share(light)) < HIDDEN
        labels = truth.labels(lattice, field.field_pitch, opaque, hidden)
        about = surroundings(density_fn, *frames, assumed_pitch[some], field.aabb)
        parts.append(
            {
                "inputs": stored,
                "labels": pack_labels(labels),
                "severity": severity_of(inputs, labels),
                "surroundings": quantize_signed(about),
                "view_count": count_views(truth.cameras, *frames),
                "transmittance": light,
                **(evidence(lines[number % len(lines)], lattice) if lines else {}),
            }
        )
    arrays = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    arrays["edge_fraction"] = (edges / scene_extent(field.aabb)).astype(np.float32)
    arrays["frames"] = np.concatenate([centers, edges[:, None], rotations.reshape(count, 9)], axis=1)
    return arrays


def photograph_scene(
    rng: np.random.Generator, config: HarvestConfig, objects: Sequence[SampledDistance] = ()
) -> PhotographedScene:
    """A random scene in as many photos as the config draws."""
    from ...scenes.generator import photograph, random_scene

    width = int(rng.integers(config.photo_width[0], config.photo_width[1] + 1))
    photos = int(rng.integers(config.photos[0], config.photos[1] + 1))
    return photograph(rng, random_scene(rng, objects), count=photos, width=width, height=width * 3 // 4)


def _draw_field(rng: np.random.Generator, config: HarvestConfig) -> tuple[str, int, TrainableField]:
    """A fresh field: its kind, its resolution, and itself."""
    from ...fields.kinds import make_field

    shares = np.array(config.shares) / np.sum(config.shares)
    kind = config.kinds[int(rng.choice(len(config.kinds), p=shares))]
    resolution = int(rng.choice(config.resolutions))
    opacity = float(np.exp(rng.uniform(np.log(0.002), np.log(0.03))))
    return kind, resolution, make_field(kind, resolution, initial_opacity=opacity, seed=int(rng.integers(2**31)))


@_one_thread()
def harvest_scene(
    seed: int, index: int, config: HarvestConfig, mesh_root: str | Path | None = None
) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Build, photograph, fit and cut scene ``index``: shard arrays and provenance. Depends on (seed, index) alone.

    Scene ``index`` is the same room in the same photos whatever the kinds: a set that is held out needs its own seed.
    With a folder of meshes, some of its ``train`` split stand among the furniture
    (:mod:`unghost.data_recipes.meshes.objects`).
    """
    from ...fields.rendering import Sampling
    from ...fields.training import TrainingConfig, train_field
    from ...scenes.generator import observers

    rng = np.random.default_rng([seed, index])
    objects, meshes = draw_objects_of(seed, index, config, mesh_root)
    photographed = photograph_scene(rng, config, objects)
    kind, resolution, field = _draw_field(rng, config)
    steps = int(np.exp(rng.uniform(*np.log(config.steps))))
    samples = max(48, round(2.4 / field.field_pitch))
    fitting = TrainingConfig(
        rays=config.rays,
        distortion_weight=float(rng.choice([0.0, 0.002, 0.01])),
        sampling=Sampling(near_samples=samples, far_samples=max(12, samples // 4)),
    )
    others = observers(
        np.random.default_rng([seed, index, OBSERVER_STREAM]),
        photographed.scene,
        count=config.observer_photos,
        width=config.observer_width,
        height=config.observer_width * 3 // 4,
    )
    truth = Truth(photographed, field.aabb, observers=others)
    parts: list[dict[str, NDArray[Any]]] = []

    def cut() -> None:
        points = point_sets(photographed, seed=seed, index=index, snapshot=len(parts), sets=config.point_sets)
        parts.append(harvest_cubes(rng, field, truth, config, points=points))

    def snapshot(fitted: TrainableField, step: int) -> None:
        if step == round(EARLY * steps):
            cut()

    report = train_field(
        field, photographed.cameras, photographed.images, steps=steps, seed=index, config=fitting, regularizer=snapshot
    )
    cut()
    arrays = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    arrays["group"] = np.full(len(arrays["inputs"]), index, dtype=np.int32)
    check_fit(
        dequantize_signed(arrays["inputs"]),
        unpack_labels(arrays["labels"]),
        fewest_opaque=config.fewest_opaque,
        most_ghosts=config.most_ghosts,
    )
    photos, _, width, _ = photographed.images.shape
    provenance = {
        "recipe": "harvest",
        "seed": seed,
        "scene": index,
        "photos": photos,
        "photo_width": width,
        "steps": steps,
        "field": kind,
        "resolution": resolution,
        "field_pitch": field.field_pitch,
        "psnr": round(float(report["psnr"]), 3),
        "config": to_dict(config),
        "licence": " AND ".join(sorted({"generated", *(mesh["licence"] for mesh in meshes)})),
        "meshes": meshes,
    }
    return arrays, provenance


def room_scene(
    seed: int, index: int, config: HarvestConfig, mesh_root: str | Path | None = None
) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Cubes of scene ``index`` without a field, see :func:`.rooms.room_cubes`; nothing is fitted.

    Photos are taken for view counts and sparse points alone; without a free path for them the cubes go without.
    """
    from ...scenes.generator import photograph, random_scene

    rng = np.random.default_rng([seed, index, 1])
    objects, meshes = draw_objects_of(seed, index, config, mesh_root)
    scene = random_scene(rng, objects)
    arrays = room_cubes(rng, scene, config)
    other = np.random.default_rng([seed, index, ROOM_PHOTOS])
    width, count = (int(other.integers(low, high + 1)) for low, high in (config.photo_width, config.photos))
    try:
        photographed = photograph(other, scene, count=count, width=width, height=width * 3 // 4)
    except RuntimeError:
        photographed = None
    if photographed is not None and config.point_sets:
        points = point_sets(
            photographed, seed=seed, index=index, snapshot=0, sets=config.point_sets, matching=easy_matching()
        )
        arrays |= room_evidence(points, photographed.cameras, arrays["frames"])
    arrays["group"] = np.full(config.cubes, index, dtype=np.int32)
    provenance: dict[str, Any] = {"recipe": "rooms", "seed": seed, "scene": index, "config": to_dict(config)}
    licences = sorted({"generated", *(mesh["licence"] for mesh in meshes)})
    return arrays, provenance | {"licence": " AND ".join(licences), "meshes": meshes}


def _work(
    folder: str, seed: int, index: int, config: HarvestConfig, fit: bool, mesh_root: str | None
) -> tuple[int, str]:
    """Harvest a scene into its shard, unless it is there; its number, and why it was given up or nothing."""
    target = scene_folder(folder, index)
    if target.exists():  # made by a call whose answer was lost with another worker
        return index, ""
    try:
        arrays, provenance = (harvest_scene if fit else room_scene)(seed, index, config, mesh_root)
    except (RuntimeError, FloatingPointError) as error:  # no free path, a failed fit: reported, not fatal
        return index, str(error)
    write_shard(target, arrays, provenance, kind="harvest" if fit else "pairs")
    return index, ""


def _engine(name: str, workers: int, *, ahead: int) -> Engine:
    """An engine that makes all scenes at once, as far as its workers go: a scene takes a minute."""
    return LocalEngine(workers, ahead=ahead, apart=True) if name == "local" else open_engine(name, workers)


def harvest(
    out: str | Path,
    *,
    scenes: int,
    seed: int = 0,
    first: int = 0,
    workers: int = 1,
    config: HarvestConfig | None = None,
    fit: bool = True,
    mesh_root: str | Path | None = None,
    progress: bool = False,
    log: Callable[[str], None] | None = None,
    engine: str = "local",
) -> int:
    """Harvest scenes ``first .. first + scenes - 1``, one shard each; those already there are checked and skipped.

    A run can be killed at any time and started again: it loses the scenes that it was at, one a worker. A worker that
    dies costs the same. A second run in the same folder at the same time is refused
    (:mod:`unghost.data_recipes.folder_lock`). Without ``fit``, cubes are of perfect fields with synthetic corruption
    (:func:`room_scene`): quick, and needs no torch. ``log`` hears of scenes that were given up. ``mesh_root`` is a
    folder of meshes with its manifest, for objects beside the procedural ones. ``engine`` is ``"local"`` (spawned
    processes) or ``"ray"`` (a cluster, whose machines share ``out``).

    Returns:
        The number of pairs now in ``out``.

    Raises:
        ValueError: numbers out of range, or a scene in ``out`` that is damaged or another harvest's.
        OSError: a scene cannot be written; the finished ones stay. ``BlockingIOError``: another run is at work there.
    """
    folder, config = Path(out), config or HarvestConfig()
    if scenes < 1 or workers < 1:
        raise InvalidArgument(f"harvest: scenes and workers must be >= 1, got {scenes} and {workers}")
    started = time.perf_counter()
    root = None if mesh_root is None else str(mesh_root)
    with locked(folder, verb="harvest"):
        wanted = range(first, first + scenes)
        todo = [i for i in wanted if not finished(folder, seed, i, config, fit=fit, meshes=root is not None)]
        with (
            _engine(engine, workers, ahead=len(todo)) as pool,
            progress_bar(len(todo), unit="scene", shown=progress) as bar,
            closing(pool.ordered(_work, ((str(folder), seed, i, config, fit, root) for i in todo))) as done,
        ):
            for index, problem in done:
                if problem and log is not None:
                    log(f"scene {index}: {problem}")
                bar.update(1)
    if log is not None:
        log(f"{len(todo)} scenes in {time.perf_counter() - started:.0f} s")
    return sum(len(read_shard(path)) for path in sorted(folder.glob("scene-*")) if path.suffix != ".partial")
