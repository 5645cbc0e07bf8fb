"""The verbs that score anyone's renders and write pages about scores."""

from __future__ import annotations

import csv
import os
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from tyro.conf import Positional

if TYPE_CHECKING:
    from ..core.cameras import Cameras
    from ..evaluation.metrics.perceptual import Lpips
    from ..evaluation.scoring.conventions import SceneExtent
    from ..evaluation.scoring.renders import Method
    from ..evaluation.scoring.views import Truth

CAPTION_KEYS = ("psnr", "ssim", "coverage")


def evaluate(
    renders: Positional[tuple[str, ...]],
    gt: Path,
    out: Path = Path("out/evaluate"),
    against: tuple[str, ...] = (),
    masks: Path | None = None,
    convention: str | None = None,
    metrics: tuple[str, ...] = (),
    lpips: Literal["none", "alex", "vgg", "squeeze"] = "none",
    downscale: float = 1.0,
    eval_split: str | None = None,
    train_split: str | None = None,
    normalize: bool = True,
    depth_along: Literal["ray", "axis"] = "ray",
    occlusion: bool | None = None,
    min_views: int = 1,
    sort: str | None = None,
    pairs: int = 12,
    side_by_side: bool = True,
    resamples: int = 1000,
    seed: int = 0,
) -> None:
    """Score anyone's renders against photos: a page, a results file, a table. No field is needed.

    Args:
        renders: folders of colour pictures named as the photos are, DIR or NAME=DIR; depth, accumulation, normals and
            uncertainty maps beside them if there are any (docs/evaluation.md).
        gt: folder of the photos, or a capture (transforms.json or a COLMAP model), of which eval-split says which.
        out: folder for report.html, results.json and images.csv.
        against: renders that the others are compared with, DIR or NAME=DIR; without it, the first of several.
        masks: masks.npz of `unghost masks` (what the training photos saw, depth, cameras), or a folder of
            white-on-black pictures.
        convention: how to mask, score and average; without it proper if its maps are there, else visible_only, else
            whole_image. An unknown name lists all.
        metrics: only these; a metric whose maps are missing is then an error instead of a dash.
        lpips: its backbone; scores of two backbones are different quantities.
        downscale: photo pixels per pixel of the renders, along each axis.
        eval_split: the sweep of a capture that was rendered; eval, test or val unless given, all if it has no sweeps.
        train_split: the sweep that was trained on; its cameras set the depth limit where there is no masks.npz. train,
            if there is one, unless given.
        normalize: the renders' depth, and masks.npz, are in the capture's normalised units (see unghost masks).
        depth_along: what the renders' depth is measured along: the pixel's ray, or the camera's optical axis.
        occlusion: masks.npz: only what nothing hides from the training cameras; without it, if the file can tell.
        min_views: masks.npz: training views that must see a pixel's point.
        sort: the worst views by this metric come first; psnr unless given, or the first of the metrics.
        pairs: how many views are shown as pictures.
        side_by_side: score under every other convention, too, and tabulate how far they differ; it takes most of the
            time.
        resamples: of the bootstrap.
        seed: of the bootstrap.
    """
    import numpy as np

    from ..core.results import build_results
    from ..evaluation.scoring.comparison import choose_convention, compare_methods

    key = _sort_key(sort, metrics)  # refused before anything is read
    if not renders:
        raise ValueError("evaluate: no folder of renders is given")
    scene = _scene(gt, masks, downscale, eval_split, train_split, normalize, occlusion, min_views)
    methods = _methods(_named([*against, *renders]), scene, depth_along)
    name = choose_convention(convention, methods, scene.truth, scene.extent)
    network, unavailable = _network(lpips, metrics)
    references = [each.name for each in methods[: len(against)]]
    if not references and len(methods) > 1:
        references = [methods[0].name]
    print(f"{len(methods)} method{'s' * (len(methods) > 1)}, {len(scene.truth)} views, convention {name}", flush=True)
    found = compare_methods(
        methods,
        scene.truth,
        scene.extent,
        np.random.default_rng(seed),
        convention=name,
        references=references,
        network=network,
        keys=metrics or None,
        resamples=resamples,
        side_by_side=side_by_side,
    )
    notes = [*scene.notes, *_not_proper(convention, name, methods, scene), *unavailable]
    details = _details(gt, scene, found["rows"], references, name, key) | {"notes": notes}
    command = shlex.join(["unghost", *sys.argv[1:]])
    results = build_results(found.pop("rows"), command=command, seeds=[seed], evaluation=details, **found)
    _write(out, results, methods, scene, pairs)
    _say(results)
    print(f"{out / 'report.html'}, results.json, images.csv")


def report(results: Positional[Path], out: Path | None = None) -> None:
    """Make the page of a results file: tables by convention, PSNR over coverage, differences.

    Args:
        results: JSON as unghost evaluate and the benchmarks write it (docs/formats.md).
        out: the page; RESULTS with the ending .html unless given.
    """
    from ..evaluation.report.page import read_results, write_page

    target = results.with_suffix(".html") if out is None else out
    write_page(target, read_results(results))
    print(target)


def _sort_key(sort: str | None, metrics: Sequence[str]) -> str:
    """What the views are sorted by: it must be computed."""
    from ..evaluation.report.pictures import worst_first

    key = sort or ("psnr" if not metrics or "psnr" in metrics else metrics[0])
    worst_first([], key)
    if metrics and key not in metrics:
        raise ValueError(f"evaluate: --sort {key} must be one of --metrics {' '.join(metrics)}")
    return key


def _named(given: Sequence[str]) -> dict[str, Path]:
    """Method -> folder, from DIR or NAME=DIR; a name or a folder may have a = in it."""
    found: dict[str, Path] = {}
    for word in given:
        cuts = [place for place, letter in enumerate(word) if letter == "=" and place]
        cut = next((place for place in cuts if Path(word[place + 1 :]).is_dir()), cuts[0] if cuts else None)
        alone = cut is None or Path(word).is_dir()
        path = Path(word) if cut is None or alone else Path(word[cut + 1 :])
        name = path.resolve().name if alone else word[:cut]
        if name in found:
            raise ValueError(f"evaluate: two methods are called {name!r} ({found[name]} and {path}); say NAME=DIR")
        found[name] = path
    return found


@dataclass(frozen=True, eq=False)
class _Scene:
    """What is scored against: photos and masks, lengths, cameras, what to store and to say of them."""

    truth: Truth
    extent: SceneExtent | None
    cameras: Cameras | None
    told: dict[str, Any]
    notes: tuple[str, ...] = ()


def _methods(folders: Mapping[str, Path], scene: _Scene, depth_along: str) -> list[Method]:
    from ..evaluation.scoring.depths import ray_depth
    from ..evaluation.scoring.renders import read_method

    shape = scene.truth.photos.shape[1], scene.truth.photos.shape[2]
    methods = [read_method(name, folder, scene.truth.names, shape) for name, folder in folders.items()]
    if depth_along == "ray":
        return methods
    if scene.cameras is None:
        raise ValueError("evaluate: depth-along axis needs the cameras: masks.npz, or a capture as gt")
    return [
        each
        if each.renders.depth is None
        else replace(each, renders=replace(each.renders, depth=ray_depth(each.renders.depth, scene.cameras)))
        for each in methods
    ]


def _scene(
    gt: Path,
    masks: Path | None,
    downscale: float,
    eval_split: str | None,
    train_split: str | None,
    normalize: bool,
    occlusion: bool | None,
    min_views: int,
) -> _Scene:
    from ..evaluation.captures.colmap import find_model
    from ..evaluation.scoring.conventions import SceneExtent
    from ..evaluation.scoring.pseudo_truth import check_cameras, load_pseudo_truth
    from ..evaluation.scoring.renders import read_masks, read_photos
    from ..evaluation.scoring.views import Truth

    cameras = train_cameras = extent = None
    stored = None if masks is None or masks.is_dir() else load_pseudo_truth(masks)
    views = None if stored is None else stored.names
    if eval_split is not None or (gt / "transforms.json").is_file() or find_model(gt) is not None:
        names, photos, cameras, train_cameras = _capture(gt, views, downscale, eval_split, train_split, normalize)
    else:
        names, photos = read_photos(gt, views, downscale=downscale)
    height, width = photos.shape[1:3]
    if stored is not None and masks is not None:
        size = stored.eval_cameras.width, stored.eval_cameras.height
        if (width, height) != size:
            raise ValueError(
                f"evaluate: the photos are {width} x {height}, {masks} is of {size[0]} x {size[1]}; see --downscale "
                f"(now {downscale:g})"
            )
        check_cameras(masks, stored, eval_cameras=cameras, train_cameras=train_cameras)
        aware = stored.seen_open is not None if occlusion is None else occlusion
        truth = stored.truth(photos, occlusion=aware, minimum_views=min_views)
        told = {"masks": masks.name, "occlusion": aware, "min_views": min_views}
        return _Scene(truth, stored.extent, stored.eval_cameras, told)
    for option, given in (("--occlusion", occlusion is not None), ("--min-views", min_views != 1)):
        if given:
            held = "no masks" if masks is None else f"the pictures in {masks}"
            raise ValueError(f"evaluate: {option} needs --masks masks.npz (of unghost masks), got {held}")
    visible = None if masks is None else read_masks(masks, names, (height, width))
    notes: tuple[str, ...] = ()
    if cameras is not None and train_cameras is None:
        notes = ("No depth limit is known: the capture has no sweep called train (see --train-split).",)
    elif cameras is not None and train_cameras is not None:
        try:
            extent = SceneExtent.of(train_cameras, cameras)
        except ValueError as error:
            notes = (f"No depth limit is known ({error}).",)
    told = {"masks": None if masks is None else masks.name}
    return _Scene(Truth(photos, visible, cameras=cameras, names=names), extent, cameras, told, notes)


def _capture(
    folder: Path,
    views: Sequence[str] | None,
    downscale: float,
    eval_split: str | None,
    train_split: str | None,
    normalize: bool,
) -> tuple[tuple[str, ...], Any, Cameras, Cameras | None]:
    import numpy as np

    from ..evaluation.captures.loading import load_capture
    from ..evaluation.captures.splits import EVAL_NAMES, TRAIN_NAMES, choose_split
    from ..evaluation.scoring.renders import match_names

    capture = load_capture(folder, downscale=downscale, normalize=normalize)
    split = choose_split(capture.splits, eval_split, EVAL_NAMES, "evaluate: --eval-split", whole=True)
    indices = capture.split(split)
    names = tuple(capture.names[index] for index in indices)
    if views is not None:
        position = {name: index for name, index in zip(names, indices)}
        names = match_names(f"photos of split {split!r}", names, views, where=str(folder), whole=False)
        indices = np.array([position[name] for name in names])
    taught = None
    if train_split is not None or any(name in capture.splits for name in TRAIN_NAMES):
        named = choose_split(capture.splits, train_split, TRAIN_NAMES, "evaluate: --train-split")
        taught = capture.cameras.select(capture.split(named))
    return names, capture.images(indices), capture.cameras.select(indices), taught


def _network(backbone: str, metrics: Sequence[str]) -> tuple[Lpips | None, list[str]]:
    """LPIPS, or none and why; an error only if it was named among the metrics."""
    from ..evaluation.metrics.perceptual import LpipsUnavailable, load_lpips

    if backbone == "none":
        return None, []
    try:
        return load_lpips(backbone), []
    except LpipsUnavailable as error:
        if "lpips" in metrics:
            raise
        return None, [f"LPIPS is left out. {error}"]


def _not_proper(asked: str | None, name: str, methods: Sequence[Method], scene: _Scene) -> list[str]:
    """Why a convention that nobody named is not the default one."""
    from ..evaluation.scoring.comparison import in_words, lacking_maps
    from ..evaluation.scoring.conventions import DEFAULT_CONVENTION

    if asked is not None or name == DEFAULT_CONVENTION:
        return []
    lacking = lacking_maps(DEFAULT_CONVENTION, methods, scene.truth, scene.extent)
    wanted = dict.fromkeys(key for maps in lacking.values() for key in maps)
    return [f"Scored as {name}: {DEFAULT_CONVENTION} needs {in_words(wanted)}."]


def _details(
    gt: Path, scene: _Scene, rows: Sequence[Mapping[str, Any]], references: Sequence[str], convention: str, sort: str
) -> dict[str, Any]:
    from ..evaluation.report.pictures import PHOTO

    main = rows[len(references) % len(rows)]
    images, photos, extent = main["per_image"], scene.truth.photos, scene.extent
    unsorted = all(each.get(sort) is None and sort not in each["infinite"] for each in images)
    if unsorted and any(each["pixels"] for each in images):  # with no pixel left at all, any order is as good
        known = [key for key in images[0] if any(isinstance(each[key], float) for each in images)]
        raise ValueError(f"evaluate: no view of {main['method']} has a {sort} to sort by, but {', '.join(known)}")
    return {
        "convention": convention,
        "views": len(photos),
        "width": photos.shape[2],
        "height": photos.shape[1],
        "gt": gt.resolve().name,
        "sort": sort,
        "sorted_by": main["method"],
        "references": list(references),
        "wipe": [references[0], main["method"]] if references else [main["method"], PHOTO],
        "extent": None if extent is None else {"limit": extent.limit, "unit": extent.unit},
        **scene.told,
    }


def _write(out: Path, results: Mapping[str, Any], methods: Sequence[Method], scene: _Scene, pairs: int) -> None:
    from ..core.results import write_results
    from ..evaluation.report.page import write_page
    from ..evaluation.report.pictures import view_pictures, worst_first
    from ..evaluation.scoring.conventions import evaluation_masks, get_convention

    rows, facts = results["rows"], results["evaluation"]
    rule = get_convention(facts["convention"])
    kept = {each.name: evaluation_masks(rule, each.renders, scene.truth, scene.extent) for each in methods}
    main = next(row for row in rows if row["method"] == facts["sorted_by"])
    order = worst_first(main["per_image"], facts["sort"])[: max(pairs, 0)]
    pictures = view_pictures(order, methods, scene.truth, kept, rows, keys=CAPTION_KEYS)
    write_results(out / "results.json", results)
    _write_images(out / "images.csv", rows)
    write_page(out / "report.html", results, pictures)


def _write_images(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
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


def _say(results: Mapping[str, Any]) -> None:
    from ..evaluation.report.rows import format_table
    from ..evaluation.report.tables import EQUAL_KEYS, OWN_KEYS, present

    rows = results["rows"]
    shown = [{**row, **{key: float("inf") for key in row["infinite"]}} for row in rows]
    print(format_table(shown, present(rows, [*OWN_KEYS, *EQUAL_KEYS])))
    for note in results["evaluation"]["notes"]:
        print(note)
