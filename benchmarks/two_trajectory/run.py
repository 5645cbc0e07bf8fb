"""The two-trajectory benchmark: who takes ghosts out, at equal coverage, on scenes of which everything is known?

    python -m benchmarks.two_trajectory.run --seeds 0              twelve synthetic scenes: a night on two cores
    python -m benchmarks.two_trajectory.run --scenes --capture-pairs plush:one:two plush:two:one     captures alone
    python -m benchmarks.two_trajectory.run --short                one small scene, few steps: some minutes, out/short
    python -m benchmarks.two_trajectory.run --scenes room-0 --methods field visibility
    python -m benchmarks.two_trajectory.run --prepare              scenes and their sparse points, nothing trained

A field is fitted to one sweep of photos, every method improves it (``methods.py``) for the same steps, and
each is scored on another sweep under the convention ``proper``, at its own coverage and cut to others, in several
orders of pixels (``scores.py``). Every finished row is saved at once in
``docs/results/two_trajectory.json``, in the form of ``compact.py``; what is there is not done again, so that a run that
was broken off goes on with the same command, and several processes may share the file, each with other scenes or seeds
(with ``--threads 1``: means of seconds are over rows with the most threads). A row that is done again, because a factor
or the sparse points have changed, takes the place of the old one. A run in which a method of the table is missing, such
as a seed from before that method was added, counts for no mean. Knobs and the field of both sweeps are
looked at on seed 0 of the synthetic scenes alone.
``--equal-seconds`` trains for as long as ``visibility`` took (the median of the main table), ``--ablation`` does the
paper's ablation, ``--every-eighth`` scores every 8th photo of the first sweep. The page: ``page.py``.

A method must do something: a row says what share of the field it changed and which of its losses were 0 at every step.
Where a method that trains changed nothing or had such a loss, or another one changed nothing on any scene, the run says
so and ends with status 1.
"""

from __future__ import annotations

import dataclasses
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from filelock import FileLock
from numpy.typing import NDArray

from unghost.core.cameras import Cameras
from unghost.core.results import build_results, commit, json_ready
from unghost.evaluation.captures.difficulty import difficulty_rows
from unghost.fields.radiance import RadianceConfig, RadianceField
from unghost.fields.rendering import render_view
from unghost.fields.training import TrainingConfig, train_field

from ..fit_cache import FitCache
from ..options import CAPTURE, ROOT, SHORT_RESULTS, BenchmarkOptions, parse
from ..progress import Plan, say, wrote
from .ablation import ABLATION
from .changes import changed_share
from .compact import read_expanded, write_compact
from .figure import write_figures
from .idle import idle_lines
from .job import Job, Outcome, Weights
from .methods import FACTORS_OF, METHODS, UNTRAINED, WITH_POINTS
from .points import MATCH_SIDE, MATCH_WIDTH, digest, with_points
from .scenes import LabelledSpace, Sweep, TrajectoryScene, captured_scene, synthetic_scene
from .scores import CONVENTION, Stage, scored
from .tables import FEWER_SEEDS, REFERENCE, run_of, summary_rows

SCENES = (  # the first of each kind with two free paths, enough of what the first saw in the second, and enough points
    *(f"room-{number}" for number in (0, 1, 2, 5, 10, 11, 12, 15, 18)),
    *(f"objects-{number}" for number in (4, 27, 42)),
)


@dataclass(frozen=True)
class Options(BenchmarkOptions):
    """What to compare.

    Attributes:
        scenes: synthetic ones, by kind and number of the seed's.
        scene_seed: of the synthetic scenes; they were used for nothing else (the methods' settings are of 555).
        capture: a real one too.
        train, eval: its sweeps.
        capture_pairs: more of them, as FOLDER:TRAIN:EVAL each; pairs of one capture count as one in means.
        downscale: their photo pixels per rendered pixel.
        methods: of the table; all if left out. ``pseudo-gt`` is the field trained on both sweeps.
        seeds: of fits, rays and cubes.
        fit_steps: of the fit.
        steps: of every method that trains.
        capture_steps: the same two for the capture.
        equal_seconds: a second table, every training method for as many seconds as ``visibility`` takes.
        ablation: the paper's ablation instead of the main table.
        every_eighth: score every 8th photo of the training sweep instead of the other sweep, to see what that hides.
        photos, views: of the training and of the evaluation sweep of a synthetic scene.
        width: of its photos, 4 : 3.
        resolution: of the grid that is fitted to it.
        match_width, match_side: of the photos in which features are looked for: width of a synthetic scene's, longest
            side of a capture's.
        prepare: make the scenes and their sparse points, say how many there are, and train nothing.
        pictures: draw the methods of ``pictures.py`` at the end, of the first synthetic scene and of the first pair.
        cache: where fitted fields and sparse points are kept.
    """

    SHORT: ClassVar[dict[str, Any]] = {
        "scenes": ("room-1",),
        "seeds": (0,),
        "match_width": 192,
        "match_side": 800,
        "fit_steps": 40,
        "steps": 2,
        "capture_steps": (10, 2),
        "downscale": 32,
        "photos": 8,
        "views": 3,
        "width": 48,
        "resolution": 48,
        "cache": SHORT_RESULTS / "two_trajectory",
    }
    DATA: ClassVar[dict[str, str]] = {"capture": CAPTURE}

    scenes: tuple[str, ...] = SCENES
    scene_seed: int = 2026
    capture: Path | None = None
    train: str = "trajectory_1"
    eval: str = "trajectory_3"
    capture_pairs: tuple[str, ...] = ()
    downscale: float = 8
    methods: tuple[str, ...] = (REFERENCE, *METHODS)
    seeds: tuple[int, ...] = (0, 1, 2)
    fit_steps: int = 450
    steps: int = 150
    capture_steps: tuple[int, int] = (360, 100)
    equal_seconds: bool = False
    ablation: bool = False
    every_eighth: bool = False
    photos: int = 20
    views: int = 10
    width: int = 96
    resolution: int = 96
    match_width: int = MATCH_WIDTH
    match_side: int = MATCH_SIDE
    prepare: bool = False
    pictures: bool = False
    cache: Path = ROOT / "out" / "two_trajectory"

    def pairs(self) -> list[tuple[Path, str, str]]:
        """Captures with the sweep to train on and the one that is scored, each once."""
        found = [] if self.capture is None else [(self.capture, self.train, self.eval)]
        for text in self.capture_pairs:
            folder, *sweeps = text.rsplit(":", 2)
            if len(sweeps) != 2 or not all((folder, *sweeps)):
                raise ValueError(f"--capture-pairs: must be FOLDER:TRAIN:EVAL each, got {text}")
            found.append((Path(folder), sweeps[0], sweeps[1]))
        return list(dict.fromkeys(found))

    def lacking(self) -> str | None:
        """Captures that are not there, too."""
        missing = [folder for folder, _, _ in self.pairs() if not folder.exists()]
        return super().lacking() or (f"capture_pairs: there is no {missing[0]}; needs {CAPTURE}" if missing else None)

    def names(self, seed: int = 0) -> tuple[str, ...]:
        """Methods of the table; those that do not train have nothing to do with equal seconds."""
        if self.ablation:
            return tuple(ABLATION)
        left_out: tuple[str, ...] = (*UNTRAINED, REFERENCE) if self.equal_seconds else ()
        left_out += FEWER_SEEDS if seed > 0 else ()
        return tuple(name for name in self.methods if name not in left_out)

    def table(self) -> str:
        """Which of the tables the rows belong to."""
        chosen = {"ablation": self.ablation, "equal seconds": self.equal_seconds, "every 8th photo": self.every_eighth}
        named = [name for name, wanted in chosen.items() if wanted]
        if len(named) > 1:
            raise ValueError(f"two_trajectory: one table at a time, got {' and '.join(named)}")
        return named[0] if named else "main"


def _without_folders(word: str) -> str:
    """A word of the command line without anybody's folders."""
    return Path(word).name if "/" in word else word


def _unturned(row: dict[str, Any]) -> str:
    """A row's method, whatever its knob."""
    return str(row["method"]).split(" @ ")[0]


def _settings(row: dict[str, Any]) -> tuple[Any, Any]:
    """What a method was run with, if that can change from one run to the next."""
    return row.get("factor"), row.get("points")


class Ledger:
    """Finished rows on disk; each is there whole or not at all."""

    def __init__(self, options: Options) -> None:
        self.options = options
        self.path = options.out / "two_trajectory.json"
        self.read()

    def read(self) -> None:
        """What is on disk, other processes' rows, too."""
        stored = read_expanded(self.path) if self.path.exists() else {}
        self.cells: list[dict[str, Any]] = stored.get("cells", [])
        self.scenes: dict[str, dict[str, Any]] = stored.get("scenes", {})
        self.commands: list[str] = [each for each in stored.get("command", "").split(" ; ") if each]

    @contextmanager
    def alone(self) -> Iterator[None]:
        """One process at a time, with the file as the last one left it."""
        self.options.cache.mkdir(parents=True, exist_ok=True)
        with FileLock(self.options.cache / "ledger.lock"):
            self.read()
            yield

    def key(self, stage: Stage, seed: int, method: str) -> dict[str, Any]:
        """What a row is known by."""
        named = {"table": self.options.table(), "scene": stage.scene.name, "seed": seed, "method": method}
        swept = FACTORS_OF.get("dsds-paper" if method.startswith("paper, ") else method, ())
        factors = [getattr(Weights(), name) for name in swept]
        points = stage.scene.points if method in WITH_POINTS else None
        return {
            **named,
            "factor": factors[0] if len(factors) == 1 else factors or None,
            **({} if points is None else {"points": digest(points)}),
            "steps": stage.steps,
            "fit_steps": stage.fit_steps,
            "scene_seed": self.options.scene_seed,
        }

    def has(self, key: dict[str, Any]) -> bool:
        """Whether that row is finished."""
        return any(all(cell.get(name) == value for name, value in key.items()) for cell in self.cells)

    def seconds_of(self, scene: str, method: str) -> float:
        """What a method of the main table took there with as many threads, the median over seeds."""
        wanted = ("main", scene, method, self.options.threads)
        took = [
            float(cell["seconds"])
            for cell in self.cells
            if (cell["table"], cell["scene"], cell["method"], cell.get("threads")) == wanted
        ]
        if not took:
            raise ValueError(
                f"two_trajectory: equal seconds are those of {method}, threads {self.options.threads}: "
                f"do the main table of {scene} first"
            )
        return float(np.median(took))

    def describe(self, stage: Stage) -> None:
        """How hard a scene is, and how much of its evaluation views was seen."""
        hard, *_ = difficulty_rows(stage.scene.train.cameras, stage.scene.evaluation.cameras)
        hard |= {"visible": float(stage.pseudo.visible(occlusion=True).mean()), "depth_limit": stage.scene.extent.limit}
        hard |= {} if stage.scene.points is None else {"points": len(stage.scene.points)}
        with self.alone():
            self.scenes.setdefault(self.options.table(), {})[stage.scene.name] = hard
            self.write()

    def add(self, rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
        """Keep rows, in the place of those of the same run and method with other factors or points; as written."""
        ready = [json_ready({**row, "threads": self.options.threads, "commit": commit()}) for row in rows]
        known = {(run_of(row), _unturned(row)): _settings(row) for row in ready}
        with self.alone():
            self.cells = [
                cell
                for cell in self.cells
                if known.get((run_of(cell), _unturned(cell)), _settings(cell)) == _settings(cell)
            ]
            self.cells += ready
            self.write()
        return ready

    def write(self) -> None:
        """The file, with all means anew."""
        command = " ".join(["python -m benchmarks.two_trajectory.run", *map(_without_folders, sys.argv[1:])])
        self.commands = [*(each for each in self.commands if each != command), command]
        seeds = sorted({cell["seed"] for cell in self.cells})
        results = build_results(
            summary_rows(self.cells),
            command=" ; ".join(self.commands),
            seeds=seeds,
            convention=CONVENTION,
            scene_seed=self.options.scene_seed,
            threads=self.options.threads,
            scenes=self.scenes,
            cells=self.cells,
        )
        write_compact(self.path, json_ready(results))


def fitted(
    options: Options, cache: FitCache, stage_name: str, scene: TrajectoryScene, sweep: Sweep, seed: int, steps: int
) -> tuple[RadianceField, float]:
    """A field of a sweep, and the seconds its fit took."""
    config = RadianceConfig(scene.resolution, max(48, scene.resolution * 4 // 5))
    key = {"photos": sweep.digest(), "seed": seed, "steps": steps, "rays": scene.rays}

    def fit(field: RadianceField) -> dict[str, Any]:
        fitting = TrainingConfig(rays=scene.rays, sampling=scene.sampling)
        return train_field(field, sweep.cameras, sweep.photos, steps=steps, seed=seed, config=fitting)

    field, record = cache.field(f"{stage_name}-{scene.name}-{seed}", key, config, fit)
    return field, record["seconds"]


def prepared(options: Options, cache: FitCache, scene: TrajectoryScene) -> TrajectoryScene:
    """The scene as it is trained and scored on, with sparse points if a method needs them."""
    scene = scene.every_nth() if options.every_eighth else scene
    if not (options.prepare or set(options.names()) & set(WITH_POINTS)):
        return scene
    return with_points(scene, cache, match_width=options.match_width, match_side=options.match_side)


def synthetic_scenes(options: Options, cache: FitCache) -> Iterator[TrajectoryScene]:
    """Those of the options, one after the other."""
    for name in options.scenes:
        scene = synthetic_scene(
            options.scene_seed,
            name,
            photos=options.photos,
            views=options.views,
            width=options.width,
            resolution=options.resolution,
        )
        yield prepared(options, cache, scene)


def stages(options: Options, cache: FitCache) -> Iterator[Stage]:
    """The scenes, one after the other; a capture's truth is that of a field trained on both sweeps."""
    for scene in synthetic_scenes(options, cache):
        pseudo = scene.pseudo(lambda cameras: np.zeros(0))
        yield Stage(scene, pseudo, scene.truth(pseudo), options.fit_steps, options.steps)
    for folder, train, evaluation in options.pairs():
        whole = captured_scene(folder, train, evaluation, downscale=options.downscale)
        scene = prepared(options, cache, whole)
        fit_steps, steps = options.capture_steps
        field, _ = fitted(options, cache, "pseudo", whole, whole.train.joined(whole.evaluation), 0, fit_steps)
        depth_of = partial(depths_of, field)
        pseudo = scene.pseudo(depth_of)
        yield Stage(scene, pseudo, scene.truth(pseudo), fit_steps, steps, depth_of)


def depths_of(field: RadianceField, cameras: Cameras) -> NDArray[Any]:
    """Along unit rays, ``(n, H, W)``."""
    return np.stack([render_view(field, cameras, index)["depth"] for index in range(len(cameras))])


def rows_of(
    key: dict[str, Any], stage: Stage, outcomes: list[Outcome], space: LabelledSpace | None, base: Any
) -> list[dict[str, Any]]:
    """A row for the method, and one for every other setting of its knob, named ``method @ knob``."""
    rows = []
    for number, outcome in enumerate(outcomes):
        name = key["method"] if number == 0 else f"{key['method']} @ {outcome.knob:g}"
        found = scored(stage, outcome, space, conventions=name == "field", headline=number == 0)
        did: dict[str, Any] = {"changed_share": changed_share(outcome.field, base)} if number == 0 else {}
        did |= {"idle": list(outcome.idle)} if outcome.idle else {}
        rows.append({**key, "method": name, **found, **did})
    return rows


def run_stage(options: Options, stage: Stage, cache: FitCache, ledger: Ledger, plan: Plan) -> None:
    """All seeds and methods of one scene; of a capture the truth is the reference itself, which is not scored."""
    scene = stage.scene
    ledger.describe(stage)
    table: dict[str, Callable[[Job], list[Outcome]]] = ABLATION if options.ablation else METHODS
    for seed in options.seeds:
        names = [name for name in options.names(seed) if name != REFERENCE or scene.photographed is not None]
        keys = {name: ledger.key(stage, seed, name) for name in names}
        job: Job | None = None
        space: LabelledSpace | None = None
        for name in names:
            plan.begin(name, f"{scene.name}, seed {seed}, {name}")
            if ledger.has(keys[name]):
                continue
            if job is None:
                base, took = fitted(options, cache, "field", scene, scene.train, seed, stage.fit_steps)
                budget = ledger.seconds_of(scene.name, "visibility") if options.equal_seconds else None
                job = Job(scene, base, seed, stage.steps, budget, stage.fit_steps, took, threads=options.threads)
                space = LabelledSpace(scene, base, seed) if scene.photographed is not None else None
            if name == REFERENCE:
                both = scene.train.joined(scene.evaluation)
                better, seconds = fitted(options, cache, "pseudo", scene, both, seed, stage.fit_steps)
                outcomes = [Outcome(better, seconds, seconds * options.threads)]
            else:
                outcomes = table[name](job)
            if seed > 0 or scene.photographed is None:
                outcomes = outcomes[:1]
            last, *_ = ledger.add(rows_of(keys[name], stage, outcomes, space, job.base))
            say(
                "    "
                + " ".join(
                    f"{key} {last[key]:.3f}"
                    for key in ("psnr", "disparity_mae", "coverage", "seconds")
                    if last.get(key) is not None
                )
            )


def main() -> None:
    options = parse(Options, __doc__)
    torch.set_num_threads(options.threads)
    cache, ledger = FitCache(options.cache), Ledger(options)
    if options.short and options.out == SHORT_RESULTS:  # does its work anew
        ledger.path.unlink(missing_ok=True)
        ledger.read()
    if options.prepare:
        prepare(options, cache)
        return
    count = len(options.scenes) + len(options.pairs())
    names = [name for seed in options.seeds for name in options.names(seed)]
    plan = Plan(names * count, dict.fromkeys(names, 40.0))
    begun = time.perf_counter()
    for stage in stages(options, cache):
        run_stage(options, stage, cache, ledger, plan)
    write_figures(ledger.path)
    say(f"{(time.perf_counter() - begun) / 60:.1f} min")
    wrote(ledger.path, ledger.path.with_suffix(".png"))
    if options.pictures:
        from .pictures import draw_all

        draw_all(options, cache)
    idle = idle_lines(cell for cell in ledger.cells if cell["table"] == options.table())
    for line in idle:
        say(line)
    if idle and not options.short:  # in a few steps some losses have nothing to do
        sys.exit(1)


def prepare(options: Options, cache: FitCache) -> None:
    """Scenes and points into the cache; whoever cannot be used is named, and the others go on."""
    unusable = 0
    for name in options.scenes:
        try:
            list(synthetic_scenes(dataclasses.replace(options, scenes=(name,)), cache))
        except ValueError as error:
            unusable += 1
            say(f"    {error}")
    for folder, train, evaluation in options.pairs():
        prepared(options, cache, captured_scene(folder, train, evaluation, downscale=options.downscale))
    if unusable:
        sys.exit(1)


if __name__ == "__main__":
    main()
