"""The verbs that score anyone's renders and write pages about scores."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from ..core.errors import InvalidArgument


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
    from ..evaluation.scoring.evaluation import evaluate as score

    results = score(
        _named(renders),
        gt,
        against=_named(against),
        masks=masks,
        convention=convention,
        metrics=metrics,
        lpips=lpips,
        downscale=downscale,
        eval_split=eval_split,
        train_split=train_split,
        normalize=normalize,
        depth_along=depth_along,
        occlusion=occlusion,
        min_views=min_views,
        sort=sort,
        side_by_side=side_by_side,
        resamples=resamples,
        seed=seed,
        progress=lambda said: print(said, flush=True),
    )
    results.write(out, pairs=pairs, command=shlex.join(["unghost", *sys.argv[1:]]))
    print(results.table())
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
            raise InvalidArgument(f"evaluate: two methods are called {name!r} ({found[name]} and {path}); say NAME=DIR")
        found[name] = path
    return found
