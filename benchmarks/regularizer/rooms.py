"""Score distillation on fields of rooms whose geometry is known: what it takes, what it leaves, what it puts there.

    python -m benchmarks.regularizer.rooms

Rooms of the harvest's kind (``scenes/generator.py``, a seed of their own) are photographed as casually, fitted by a
dense grid, and fine-tuned: alone, with the visibility loss, and with score distillation beside it. Labels are those
of the harvest, at random points of the box, by what is opaque before fine-tuning:

    ghosts_removed    of the ghosts, no longer opaque
    surface_kept      of the true surface, still opaque
    holes_filled      of the true surface that was not opaque, opaque now
    free_space_error  mean opacity of a cell in free space
    disparity_mae     of another sweep's views, where a photo shows the true surface; its median beside it

The defaults of score distillation were chosen on rooms 1, 3, 4, 6, 7 and 8 and on one sweep of a capture.

Writes docs/results/dsds_rooms.json.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray

from unghost import load_denoiser
from unghost.core.occupancy import FREE_LABEL, SURFACE_LABEL, OccupancyRule, opacity_from_density
from unghost.core.results import build_results, write_results
from unghost.data_recipes.harvest.labels import Truth
from unghost.fields.kinds import make_field
from unghost.fields.rendering import Sampling, render_view
from unghost.fields.training import TrainingConfig, train_field
from unghost.regularizer.density_regularizer import DensityRegularizer
from unghost.scenes.generator import observers, photograph, random_scene

from ..fit_cache import training_hooks
from ..options import BenchmarkOptions, parse
from ..progress import Plan, say, wrote

RULE = OccupancyRule()
WIDTH, NEAREST = 96, 0.05
FEWEST = 0.1  # of the surface: with less of it opaque, a fit has failed
SEEN = 0.05  # scene units: how far behind what a photo shows a point still counts as shown
WAYS: dict[str, dict[str, Any] | None] = {
    "fine-tuned alone": None,
    "visibility": {"dsds_weight": 0.0},
    "dsds": {},
    "dsds, the paper's thresholds": {"threshold": 0.0, "fill_threshold": 0.0},
    "dsds, threshold -.7, target .3": {"threshold": -0.7, "target": 0.3},
    "dsds, target .9": {"target": 0.9},
    "dsds, views": {"denoiser": "views"},
}


@dataclass(frozen=True)
class Options(BenchmarkOptions):
    """What to measure.

    Attributes:
        rooms: which, of the seed's.
        seed: of the rooms.
        resolution: of the grid that is fitted.
        fit_steps, steps: of the fit, and of the fine-tuning.
        cubes: a step.
        points: of the box that are labelled.
        views: of the other sweep.
    """

    SHORT: ClassVar[dict[str, Any]] = {
        "rooms": (9,),
        "resolution": 48,
        "fit_steps": 250,
        "steps": 3,
        "cubes": 2,
        "points": 20_000,
        "views": 2,
    }

    rooms: tuple[int, ...] = (7, 9, 10, 11)
    seed: int = 777
    resolution: int = 96
    fit_steps: int = 450
    steps: int = 150
    cubes: int = 12
    points: int = 400_000
    views: int = 8


class FittedRoom:
    """A room, its photos, the field that was fitted to them, and labelled points."""

    def __init__(self, index: int, options: Options) -> None:
        rng = np.random.default_rng([options.seed, index])
        torch.manual_seed(0)
        self.index, self.threads, self.cubes = index, options.threads, options.cubes
        self.photographed = photograph(
            rng, random_scene(rng), count=int(rng.integers(16, 25)), width=WIDTH, height=WIDTH * 3 // 4
        )
        self.field: Any = make_field("dense", options.resolution, initial_opacity=0.01, seed=index)
        samples = max(48, round(2.4 / self.field.field_pitch))
        sampling = Sampling(near_samples=samples, far_samples=max(12, samples // 4))
        self.fitting = TrainingConfig(rays=1152, sampling=sampling)
        told = self.photographed
        train_field(self.field, told.cameras, told.images, steps=options.fit_steps, seed=index, config=self.fitting)
        self.others = observers(np.random.default_rng([options.seed, index, 1]), told.scene, count=options.views)
        truth = Truth(told, self.field.aabb, observers=self.others)
        self.points = rng.uniform(self.field.aabb[0], self.field.aabb[1], (options.points, 3))
        self.before = self.opacity(self.field)
        opaque, nothing = self.before > RULE.threshold, np.zeros((1, options.points), dtype=bool)
        self.labels = truth.labels(self.points[None], self.field.field_pitch, opaque[None], nothing)[0]

    def failed(self) -> bool:
        """Whether hardly any of the surface is opaque, or no ghost is, or nobody else looks: nothing to score."""
        opaque, surface = self.before > RULE.threshold, self.labels == SURFACE_LABEL
        ghosts = opaque & (self.labels == FREE_LABEL)
        return int((opaque & surface).sum()) < FEWEST * max(int(surface.sum()), 1) or not (
            ghosts.any() and len(self.others[0])
        )

    def opacity(self, field: Any) -> NDArray[np.float64]:
        """Of a cell at each of the points."""
        with torch.no_grad():
            density = field.density_fn(torch.from_numpy(self.points).float())[:, 0].numpy()
        return np.asarray(opacity_from_density(density.astype(np.float64), field.field_pitch))

    def tuned(self, settings: dict[str, Any] | None, steps: int) -> tuple[Any, dict[str, Any]]:
        """A copy of the field after fine-tuning, and the record of it."""
        field, hooks, told = copy.deepcopy(self.field), dict[str, Any](), self.photographed
        if settings is not None:
            chosen = dict(settings)
            denoiser = load_denoiser(chosen.pop("denoiser", "default"), backend="onnx", threads=self.threads)
            regularizer = DensityRegularizer(
                denoiser,
                aabb=field.aabb,
                cameras=told.cameras,
                field_pitch=field.field_pitch,
                cubes=self.cubes,
                **chosen,
            )
            hooks = training_hooks(regularizer)
        record = train_field(
            field, told.cameras, told.images, steps=steps, seed=self.index, config=self.fitting, fine_tune=True, **hooks
        )
        return field, record

    def scores(self, field: Any) -> dict[str, float]:
        """See the top of this file."""
        after, opaque = self.opacity(field), self.before > RULE.threshold
        free, surface, now = self.labels == FREE_LABEL, self.labels == SURFACE_LABEL, after > RULE.threshold
        errors = np.concatenate([self._disparity_errors(field, index) for index in range(len(self.others[0]))])
        return {
            "ghosts_removed": float((~now)[free & opaque].mean()),
            "surface_kept": float(now[surface & opaque].mean()),
            "holes_filled": float(now[surface & ~opaque].mean()),
            "free_space_error": float(after[free].mean()),
            "disparity_mae": float(errors.mean()),
            "disparity_median": float(np.median(errors)),
        }

    def _disparity_errors(self, field: Any, index: int) -> NDArray[np.float64]:
        """Of one view of the other sweep, where a photo shows what it sees: per scene unit."""
        cameras, told = self.others[0], self.photographed
        origins, directions = cameras.rays(index)
        found = render_view(field, cameras, index)["depth"]
        true = told.scene.trace(origins.reshape(-1, 3), directions.reshape(-1, 3)).reshape(found.shape)
        hit = np.isfinite(true)
        places = (origins + directions * np.where(hit, true, 0.0)[..., None]).reshape(-1, 3)
        shown = (
            told.true_cameras.view_count(places, depth_maps=told.depth_maps, tolerance=SEEN).reshape(found.shape) > 0
        )
        errors: NDArray[np.float64] = np.abs(1.0 / np.maximum(found, NEAREST) - 1.0 / np.maximum(true, NEAREST))
        return errors[hit & shown]


def main() -> None:
    options = parse(Options, __doc__)
    torch.set_num_threads(options.threads)
    found: dict[str, list[dict[str, float]]] = {"the field": [], **{way: [] for way in WAYS}}
    plan = Plan(["fit", *WAYS] * len(options.rooms), dict.fromkeys(("fit", *WAYS), 60.0))
    for index in options.rooms:
        plan.begin("fit", f"room {index}: photos, fit, labels")
        room = FittedRoom(index, options)
        if room.failed():
            say(f"room {index}: nothing to score (its fit failed, or no other sweep fits in), it is left out")
            plan.skip(WAYS)
            continue
        found["the field"].append({"room": index, **room.scores(room.field)})
        for way, settings in WAYS.items():
            plan.begin(way, f"room {index}, {way}")
            field, record = room.tuned(settings, options.steps)
            found[way].append({"room": index, **room.scores(field), "psnr": record["psnr"]})
            say("    " + " ".join(f"{k} {v:.3f}" for k, v in found[way][-1].items() if k != "room"))
    if not found["the field"]:
        raise SystemExit("dsds_rooms: no room is left; give more --fit-steps, or other --rooms")
    rows = [
        {"method": way, **{k: float(np.mean([one[k] for one in each])) for k in each[0] if k != "room"}, "rooms": each}
        for way, each in found.items()
    ]
    results = build_results(rows, command=options.command(), seeds=[options.seed], threads=options.threads)
    write_results(options.out / "dsds_rooms.json", results)
    wrote(options.out / "dsds_rooms.json")


if __name__ == "__main__":
    main()
