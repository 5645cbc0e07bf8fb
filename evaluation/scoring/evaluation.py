"""Score renders of several methods against photos: one call from pictures or arrays to tables, curves and a page."""

from __future__ import annotations

import csv
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np

from ...core.results import build_results, write_results
from ..metrics.perceptual import Lpips, LpipsUnavailable, load_lpips
from ..report.page import write_page
from ..report.pictures import PHOTO, ViewPictures, view_pictures, worst_first
from ..report.rows import format_table
from ..report.tables import EQUAL_KEYS, OWN_KEYS, present
from .comparison import choose_convention, compare_methods, in_words, lacking_maps, method_curves
from .conventions import DEFAULT_CONVENTION, SceneExtent, evaluation_masks, get_convention
from .curves import Curve
from .depths import ray_depth
from .ground_truth import GroundTruth, read_ground_truth
from .intervals import RESAMPLES
from .renders import Method, read_method
from .views import Renders, Truth

Folder: TypeAlias = str | Path
OneMethod: TypeAlias = Folder | Renders | Method
Methods: TypeAlias = OneMethod | Sequence[OneMethod] | Mapping[str, Folder | Renders]
Backbone: TypeAlias = Literal["none", "alex", "vgg", "squeeze"]
Row: TypeAlias = Mapping[str, Any]  # a row of the results file: docs/formats.md

CAPTION_KEYS = ("psnr", "ssim", "coverage")
PAIRS = 12  # views that a page shows as pictures
IN_MEMORY = "photos in memory"


@dataclass(frozen=True)
class ViewScores:
    """Scores of one view.

    Attributes:
        name: of the view.
        pixels: that count.
        scores: metric -> value; None where it is not defined, inf where the render equals its photo.
    """

    name: str
    pixels: int
    scores: Mapping[str, float | None]


@dataclass(frozen=True, eq=False)
class Results:
    """What :func:`evaluate` found.

    Attributes:
        convention: that all rows are scored under.
        rows: a row a method, references first, as in the results file (docs/formats.md).
        differences: each method less each reference, a row a metric, with bootstrap intervals.
        against_points: methods with a knob against those without, at the latter's coverage.
        conventions: method -> its renders under every convention, a row a metric; empty unless asked for.
        notes: sentences for the user: what was left out or chosen, and why.
        references: methods that the others are compared with.
        sort: metric by which the views of a page are sorted, the worst first.
        methods: what was scored.
        ground_truth: what it was scored against.
        seed: of the bootstrap.
    """

    convention: str
    rows: tuple[Row, ...]
    differences: tuple[Row, ...]
    against_points: tuple[Row, ...]
    conventions: Mapping[str, Sequence[Row]]
    notes: tuple[str, ...]
    references: tuple[str, ...]
    sort: str
    methods: tuple[Method, ...] = field(repr=False)
    ground_truth: GroundTruth = field(repr=False)
    seed: int = 0

    @property
    def scores(self) -> dict[str, dict[str, float | None]]:
        """Method -> metric -> mean over its views: None if undefined, inf if a render equals its photo."""
        keys = get_convention(self.convention).keys
        return {row["method"]: _restored(row, keys) for row in self.rows}

    @property
    def views(self) -> dict[str, tuple[ViewScores, ...]]:
        """Method -> scores of each view, in order."""
        keys = get_convention(self.convention).keys
        return {
            row["method"]: tuple(
                ViewScores(each["name"], each["pixels"], _restored(each, keys)) for each in row["per_image"]
            )
            for row in self.rows
        }

    @property
    def curves(self) -> dict[str, Curve]:
        """Method -> PSNR over coverage; a single point for a method without a knob. Without scores, no curve."""
        return method_curves(self.rows)

    @property
    def left_out(self) -> dict[str, dict[str, str]]:
        """Method -> metric of the convention that is not computed -> why."""
        return {row["method"]: dict(row["notes"]) for row in self.rows}

    def table(self) -> str:
        """Scores as aligned text, one method a line, then the notes."""
        shown = [{**row, **dict.fromkeys(row["infinite"], float("inf"))} for row in self.rows]
        return "\n".join([format_table(shown, present(self.rows, [*OWN_KEYS, *EQUAL_KEYS])), *self.notes])

    def to_json(self, *, command: str | None = None) -> dict[str, Any]:
        """The results object of docs/formats.md.

        Args:
            command: that was run; the program's own name and arguments if None.
        """
        extra: dict[str, Any] = {"evaluation": self._facts(), "against_points": list(self.against_points)}
        extra["differences"] = list(self.differences)
        if self.conventions:
            extra["conventions"] = dict(self.conventions)
        return build_results(self.rows, command=command, seeds=[self.seed], **extra)

    def page(self, path: Folder, *, pairs: int = PAIRS, command: str | None = None) -> None:
        """Write an HTML page with tables, curves and the worst views as pictures. Needs Pillow (``unghost[eval]``).

        Args:
            path: of the page.
            pairs: how many views are shown as pictures.
            command: as :meth:`to_json` takes it.
        """
        write_page(path, self.to_json(command=command), self._pictures(pairs))

    def write(self, folder: Folder, *, pairs: int = PAIRS, command: str | None = None) -> None:
        """Write ``report.html``, ``results.json`` and ``images.csv``.

        Args:
            folder: made if absent.
            pairs, command: as :meth:`page` takes them.
        """
        out, results, pictures = Path(folder), self.to_json(command=command), self._pictures(pairs)
        write_results(out / "results.json", results)
        _write_views(out / "images.csv", self.rows)
        write_page(out / "report.html", results, pictures)

    @property
    def _sorted_by(self) -> Row:
        """The row of the first method that is no reference."""
        return self.rows[len(self.references) % len(self.rows)]

    def _facts(self) -> dict[str, Any]:
        against, main = self.ground_truth, self._sorted_by["method"]
        extent = against.extent
        return {
            "convention": self.convention,
            "views": len(against.truth),
            "width": against.truth.photos.shape[2],
            "height": against.truth.photos.shape[1],
            "gt": against.name,
            "sort": self.sort,
            "sorted_by": main,
            "references": list(self.references),
            "wipe": [self.references[0], main] if self.references else [main, PHOTO],
            "extent": None if extent is None else {"limit": extent.limit, "unit": extent.unit},
            **against.facts,
            "notes": list(self.notes),
        }

    def _pictures(self, pairs: int) -> list[ViewPictures]:
        rule, truth, extent = get_convention(self.convention), self.ground_truth.truth, self.ground_truth.extent
        masks = {each.name: evaluation_masks(rule, each.renders, truth, extent) for each in self.methods}
        order = worst_first(self._sorted_by["per_image"], self.sort)[: max(pairs, 0)]
        return view_pictures(order, self.methods, truth, masks, self.rows, keys=CAPTION_KEYS)


def evaluate(
    renders: Methods,
    ground_truth: Folder | Truth,
    *,
    against: Methods = (),
    masks: Folder | None = None,
    extent: SceneExtent | None = None,
    convention: str | None = None,
    metrics: Sequence[str] = (),
    lpips: Backbone | Lpips = "none",
    downscale: float = 1.0,
    eval_split: str | None = None,
    train_split: str | None = None,
    normalize: bool = True,
    depth_along: Literal["ray", "axis"] = "ray",
    occlusion: bool | None = None,
    min_views: int = 1,
    sort: str | None = None,
    side_by_side: bool = True,
    resamples: int = RESAMPLES,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> Results:
    """Score renders against photos of the same views. No field is needed.

    Args:
        renders: a folder of colour pictures named as the photos are, with depth, accumulation, normals and uncertainty
            maps beside them if there are any (docs/evaluation.md); or arrays. Several: a sequence, or name -> each.
        ground_truth: a folder of photos, a capture (``transforms.json`` or a COLMAP model), or arrays.
        against: renders that the others are compared with; if empty, the first of several.
        masks: for a folder as ground truth: ``masks.npz`` of ``unghost masks`` (what the training photos saw, depth,
            cameras), or a folder of white-on-black pictures.
        extent: lengths of the scene, which set the depth limit; None for those of the cameras, where they are known.
        convention: how to mask, score and average; None for ``proper`` if its maps are there, else ``visible_only``,
            else ``whole_image``.
        metrics: only these; a metric whose maps are missing is then an error. Empty for all that the maps allow.
        lpips: backbone, or a network; scores of two backbones are different quantities.
        downscale: photo pixels per pixel of the renders, along each axis.
        eval_split: sweep of a capture that was rendered; eval, test or val unless given, all if it has no sweeps.
        train_split: sweep that was trained on; its cameras set the depth limit where there is no ``masks.npz``.
        normalize: the renders' depth and ``masks.npz`` are in the capture's normalised units.
        depth_along: what the renders' depth is measured along: the pixel's ray, or the camera's optical axis.
        occlusion: ``masks.npz``: only what nothing hides from the training cameras; None if the file can tell.
        min_views: ``masks.npz``: training views that must see a pixel's point.
        sort: metric by which a page sorts its views; psnr unless given, or the first of ``metrics``.
        side_by_side: score under every other convention, too; it takes most of the time.
        resamples, seed: of the bootstrap.
        progress: called with a sentence before scoring starts.

    Raises:
        FileNotFoundError: no such folder.
        ValueError: no renders, two methods of one name, renders that do not match the views, maps that are missing
            for what was asked, options that do not go together.

    Example:
        >>> import numpy as np
        >>> from unghost.evaluation import Renders, Truth, evaluate
        >>> photos = np.full((2, 8, 8, 3), 0.5)
        >>> results = evaluate(
        ...     {"ours": Renders(photos + 0.01), "theirs": Renders(photos + 0.1)}, Truth(photos), resamples=10
        ... )
        >>> results.convention
        'whole_image'
        >>> {name: round(scores["psnr"], 1) for name, scores in results.scores.items()}
        {'ours': 40.0, 'theirs': 20.0}
        >>> results.left_out["ours"]
        {'lpips': 'no LPIPS network was given (see load_lpips)'}
    """
    sort = _sort_key(sort, metrics)  # refused before anything is read
    first, second = _named("against", against), _named("renders", renders)
    if not second:
        raise ValueError("evaluate: no folder of renders is given")
    for name in first.keys() & second.keys():
        raise ValueError(f"evaluate: two methods are called {name!r}, one of them in against")
    if isinstance(ground_truth, Truth):
        _refuse_options(masks, downscale, eval_split, train_split, normalize, occlusion, min_views)
        against_what = GroundTruth(IN_MEMORY, ground_truth)
    else:
        against_what = read_ground_truth(
            Path(ground_truth),
            masks=None if masks is None else Path(masks),
            downscale=downscale,
            eval_split=eval_split,
            train_split=train_split,
            normalize=normalize,
            occlusion=occlusion,
            min_views=min_views,
        )
    if extent is not None:
        against_what = replace(against_what, extent=extent)
    truth = against_what.truth
    methods = [_along_rays(_read(name, each, truth), truth, depth_along) for name, each in (first | second).items()]
    name = choose_convention(convention, methods, truth, against_what.extent)
    network, unavailable = _network(lpips, metrics)
    references = list(first) or [each.name for each in methods[: len(methods) > 1]]
    if progress is not None:
        progress(f"{len(methods)} method{'s' * (len(methods) > 1)}, {len(truth)} views, convention {name}")
    found = compare_methods(
        methods,
        truth,
        against_what.extent,
        np.random.default_rng(seed),
        convention=name,
        references=references,
        network=network,
        keys=tuple(metrics) or None,
        resamples=resamples,
        side_by_side=side_by_side,
    )
    chosen = _why_not_default(convention, name, methods, against_what)
    results = Results(
        convention=name,
        rows=tuple(found["rows"]),
        differences=tuple(found["differences"]),
        against_points=tuple(found["against_points"]),
        conventions=found.get("conventions", {}),
        notes=(*against_what.notes, *chosen, *unavailable),
        references=tuple(references),
        sort=sort,
        methods=tuple(methods),
        ground_truth=against_what,
        seed=seed,
    )
    _check_sort(results)
    return results


def _sort_key(sort: str | None, metrics: Sequence[str]) -> str:
    """What the views are sorted by: it must be computed."""
    key = sort or ("psnr" if not metrics or "psnr" in metrics else metrics[0])
    worst_first([], key)
    if metrics and key not in metrics:
        raise ValueError(f"evaluate: sort must be one of the metrics {' '.join(metrics)}, got {key!r}")
    return key


def _check_sort(results: Results) -> None:
    """Refuse a metric to sort by that no view has."""
    main, key = results._sorted_by, results.sort
    images = main["per_image"]
    unsorted = all(each.get(key) is None and key not in each["infinite"] for each in images)
    if unsorted and any(each["pixels"] for each in images):  # with no pixel left at all, any order is as good
        known = [name for name in images[0] if any(isinstance(each[name], float) for each in images)]
        raise ValueError(f"evaluate: no view of {main['method']} has a {key} to sort by, but {', '.join(known)}")


def _named(argument: str, given: Methods) -> dict[str, OneMethod]:
    """Method's name -> folder or arrays."""
    if isinstance(given, Mapping):
        return dict(given)
    several = [given] if isinstance(given, (str, Path, Renders, Method)) else list(given)
    found: dict[str, OneMethod] = {}
    for index, each in enumerate(several):
        if isinstance(each, Method):
            name = each.name
        elif isinstance(each, Renders):
            name = argument if len(several) == 1 else f"{argument} {index + 1}"
        else:
            name = Path(each).resolve().name
        if name in found:
            raise ValueError(f"evaluate: two methods are called {name!r} ({found[name]} and {each}); name them")
        found[name] = each
    return found


def _read(name: str, given: OneMethod, truth: Truth) -> Method:
    if isinstance(given, Method):
        return given
    if isinstance(given, Renders):
        return Method(name, given)
    return read_method(name, given, truth.names, (truth.photos.shape[1], truth.photos.shape[2]))


def _along_rays(method: Method, truth: Truth, depth_along: str) -> Method:
    if depth_along == "ray":
        return method
    if truth.cameras is None:
        raise ValueError("evaluate: depth_along axis needs the cameras: masks.npz, or a capture as ground truth")
    depth = method.renders.depth
    if depth is None:
        return method
    return replace(method, renders=replace(method.renders, depth=ray_depth(depth, truth.cameras)))


def _refuse_options(
    masks: Folder | None,
    downscale: float,
    eval_split: str | None,
    train_split: str | None,
    normalize: bool,
    occlusion: bool | None,
    min_views: int,
) -> None:
    """Refuse options that are for folders where the ground truth is in memory."""
    given = {
        "masks": masks is not None,
        "downscale": downscale != 1.0,
        "eval_split": eval_split is not None,
        "train_split": train_split is not None,
        "normalize": not normalize,
        "occlusion": occlusion is not None,
        "min_views": min_views != 1,
    }
    named = [option for option, is_given in given.items() if is_given]
    if named:
        raise ValueError(f"evaluate: {', '.join(named)} must be left out with ground truth in memory (Truth)")


def _network(backbone: Backbone | Lpips, metrics: Sequence[str]) -> tuple[Lpips | None, list[str]]:
    """LPIPS, or none and why; an error only if it was named among the metrics."""
    if isinstance(backbone, Lpips):
        return backbone, []
    if backbone == "none":
        return None, []
    try:
        return load_lpips(backbone), []
    except LpipsUnavailable as error:
        if "lpips" in metrics:
            raise
        return None, [f"LPIPS is left out. {error}"]


def _why_not_default(asked: str | None, name: str, methods: Sequence[Method], against: GroundTruth) -> list[str]:
    """Why a convention that nobody named is not the default one."""
    if asked is not None or name == DEFAULT_CONVENTION:
        return []
    lacking = lacking_maps(DEFAULT_CONVENTION, methods, against.truth, against.extent)
    wanted = dict.fromkeys(key for maps in lacking.values() for key in maps)
    return [f"Scored as {name}: {DEFAULT_CONVENTION} needs {in_words(wanted)}."]


def _restored(row: Row, keys: Sequence[str]) -> dict[str, float | None]:
    """Scores with infinity where the stored null stands for it."""
    return {key: float("inf") if key in row["infinite"] else row.get(key) for key in keys}


def _write_views(path: Path, rows: Sequence[Row]) -> None:
    """A line a view and method; an empty cell where a metric is undefined, inf where a render equals its photo."""
    keys = [key for key in rows[0]["per_image"][0] if key not in ("name", "pixels", "infinite")]
    partial = path.with_name(path.name + ".partial")
    with partial.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(["method", "convention", "view", "pixels", *keys])
        for row in rows:
            for each in row["per_image"]:
                values = ["inf" if key in each["infinite"] else each[key] for key in keys]
                writer.writerow([row["method"], row["convention"], each["name"], each["pixels"], *values])
    os.replace(partial, path)
