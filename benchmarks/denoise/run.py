"""The reference measurement: how well, and how fast, one denoising step restores cubes that nobody trained on.

    python -m benchmarks.denoise.run --meshes MESHES --harvest out/harvest-val --unseen out/harvest-mlp --capture
    CAPTURE
    python -m benchmarks.denoise.run --short       procedural cubes where no meshes are given, the sample of the harvest

Sets (``sets.py``): ``clean`` and ``synthetic`` (bits: cubes of meshes of the ``test`` split, every family of
corruption at five severities, and ``mixed`` as recipes have it), ``synthetic-soft``, ``harvest`` (fields fitted to
scenes that were not trained on), ``harvest-unseen-field`` (of a kind not trained on) and ``capture`` (a real
capture's field against its pseudo ground truth, ``capture_cubes.py``). Methods: the input as it is, classical filters
(``baselines/filters.py``), every model named. Each model is scored at its default timestep; on ``mixed`` also at the
best of a few; one that takes optional channels also without them (``NAME, blind``). Scores: ``scores.py``. Writes
``denoise.json`` and ``denoise.png``; finished rows are kept at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from unghost import load_denoiser
from unghost.baselines.filters import Classical
from unghost.core.arrays import to_numpy
from unghost.core.channels import encode_known, stack_channels
from unghost.core.results import build_results
from unghost.core.shards.packing import dequantize_share, dequantize_signed

from ..compact import rounded, write_lines
from ..fit_cache import file_hash
from ..options import CAPTURE, HARVEST, MESHES, NOT_GIVEN, ROOT, SAMPLE, BenchmarkOptions, given, parse
from ..progress import say, wrote
from .capture_cubes import DOWNSCALE, STEPS
from .figure import draw
from .scores import score
from .sets import MIXED, SEED, SEVERITIES, CubeSet, blind, capture_set, harvest_set, mesh_sets, tells_more
from .speed import SECONDS, UNTRAINED, Model, speed_row, untrained_rows

WEIGHTS = ROOT / "unghost" / "weights"
TIMESTEPS = (100, 300, 500, 700, 999)


@dataclass(frozen=True)
class Options(BenchmarkOptions):
    """What to measure.

    Attributes:
        meshes: folder of meshes with a manifest.csv.
        harvest: folder of harvested shards of scenes that were not trained on.
        many, few: the harvest with other sparse points (``point_sets.py``): 3,000 to 10,000, and 300 to 700 that are
            noisier.
        unseen: the same of a kind of field that was not trained on.
        capture: folder of a real capture.
        models: of those to compare, NAME=FILE (.onnx or .safetensors); ``unghost`` is the shipped one.
        cubes: of each set; a tenth as many of each single family of corruption and severity.
        timesteps: of diffusions, also score all sets at these (a row each, named NAME@t).
        untrained: of ``denoise_speed.UNTRAINED``: networks that have no weights, for a row with their speed.
        seconds: of timing each model, at least.
        fits: of the capture: how many fields, steps of each, photo pixels per pixel.
        cache: where the capture's fields and cubes are kept.
    """

    SHORT: ClassVar[dict[str, Any]] = {
        "harvest": SAMPLE,
        "models": ("unghost=default", "xs=xs"),
        "cubes": 8,
        "seconds": 0.5,
        "fits": (1, 10, 32),
    }
    DATA: ClassVar[dict[str, str]] = {
        "meshes": MESHES,
        "harvest": HARVEST,
        "many": HARVEST,
        "few": HARVEST,
        "unseen": HARVEST,
        "capture": CAPTURE,
    }
    SHORT_WITHOUT: ClassVar[tuple[str, ...]] = ("meshes",)

    meshes: Path = NOT_GIVEN
    harvest: Path | None = None
    many: Path | None = None
    few: Path | None = None
    unseen: Path | None = None
    capture: Path | None = None
    models: tuple[str, ...] = ("unghost=default",)
    cubes: int = 400
    timesteps: tuple[int, ...] = ()
    untrained: tuple[Literal[UNTRAINED], ...] = ()  # type: ignore[valid-type]
    seconds: float = SECONDS
    fits: tuple[int, int, float] = (3, STEPS, DOWNSCALE)
    cache: Path = ROOT / "out" / "capture"

    def named(self) -> list[tuple[str, str]]:
        """Names and files of the models."""
        pairs = [text.partition("=") for text in self.models]
        if not all(sign for _, sign, _ in pairs):
            raise ValueError(f"--models: each must be NAME=FILE, got {' '.join(self.models)}")
        return [(name, file) for name, _, file in pairs]


def predict(denoiser: Any, cubes: CubeSet, rows: NDArray[np.int64], timestep: int) -> NDArray[np.float32]:
    """``x0_pred (n, 32, 32, 32)`` for some cubes of a set."""
    about, views, light = cubes.surroundings, cubes.view_count, cubes.transmittance
    known = encode_known(
        surroundings=None if about is None else dequantize_signed(about[rows]),
        view_count=None if views is None else views[rows],
        transmittance=None if light is None else dequantize_share(light[rows]),
        support=None if cubes.support is None else dequantize_share(cubes.support[rows]),
        crossings=None if cubes.crossings is None else dequantize_share(cubes.crossings[rows]),
    )
    channels = stack_channels(denoiser.manifest.channels, cubes.signed[rows], known)
    edge = cubes.edge_fraction[rows]
    if denoiser.kind == "torch":
        import torch

        return to_numpy(denoiser(torch.from_numpy(channels), timestep, torch.from_numpy(edge)))[:, 0]
    result: NDArray[np.float32] = to_numpy(denoiser(channels, timestep, edge))[:, 0]
    return result


def row_of(name: str, denoiser: Any, cubes: CubeSet, timestep: int, *, seen: CubeSet | None = None) -> dict[str, Any]:
    """Scores of one method on one set; ``seen`` is that set as the denoiser is shown it, if in another form."""
    shown = seen or cubes

    def ask(rows: NDArray[np.int64]) -> NDArray[np.float32]:
        return predict(denoiser, shown, rows, timestep)

    found = score(ask, cubes.signed, cubes.labels, cubes.group)
    return {"method": name, "set": cubes.name, **cubes.about, "timestep": timestep, **found}


def with_best_timestep(row: dict[str, Any], name: str, denoiser: Any, cubes: CubeSet) -> dict[str, Any]:
    """The row, and beside it the best of a few timesteps (chosen on this very set: a bound, not a score)."""
    tried = {step: row_of(name, denoiser, cubes, step)["iou"] for step in TIMESTEPS} | {row["timestep"]: row["iou"]}
    best = max(tried, key=lambda step: tried[step])
    return row | {"timestep_best": best, "iou_at_best": tried[best]}


def mean_over_severities(rows: list[dict[str, Any]], method: str) -> dict[str, Any]:
    """One row for the mixed corruption: what the figure and the README show."""
    chosen = [row for row in rows if row["method"] == method and row.get("family") == MIXED]
    keys = ("iou_before", "iou", "iou_p5", "floater_recall", "surface_kept", "holes_filled", "ghosts_removed_98")
    means = {key: float(np.mean([row[key] for row in chosen])) for key in keys}
    return {"method": method, "set": "synthetic", "family": MIXED, "severity": "mean", **means}


def all_sets(options: Options) -> list[CubeSet]:
    """Every set that there is a folder for."""
    meshes = options.meshes if given(options.meshes) else None
    sets = list(mesh_sets(meshes, options.cubes, max(1, options.cubes // 10)))
    harvests = {
        "harvest": options.harvest,
        "harvest-many-points": options.many,
        "harvest-few-points": options.few,
        "harvest-unseen-field": options.unseen,
    }
    for name, folder in harvests.items():
        if folder is not None:
            sets.append(harvest_set(name, folder, options.cubes))
    if options.capture is not None:
        sets.append(capture_set(options.capture, options.cache, options.cubes, *options.fits))
    return sets


def variants_of(name: str, denoiser: Any, timesteps: tuple[int, ...]) -> list[tuple[str, Any, int]]:
    """Ways to use a model: name, denoiser, timestep. A diffusion also at other timesteps, as the paper does it
    (the cube stands for xt), and, in torch, with the noise of the timestep added first."""
    found = [(name, denoiser, denoiser.manifest.default_timestep)]
    if denoiser.manifest.family != "diffusion":
        return found
    found += [(f"{name}@{step}", denoiser, step) for step in timesteps]
    if denoiser.kind == "torch":
        import torch

        from unghost.prior.diffusion.noised import NoisedDenoiser

        noised = NoisedDenoiser(denoiser, torch.Generator().manual_seed(SEED))
        found += [(f"{name}+noise@{step}", noised, step) for step in timesteps]
    return found


def measure(options: Options) -> dict[str, Any]:
    """Everything; the file grows with every method."""
    methods = [(name, Classical(name)) for name in Classical.names()]
    methods += [(name, load_model(file, options.threads)) for name, file in options.named()]
    sets, rows = all_sets(options), untrained_rows(options.untrained, options.threads, options.seconds)
    say(f"{sum(map(len, sets))} cubes in {len(sets)} sets, {len(methods)} methods")
    results: dict[str, Any] = {}
    files = dict(options.named())
    priors = {
        name: file_hash(file) if "." in file else load_denoiser(file).manifest.body_sha256
        for name, file in files.items()
    }
    for number, (name, denoiser) in enumerate(methods, 1):
        say(f"[{number}/{len(methods)}] {name}")
        about = {"model": name} if name in files else {}
        for variant, used, timestep in variants_of(name, denoiser, options.timesteps):
            mine = [row_of(variant, used, cubes, timestep) | about for cubes in sets]
            if about and variant == name:
                mine = [
                    with_best_timestep(row, variant, used, cubes) if cubes.about.get("family") == MIXED else row
                    for row, cubes in zip(mine, sets)
                ]
            rows += [*mine, mean_over_severities(mine, variant) | about]
            say(_headline(rows, variant))
        if len(denoiser.manifest.channels) > 1:
            rows += [
                row_of(f"{name}, blind", denoiser, blind(cubes), denoiser.manifest.default_timestep) | about
                for cubes in sets
                if tells_more(cubes)
            ]
        if name in files:
            rows.append(
                speed_row(Model.of(name, files[name], WEIGHTS), options.threads, seconds=options.seconds) | about
            )
        results = build_results(
            rows, command=options.command(), seeds=[SEED], priors=priors, severities=list(SEVERITIES)
        )
        write_lines(options.out / "denoise.json", rounded(results, 6))
    return results


def load_model(file: str, threads: int) -> Any:
    """A denoiser by name or file; the number of threads is onnxruntime's or torch's."""
    if not file.endswith(".safetensors"):
        return load_denoiser(file, threads=threads)
    import torch

    torch.set_num_threads(threads)
    return load_denoiser(file)


def _headline(rows: list[dict[str, Any]], method: str) -> str:
    mine = [row for row in rows if row["method"] == method]
    mean = next(row for row in mine if row.get("severity") == "mean")
    text = f"{method:22s} mixed {mean['iou_before']:.3f} -> {mean['iou']:.3f}"
    for row in mine:
        if row["set"].startswith("harvest") or row["set"] == "capture":
            text += f"  {row['set']} {row['ghosts_removed_98']:.3f}"
        if row["set"] == "clean":
            text += f"  clean {row['iou']:.3f}"
    return text


def main() -> None:
    options = parse(Options, __doc__)
    results = measure(options)
    draw(options.out / "denoise.png", results["rows"])
    wrote(options.out / "denoise.json", options.out / "denoise.png")


if __name__ == "__main__":
    main()
