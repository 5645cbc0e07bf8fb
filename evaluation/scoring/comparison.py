"""Several methods' renders of the same views, scored and compared under one convention: everything a report shows."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.errors import InvalidArgument
from ...core.results import json_ready
from ..metrics.checks import Mask
from ..metrics.perceptual import Lpips
from ..report.rows import convention_rows
from .conventions import (
    CONVENTIONS,
    DEFAULT_CONVENTION,
    PLAIN_CONVENTIONS,
    SceneExtent,
    evaluation_masks,
    get_convention,
    missing_maps,
)
from .curves import Curve, against_points, compare, cut_to_coverage
from .engine import SceneScores, score_scene, score_under_all, summarize
from .intervals import RESAMPLES, bootstrap_difference
from .protocol import common_mask
from .renders import Method
from .views import Truth

KNOB_STEPS = 10  # coverages at which a method with a knob is scored: its own, and nine evenly below it
EVERY_CONVENTION = (*CONVENTIONS, *PLAIN_CONVENTIONS)
FALLBACKS = (DEFAULT_CONVENTION, "visible_only", "whole_image")
IN_WORDS = {
    "truth.visible": "masks of what the training photos saw",
    "renders.depth": "depth beside the renders",
    "renders.accumulation": "accumulation beside the renders",
    "extent": "the cameras of both sweeps",
}


def possible_conventions(methods: Sequence[Method], truth: Truth, extent: SceneExtent | None) -> tuple[str, ...]:
    """Those whose maps are there for every method."""
    return tuple(name for name in EVERY_CONVENTION if not lacking_maps(name, methods, truth, extent))


def lacking_maps(
    name: str, methods: Sequence[Method], truth: Truth, extent: SceneExtent | None
) -> dict[str, tuple[str, ...]]:
    """Method -> maps that a convention needs and that are not there; nothing where all are."""
    rule = get_convention(name)
    found = {each.name: missing_maps(rule, each.renders, truth, extent_known=extent is not None) for each in methods}
    return {method: maps for method, maps in found.items() if maps}


def choose_convention(name: str | None, methods: Sequence[Method], truth: Truth, extent: SceneExtent | None) -> str:
    """The named convention, refused if a method lacks its maps; without a name the best of ``FALLBACKS`` that goes.

    Raises:
        ValueError: unknown, or maps missing: which, of which method, and which conventions these maps do allow.
    """
    possible = possible_conventions(methods, truth, extent)
    if name is None:
        return next(each for each in FALLBACKS if each in possible)
    lacking = lacking_maps(name, methods, truth, extent)
    if lacking:
        listed = "; ".join(f"{method}: {in_words(maps)}" for method, maps in lacking.items())
        raise InvalidArgument(
            f"convention {name!r} needs what is not there ({listed}); what is there allows {', '.join(possible)}"
        )
    return name


def in_words(maps: Iterable[str]) -> str:
    """What :func:`lacking_maps` found, for people."""
    return ", ".join(IN_WORDS[each] for each in maps)


def compare_methods(
    methods: Sequence[Method],
    truth: Truth,
    extent: SceneExtent | None,
    rng: np.random.Generator,
    *,
    convention: str,
    references: Sequence[str] = (),
    network: Lpips | None = None,
    keys: Iterable[str] | None = None,
    resamples: int = RESAMPLES,
    side_by_side: bool = True,
) -> dict[str, Any]:
    """Score methods on the same views; JSON-able, without NaN and infinity.

    Args:
        methods: of different names.
        truth: of the views.
        extent: as :func:`unghost.evaluation.scoring.engine.score_scene` takes it.
        rng: of the bootstrap.
        convention: of all rows.
        references: methods that the others are compared with, image by image.
        network, keys: as :func:`unghost.evaluation.scoring.engine.score_scene` takes them.
        resamples: of the bootstrap.
        side_by_side: score under every other convention, too.

    Returns:
        ``rows``: a method each: :func:`unghost.evaluation.scoring.engine.summarize`, and ``per_image``, ``notes``,
        ``infinite`` (metrics whose mean is infinite, stored as null: a render equals its photo), ``psnr_common`` and
        ``coverage_common`` (on the pixels that count for *every* method), ``curve`` (of a method with a knob) and
        ``point`` (of any), in whose PSNR every pixel counts alike, whichever view it is in,
        ``at_coverage``, ``psnr_at_coverage`` and ``psnr_area`` of :func:`unghost.evaluation.scoring.curves.compare`.
        ``differences``: method less reference over the same images, with intervals. ``against_points``: curves
        against points at the points' own coverages. ``conventions``: method -> rows of
        :func:`unghost.evaluation.report.rows.convention_rows`.

    Raises:
        ValueError: two methods of one name, an unknown reference, and what
            :func:`unghost.evaluation.scoring.engine.score_scene` refuses.
    """
    names = [each.name for each in methods]
    if not names or len(set(names)) != len(names):
        raise InvalidArgument(f"compare_methods: methods must be at least one, of different names, got {names}")
    unknown = set(references) - set(names)
    if unknown:
        raise InvalidArgument(f"compare_methods: references must be among {names}, got {sorted(unknown)}")
    draws = int(rng.integers(2**32))  # the same for every row: equal renders have equal intervals
    rule, asked = get_convention(convention), None if keys is None else tuple(keys)
    scores: dict[str, SceneScores] = {}
    for each in methods:
        scores[each.name] = score_scene(each.renders, truth, extent, convention=convention, network=network, keys=asked)
    masks = {each.name: evaluation_masks(rule, each.renders, truth, extent) for each in methods}
    shared = _on_common_pixels(methods, truth, extent, convention, masks) if len(methods) > 1 else {}
    rows = []
    for each in methods:
        row = _row(each.name, scores[each.name], np.random.default_rng(draws), resamples)
        row |= {key: shared[each.name].means().get(stored) for key, stored in _COMMON.items()} if shared else {}
        if each.confidence is not None:
            row["curve"] = _knob(each, truth, extent, convention, masks[each.name])
        row["point"] = {
            "coverage": row.get("coverage"),
            **scores[each.name].pooled(("psnr",)),
            "convention": convention,
        }
        rows.append(row)
    ahead = _equal_coverage(rows)
    result: dict[str, Any] = {"rows": rows, "against_points": ahead}
    result["differences"] = _differences(scores, shared, references, draws, resamples)
    if side_by_side:
        result["conventions"] = {
            each.name: _side_by_side(each, truth, extent, network, scores[each.name] if asked is None else None)
            for each in methods
        }
    return dict(json_ready(result))


_COMMON = {"psnr_common": "psnr", "coverage_common": "coverage"}


def _row(name: str, scores: SceneScores, rng: np.random.Generator, resamples: int) -> dict[str, Any]:
    row = summarize(name, {"scene": scores}, rng, resamples=resamples)
    del row["per_scene"]  # there is one
    keys = get_convention(scores.convention).keys
    row["infinite"] = [key for key in keys if _infinite(row[key])]
    row["notes"] = dict(scores.notes)
    row["per_image"] = [{**each, "infinite": [key for key in keys if _infinite(each[key])]} for each in scores.images]
    return row


def _infinite(value: Any) -> bool:
    return value is not None and bool(np.isinf(value))


def _on_common_pixels(
    methods: Sequence[Method], truth: Truth, extent: SceneExtent | None, convention: str, masks: Mapping[str, Mask]
) -> dict[str, SceneScores]:
    everyones = common_mask(list(masks.values()))
    keys = _curve_keys(convention)
    return {
        each.name: score_scene(each.renders, truth, extent, convention=convention, within=everyones, keys=keys)
        for each in methods
    }


def _curve_keys(convention: str) -> tuple[str, ...]:
    return tuple(key for key in ("psnr", "coverage") if key in get_convention(convention).keys)


def _knob(
    method: Method, truth: Truth, extent: SceneExtent | None, convention: str, mask: Mask
) -> list[dict[str, Any]]:
    """Scores of the surest pixels, from all that count down to a tenth of them; every pixel counts alike."""
    confidence: NDArray[Any] | None = method.confidence
    if confidence is None or "coverage" not in get_convention(convention).keys:
        return []
    rows = []
    for share in np.linspace(1.0, 1.0 / KNOB_STEPS, KNOB_STEPS):
        kept = cut_to_coverage(mask, confidence, coverage=float(share * mask.mean()))
        found = score_scene(
            method.renders, truth, extent, convention=convention, within=kept, keys=_curve_keys(convention)
        )
        means = found.means() | found.pooled(("psnr",))
        rows.append(
            {
                "share_kept": float(share),
                **{key: means[key] for key in ("coverage", "psnr", "convention", "images_scored")},
            }
        )
    return rows


def method_curves(rows: Sequence[Mapping[str, Any]]) -> dict[str, Curve]:
    """PSNR over coverage of every method that has a finite one, from the rows of :func:`compare_methods`."""
    curves = {}
    for row in rows:
        points = row.get("curve") or [row["point"]]
        known = [each for each in points if None not in (each.get("psnr"), each.get("coverage"))]
        if any(np.isfinite(each["psnr"]) for each in known):
            knob = "share_kept" if row.get("curve") else None
            curves[row["method"]] = Curve.create(row["method"], known, knob=knob)
    return curves


def _equal_coverage(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Add the columns of :func:`compare` to the rows; give curves against points."""
    curves = list(method_curves(rows).values())
    if not curves:
        return []
    found = {each["method"]: each for each in compare(curves)}
    for row in rows:
        if row["method"] in found and any(each["psnr_at_coverage"] is not None for each in found.values()):
            row |= {key: found[row["method"]][key] for key in ("at_coverage", "psnr_at_coverage", "psnr_area")}
    return against_points(curves)


def _differences(
    scores: Mapping[str, SceneScores],
    shared: Mapping[str, SceneScores],
    references: Sequence[str],
    draws: int,
    resamples: int,
) -> list[dict[str, Any]]:
    rows = []
    for reference in references:
        for name in (each for each in scores if each not in references):
            pairs = {key: (scores[name].values(key), scores[reference].values(key)) for key in _keys(scores[name])}
            if shared:
                pairs["psnr_common"] = shared[name].values("psnr"), shared[reference].values("psnr")
            for key, (first, second) in pairs.items():
                found = bootstrap_difference(first, second, np.random.default_rng(draws), resamples=resamples)
                if found.count:
                    rows.append(
                        {
                            "method": name,
                            "against": reference,
                            "convention": scores[name].convention,
                            "metric": key,
                            "difference": found.mean,
                            "low": found.low,
                            "high": found.high,
                            "images": found.count,
                            "images_undefined": found.undefined,
                        }
                    )
    return rows


def _keys(scores: SceneScores) -> tuple[str, ...]:
    return get_convention(scores.convention).keys


def _side_by_side(
    method: Method, truth: Truth, extent: SceneExtent | None, network: Lpips | None, own: SceneScores | None
) -> list[dict[str, Any]]:
    possible = possible_conventions([method], truth, extent)
    known = {} if own is None else {own.convention: own}
    others = [name for name in possible if name not in known]
    known |= score_under_all(method.renders, truth, extent, conventions=others, network=network)
    return convention_rows({name: known[name].means() for name in possible})
