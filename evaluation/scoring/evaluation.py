"""Score renders of several methods against photos: one call from pictures or arrays to tables, curves and a page."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np

from ...core.errors import InvalidArgument
from ..metrics.perceptual import Lpips, LpipsUnavailable, load_lpips
from ..report.pictures import worst_first
from .comparison import choose_convention, compare_methods, in_words, lacking_maps
from .conventions import DEFAULT_CONVENTION, SceneExtent
from .depths import ray_depth
from .ground_truth import GroundTruth, read_ground_truth
from .intervals import RESAMPLES
from .renders import Method, read_method
from .results import Results
from .views import Renders, Truth

Folder: TypeAlias = str | Path
OneMethod: TypeAlias = Folder | Renders | Method
Methods: TypeAlias = OneMethod | Sequence[OneMethod] | Mapping[str, Folder | Renders]
Backbone: TypeAlias = Literal["none", "alex", "vgg", "squeeze"]
IN_MEMORY = "photos in memory"


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
        raise InvalidArgument("evaluate: no folder of renders is given")
    for name in first.keys() & second.keys():
        raise InvalidArgument(f"evaluate: two methods are called {name!r}, one of them in against")
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
        raise InvalidArgument(f"evaluate: sort must be one of the metrics {' '.join(metrics)}, got {key!r}")
    return key


def _check_sort(results: Results) -> None:
    """Refuse a metric to sort by that no view has."""
    main, key = results.sorted_by, results.sort
    images = main["per_image"]
    unsorted = all(each.get(key) is None and key not in each["infinite"] for each in images)
    if unsorted and any(each["pixels"] for each in images):  # with no pixel left at all, any order is as good
        known = [name for name in images[0] if any(isinstance(each[name], float) for each in images)]
        raise InvalidArgument(f"evaluate: no view of {main['method']} has a {key} to sort by, but {', '.join(known)}")


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
            raise InvalidArgument(f"evaluate: two methods are called {name!r} ({found[name]} and {each}); name them")
        found[name] = each
    return found


def _read(name: str, given: OneMethod, truth: Truth) -> Method:
    if isinstance(given, Method):
        return given
    if isinstance(given, Renders):
        return Method(name, given)
    return read_method(name, given, truth.names, truth.shapes)


def _along_rays(method: Method, truth: Truth, depth_along: str) -> Method:
    if depth_along == "ray":
        return method
    if truth.cameras is None:
        raise InvalidArgument("evaluate: depth_along axis needs the cameras: masks.npz, or a capture as ground truth")
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
        raise InvalidArgument(f"evaluate: {', '.join(named)} must be left out with ground truth in memory (Truth)")


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
