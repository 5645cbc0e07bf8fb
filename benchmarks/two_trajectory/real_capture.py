"""A real capture: does the prior take ghosts out of a field that was trained on one sweep of photos?

    python -m benchmarks.two_trajectory.real_capture CAPTURE --train trajectory_1 --eval trajectory_3

A field is fitted to the training sweep, a pseudo-ground-truth field to both. The first is then
fine-tuned with (a) nothing more, (b) the visibility loss, (c) visibility and DSDS, for the same steps
from the same seed, and each is scored on the evaluation sweep under the convention ``proper``. Writes
``capture.json`` and ``capture.png``. Fitted fields and renderings are kept in ``--cache``, so that a
run can be broken off and resumed, and other regularizer settings cost their own fine-tuning only.
"""

from __future__ import annotations

import ast
import copy
import dataclasses
import functools
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import tyro
from numpy.typing import NDArray

import unghost.fields
import unghost.regularizer
from unghost import load_denoiser
from unghost.core.cameras import Cameras
from unghost.core.config import check_keys
from unghost.core.results import build_results, json_ready, write_results
from unghost.evaluation.captures.loading import load_capture
from unghost.evaluation.report.rows import draw_comparison, format_table, mean_over_seeds
from unghost.evaluation.scoring.conventions import SceneExtent, evaluation_masks, get_convention
from unghost.evaluation.scoring.engine import score_scene
from unghost.evaluation.scoring.protocol import common_mask, visibility_masks
from unghost.evaluation.scoring.views import Renders, Truth
from unghost.fields.radiance import RadianceConfig, RadianceField
from unghost.fields.rendering import render_view
from unghost.fields.training import train_field
from unghost.regularizer.density_regularizer import DensityRegularizer
from unghost.regularizer.settings import RegularizerSettings

from ..fit_cache import FitCache, code_hash, file_hash, training_hooks
from ..options import CAPTURE, NOT_GIVEN, ROOT, BenchmarkOptions, parse
from ..progress import Plan, say, wrote
from .scenes import Sweep

WITHOUT_PRIOR = {"field": "(a) fine-tuned alone", "visibility": "(b) + visibility"}
FIGURE_VIEWS = 4
CONVENTION = "proper"
Views = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class Options(BenchmarkOptions):
    """What to compare.

    Attributes:
        capture: folder with transforms.json, splits.json and the photos.
        train: the sweep to train on.
        eval: the sweep to be scored on.
        seeds: one run each; the table shows their mean.
        downscale: photo pixels per rendered pixel, along each axis.
        seconds: wall time of fitting each field (so a faster machine gets a better field; see steps).
        steps: fit for so many steps instead.
        finetune_steps: of each of (a), (b), (c).
        resolution: density nodes of the field along an axis (.8 of it for colour); the field's defaults if left out.
        depth_limit: farther predicted depths do not count; twice the widest camera distance if left out (the
            paper's words; the value in its code is 2).
        denoisers: for (c), each a shipped name or the path of an .onnx or .safetensors file; the first one's row is
            ``dsds``, the others' ``dsds, NAME``.
        settings: of the regularizer, as name=value, e.g. dsds_weight=0.2 cubes=20.
        cache: where fitted fields and renderings are kept; remove it to start over.
    """

    SHORT: ClassVar[dict[str, Any]] = {
        "seeds": (0,),
        "downscale": 32,
        "steps": 5,
        "finetune_steps": 2,
        "resolution": 32,
        "settings": ("cubes=2", "visibility_samples=1024"),
    }
    DATA: ClassVar[dict[str, str]] = {"capture": CAPTURE}

    capture: tyro.conf.Positional[Path] = NOT_GIVEN
    train: str = "trajectory_1"
    eval: str = "trajectory_3"
    seeds: tuple[int, ...] = (0, 1, 2)
    downscale: float = 8
    seconds: float = 360.0
    steps: int | None = None
    finetune_steps: int = 300
    resolution: int | None = None
    depth_limit: float | None = None
    denoisers: tuple[str, ...] = ("default",)
    settings: tuple[str, ...] = ()
    cache: Path = ROOT / "out" / "capture"

    def command(self) -> str:
        """The command that asks for the same numbers, without anybody's paths."""
        seeds = " ".join(map(str, self.seeds))
        parts = [
            f"python -m benchmarks.two_trajectory.real_capture {self.capture.resolve().name} --train {self.train} "
            f"--eval {self.eval}"
        ]
        parts += [f"--seeds {seeds} --downscale {self.downscale:g} --finetune-steps {self.finetune_steps}"]
        parts += [f"--seconds {self.seconds:g}" if self.steps is None else f"--steps {self.steps}"]
        parts += [f"--resolution {self.resolution}"] if self.resolution else []
        parts += [f"--depth-limit {self.depth_limit:g}"] if self.depth_limit else []
        named = " ".join(Path(name).name for name in self.denoisers)
        parts += [f"--denoisers {named}"] if self.denoisers != ("default",) else []
        parts += ["--short"] if self.short else []
        return " ".join([*parts, *(["--settings", *self.settings] if self.settings else [])])

    def priors(self) -> dict[str, str]:
        """Method to denoiser."""
        return {"dsds" + (f", {Path(name).stem}" if index else ""): name for index, name in enumerate(self.denoisers)}

    def methods(self) -> dict[str, str]:
        """Row's name to heading."""
        return WITHOUT_PRIOR | {name: f"(c) + visibility + {name.replace('dsds', 'DSDS')}" for name in self.priors()}

    def overrides(self) -> dict[str, Any]:
        """``settings`` as keyword arguments."""
        pairs = [text.partition("=") for text in self.settings]
        known = {item.name for item in dataclasses.fields(RegularizerSettings)} - {"seed", "rule"}
        if not all(sign for _, sign, _ in pairs):
            raise ValueError(f"--settings: must be name=value each, got {self.settings}")
        check_keys([name for name, _, _ in pairs], sorted(known), caller="--settings", what="names")
        return {name: _literal(value) for name, _, value in pairs}


def _literal(text: str) -> Any:
    try:
        return ast.literal_eval(text)
    except (ValueError, SyntaxError):
        return text


def render(field: RadianceField, cameras: Cameras) -> Views:
    """All views: ``rgb (n, H, W, 3)``, ``depth (n, H, W)``."""
    views = [render_view(field, cameras, index) for index in range(len(cameras))]
    return {key: np.stack([view[key] for view in views]) for key in ("rgb", "depth")}


def fit_field(options: Options, cache: FitCache, name: str, sweep: Sweep, seed: int) -> tuple[RadianceField, Any]:
    """A field fitted to a sweep, and its record."""
    nodes = options.resolution
    config = RadianceConfig(resolution=nodes, color_resolution=round(0.8 * nodes)) if nodes else RadianceConfig()
    budget: dict[str, Any] = {"seconds": options.seconds} if options.steps is None else {"steps": options.steps}
    key = {"photos": sweep.digest(), "seed": seed, "budget": budget}

    def fit(field: RadianceField) -> dict[str, Any]:
        record = train_field(field, sweep.cameras, sweep.photos, seed=seed, progress=True, **budget)
        error = np.mean((render(field, sweep.cameras)["rgb"] - sweep.photos) ** 2, axis=(1, 2, 3))
        return {**record, "own_photos_psnr": float(np.mean(-10 * np.log10(error)))}

    return cache.field(f"{name}-{seed}", key, config, fit)


def fine_tune(
    options: Options, base: RadianceField, train: Sweep, evaluation: Sweep, seed: int, method: str, denoiser: Any
) -> Views:
    """Renderings of a copy of ``base`` after fine-tuning it by one of the methods, and the seconds it took."""
    field = copy.deepcopy(base)
    hooks: dict[str, Any] = {}
    if method != "field":
        overrides = {**options.overrides(), **({"dsds_weight": 0.0} if method == "visibility" else {})}
        regularizer = DensityRegularizer(
            denoiser, aabb=field.aabb, cameras=train.cameras, field_pitch=field.field_pitch, seed=seed, **overrides
        )
        hooks = training_hooks(regularizer)
    record = train_field(
        field,
        train.cameras,
        train.photos,
        steps=options.finetune_steps,
        seed=seed,
        fine_tune=True,
        progress=True,
        **hooks,
    )
    return {**render(field, evaluation.cameras), "seconds": np.array(record["seconds"])}


def tuning_key(options: Options, method: str, weights: dict[str, dict[str, str]]) -> dict[str, Any]:
    """What renderings after fine-tuning depend on besides the base field and the cameras."""
    key: dict[str, Any] = {"steps": options.finetune_steps, "code": code_hash(unghost.fields)}
    if method != "field":
        key["regularizer"] = {**options.overrides(), "code": code_hash(unghost.regularizer)}
    return {**key, "prior": weights[method]} if method in weights else key


def score_seed(seed: int, tuned: dict[str, Views], truth: Truth, extent: SceneExtent) -> dict[str, dict[str, Any]]:
    """Scores of every method of one seed: on its own pixels, on those that all have, on all that are visible."""
    rule = get_convention(CONVENTION)
    renders = {method: Renders(np.clip(views["rgb"], 0, 1), views["depth"]) for method, views in tuned.items()}
    shared = common_mask([evaluation_masks(rule, each, truth, extent) for each in renders.values()])
    rows = {}
    for method, each in renders.items():
        scores = score_scene(each, truth, extent, convention=CONVENTION)
        common = score_scene(
            each, truth, extent, convention=CONVENTION, within=shared, keys=("psnr", "coverage")
        ).means()
        visible = score_scene(each, truth, None, convention="visible_only", keys=("psnr",)).means()
        rows[method] = {
            "seed": seed,
            **{key: value for key, value in scores.means().items() if key not in scores.notes},
            "psnr_visible": visible["psnr"],
            "psnr_common": common["psnr"],
            "coverage_common": common["coverage"],
            "seconds": float(tuned[method]["seconds"]),
        }
    return rows


def run(options: Options) -> dict[str, Any]:
    """Do it all; returns the results object."""
    overrides = options.overrides()
    capture = load_capture(options.capture, downscale=options.downscale)
    indices = [capture.split(name) for name in (options.train, options.eval)]
    if set(indices[0]) & set(indices[1]):
        raise ValueError(f"--train {options.train} and --eval {options.eval} share photos")
    train, evaluation, both = (
        Sweep(capture.cameras.select(chosen), capture.images(chosen)) for chosen in (*indices, np.concatenate(indices))
    )
    methods, denoisers = options.methods(), {m: load_denoiser(name) for m, name in options.priors().items()}
    weights = {
        method: {"name": used.manifest.name, "sha256": used.manifest.body_sha256 or file_hash(options.priors()[method])}
        for method, used in denoisers.items()
    }
    cache, shown = FitCache(options.cache), dict[str, Views]()
    fits, tunes = 1 + len(options.seeds), len(options.seeds) * len(methods)
    guess = options.seconds if options.steps is None else options.steps * 0.3
    plan = Plan(["fit"] * fits + ["tune"] * tunes, {"fit": guess, "tune": options.finetune_steps * 0.5})

    plan.begin("fit", f"pseudo ground truth: {len(both.cameras)} photos of both sweeps")
    pseudo_field, pseudo_record = fit_field(options, cache, "pseudo", both, 0)
    key = {"field": pseudo_record["sha256"], "code": code_hash(unghost.fields), "eval": evaluation.digest()}
    pseudo_views = cache.views("pseudo", key, functools.partial(render, pseudo_field, evaluation.cameras))
    extent = SceneExtent.of(train.cameras, evaluation.cameras)
    extent = dataclasses.replace(extent, limit=options.depth_limit or extent.limit)
    visible = visibility_masks(evaluation.cameras, pseudo_views["depth"], train.cameras)
    truth = Truth(evaluation.photos, visible, pseudo_views["depth"], cameras=evaluation.cameras)

    records, per_seed = [], []
    for seed in options.seeds:
        plan.begin("fit", f"field, seed {seed}: {len(train.cameras)} photos of {options.train}")
        base, record = fit_field(options, cache, "field", train, seed)
        records.append({"seed": seed, **record})
        tuned = {}
        for method, heading in methods.items():
            plan.begin("tune", f"seed {seed}, {heading}")
            key = {"field": record["sha256"], "eval": evaluation.digest(), **tuning_key(options, method, weights)}
            used = denoisers.get(method, denoisers["dsds"])  # without a weight it is not asked
            make = functools.partial(fine_tune, options, base, train, evaluation, seed, method, used)
            tuned[method] = cache.views(f"{method}-{seed}", key, make)
        shown = tuned if seed == options.seeds[0] else shown
        per_seed.append(score_seed(seed, tuned, truth, extent))
    rows = [mean_over_seeds(method, [scores[method] for scores in per_seed]) for method in methods]
    results = build_results(
        rows,
        command=options.command(),
        seeds=options.seeds,
        capture=capture.folder.resolve().name,
        priors=weights,
        regularizer={k: v for k, v in dataclasses.asdict(RegularizerSettings(**overrides)).items() if k != "seed"},
        depth_limit=extent.limit,
        visible_share=float(visible.mean()),
        fields=records,
        pseudo_ground_truth=pseudo_record,
    )
    write_results(options.out / "capture.json", json_ready(results))
    draw(
        options,
        {
            "photo · pseudo depth": {"rgb": evaluation.photos, "depth": pseudo_views["depth"]},
            **{methods[method]: views for method, views in shown.items()},
        },
        extent.limit,
        rows,
    )
    return results


def draw(options: Options, columns: dict[str, Views], limit: float, rows: list[dict[str, Any]]) -> None:
    count = len(next(iter(columns.values()))["depth"])
    views = np.unique(np.linspace(0, count - 1, FIGURE_VIEWS + 2).round().astype(int)[1:-1]).tolist()
    numbers = " · ".join(f"{row['method']} {row['psnr'] or 0:.2f} dB at {row['coverage']:.3f}" for row in rows)
    draw_comparison(
        options.out / "capture.png",
        columns,
        views=views,
        limit=limit,
        title=f"{options.capture.resolve().name}: trained on {options.train}, seen from {options.eval}",
        note=f"Below each picture its depth (warm is near; grey: nothing within the depth limit). Pictures: seed "
        f"{options.seeds[0]}. Masked PSNR at coverage, mean over seeds {list(options.seeds)}: {numbers}.",
    )


def main() -> None:
    options = parse(Options, __doc__)
    results = run(options)
    say(format_table(results["rows"]))
    wrote(options.out / "capture.json", options.out / "capture.png")


if __name__ == "__main__":
    main()
