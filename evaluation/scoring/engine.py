"""The same renders scored under any convention: by image, by scene, over scenes, and all conventions side by side."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.errors import InvalidArgument
from ..metrics import pixelwise as metrics
from ..metrics.checks import Mask
from ..metrics.perceptual import Lpips, lpips
from .conventions import (
    AGREEMENT_KEYS,
    CONVENTIONS,
    DEPTH_KEYS,
    NORMAL_KEYS,
    Convention,
    SceneExtent,
    claimed_masks,
    evaluation_masks,
    get_convention,
    missing_maps,
)
from .intervals import bootstrap_scenes, defined
from .views import Renders, Truth, check_match, view_normals

DATA_RANGE = 1.0


@dataclass(frozen=True, eq=False)
class SceneScores:
    """Scores of one method on one scene under one convention.

    Attributes:
        convention: its name.
        images: a row a view: ``name``, ``pixels`` that counted, and each metric of the convention; None where it is
            not defined (no pixel left) or not to be had (``notes``).
        notes: metrics that the convention defines and that are absent, and why.
        lpips_backbone: what LPIPS rests on; None if it was not computed.
    """

    convention: str
    images: tuple[dict[str, Any], ...]
    notes: Mapping[str, str]
    lpips_backbone: str | None = None

    def values(self, key: str) -> list[float | None]:
        """One metric of every view, in order."""
        return [row.get(key) for row in self.images]

    def means(self) -> dict[str, Any]:
        """Means over the views where a metric is defined, ``images`` and ``images_scored`` (with a pixel left).

        None where no view has a value. PSNR of equal images is inf, and so is its mean.
        """
        result: dict[str, Any] = {"convention": self.convention}
        for key in get_convention(self.convention).keys:
            known, _ = defined(self.values(key))
            result[key] = float(known.mean()) if len(known) else None
        result["images"] = len(self.images)
        result["images_scored"] = sum(row["pixels"] > 0 for row in self.images)
        return result

    def pooled(self, keys: Iterable[str]) -> dict[str, float | None]:
        """Means in which every scored pixel counts alike, whichever view it is in (PSNR: of the pooled error).

        For pixels cut to a coverage over all views at once: a mean over views would reward giving up whole views.
        Views count by their scored pixels; None where no view has a value.
        """
        result: dict[str, float | None] = {}
        for key in keys:
            known = [(row[key], row["pixels"]) for row in self.images if row.get(key) is not None and row["pixels"]]
            if not known:
                result[key] = None
                continue
            values, weights = (np.array(column, dtype=np.float64) for column in zip(*known))
            if key == "psnr":
                error = float(np.average(10 ** (-values / 10), weights=weights))
                result[key] = float(-10 * np.log10(error)) if error > 0 else float("inf")
            else:
                result[key] = float(np.average(values, weights=weights))
        return result


def score_scene(
    renders: Renders,
    truth: Truth,
    extent: SceneExtent | None,
    *,
    convention: str,
    within: Mask | None = None,
    network: Lpips | None = None,
    keys: Iterable[str] | None = None,
    pixels_per_degree: float = metrics.PIXELS_PER_DEGREE,
) -> SceneScores:
    """Score a method's renders of one scene under one convention.

    Args:
        renders: of every evaluation view.
        truth: of the same views.
        extent: :meth:`SceneExtent.of` both trajectories; None where no cameras are known, for conventions that have no
            depth limit.
        convention: a name that :func:`get_convention` knows.
        within: ``(n, H, W)`` bool, only these of the convention's pixels count, and are claimed: those of
            :func:`unghost.evaluation.scoring.curves.cut_to_coverage`, or that all compared methods have.
        network: of :func:`unghost.evaluation.metrics.perceptual.load_lpips`; without it LPIPS is None and noted.
        keys: metrics to compute, of those the convention defines; None: all that the maps allow, the others None and
            noted. A metric that is *asked for* without its maps is an error.
        pixels_per_degree: of FLIP.

    Raises:
        ValueError: renders of another shape than the photos, a map missing that the masks or an asked metric need, a
            metric that the convention does not define.

    Example:
        >>> photos = np.full((2, 12, 12, 3), 0.5)
        >>> visible = np.ones((2, 12, 12), dtype=bool)
        >>> renders, truth = Renders(photos + 0.1), Truth(photos, visible)
        >>> scores = score_scene(renders, truth, None, convention="visible_only", keys=["psnr", "coverage"])
        >>> means = scores.means()
        >>> round(means["psnr"], 6), means["coverage"], means["images_scored"]
        (20.0, 1.0, 2)
    """
    rule = get_convention(convention)
    check_match("score_scene", renders, truth)
    masks, claimed = (find(rule, renders, truth, extent) for find in (evaluation_masks, claimed_masks))
    if within is not None:
        if within.dtype != np.bool_ or within.shape != masks.shape:
            raise InvalidArgument(
                f"score_scene: within must be bool of shape {masks.shape}, got {within.dtype} {within.shape}"
            )
        masks, claimed = masks & within, claimed & within
    notes = _absent(rule, renders, truth, network)
    wanted = rule.keys if keys is None else tuple(keys)
    for key in wanted if keys is not None else ():
        if key not in rule.keys:
            raise InvalidArgument(f"score_scene: {convention!r} does not define {key!r}; it has {', '.join(rule.keys)}")
        if key in notes:
            raise InvalidArgument(f"score_scene: {key} was asked for, but {notes[key]}")
    wanted = tuple(key for key in wanted if key not in notes)
    rows = []
    for index, name in enumerate(truth.names):
        mask, surface = (each[index][truth.window(index)] for each in (masks, claimed))
        row: dict[str, Any] = {"name": name, "pixels": int(mask.sum()), **dict.fromkeys(rule.keys)}
        row.update(_image_scores(rule, renders, truth, mask, index, wanted, network, pixels_per_degree))
        row.update(_geometry_scores(rule, renders, truth, mask, index, wanted, extent))
        row.update(_mask_columns(rule, truth, mask, surface, index, wanted))
        rows.append({key: _none_if_nan(value) for key, value in row.items()})
    used = network.backbone if network is not None and "lpips" in wanted else None
    return SceneScores(convention, tuple(rows), notes, used)


def score_under_all(
    renders: Renders,
    truth: Truth,
    extent: SceneExtent | None,
    *,
    conventions: Sequence[str] = tuple(CONVENTIONS),
    network: Lpips | None = None,
) -> dict[str, SceneScores]:
    """The same renders under every convention; one whose maps are missing has no images and a note ``masks``."""
    check_match("score_under_all", renders, truth)
    result = {}
    for name in conventions:
        lacking = missing_maps(get_convention(name), renders, truth, extent_known=extent is not None)
        if lacking:
            result[name] = SceneScores(name, (), {"masks": f"it needs {', '.join(lacking)}"})
        else:
            result[name] = score_scene(renders, truth, extent, convention=name, network=network)
    return result


def summarize(
    method: str,
    scenes: Mapping[str, SceneScores],
    rng: np.random.Generator,
    *,
    level: float = 0.95,
    resamples: int = 1000,
) -> dict[str, Any]:
    """One results row: means over scenes as the convention averages them, and bootstrap intervals.

    Args:
        method: the row's name.
        scenes: name -> scores, all of one convention.
        rng: of the bootstrap; each metric's draws follow the last one's.
        level, resamples: of the intervals.

    Returns:
        ``method``, ``convention``, each metric (None where undefined), ``intervals`` (metric -> [low, high] at
        ``level``), ``images``, ``images_scored``, ``lpips_backbone``, ``per_scene``.

    Raises:
        ValueError: no scene, two conventions or two LPIPS backbones (both named).
    """
    if not scenes:
        raise InvalidArgument("summarize: scenes must hold at least one scene's scores")
    for attribute in ("convention", "lpips_backbone"):
        found = {getattr(each, attribute): name for name, each in scenes.items()}
        if len(found) > 1:
            listed = " and ".join(f"{value!r} (scene {name!r})" for value, name in found.items())
            raise InvalidArgument(f"summarize: scenes of one {attribute} only, got {listed}")
    first = next(iter(scenes.values()))
    rule = get_convention(first.convention)
    row: dict[str, Any] = {"method": method, "convention": rule.name}
    intervals = {}
    for key in rule.keys:
        found_interval = bootstrap_scenes(
            {name: each.values(key) for name, each in scenes.items()},
            rng,
            level=level,
            resamples=resamples,
            mean_over=rule.mean_over,
        )
        row[key] = found_interval.mean
        intervals[key] = [found_interval.low, found_interval.high]
    per_scene = {name: each.means() for name, each in scenes.items()}
    row |= {"intervals": intervals, "level": level, "lpips_backbone": first.lpips_backbone}
    row |= {key: sum(each[key] for each in per_scene.values()) for key in ("images", "images_scored")}
    row["per_scene"] = per_scene
    return row


def _absent(rule: Convention, renders: Renders, truth: Truth, network: Lpips | None) -> dict[str, str]:
    """Metrics that the convention defines and these maps do not allow, and why."""
    notes: dict[str, str] = {}
    if network is None:
        notes["lpips"] = "no LPIPS network was given (see load_lpips)"
    if renders.depth is None or truth.depth is None:
        side = "renders" if renders.depth is None else "truth"
        notes |= dict.fromkeys(DEPTH_KEYS, f"there is no {side}.depth")
    for name, views in (("renders", renders), ("truth", truth)):
        if views.normals is None and (views.depth is None or truth.cameras is None):
            notes |= dict.fromkeys(NORMAL_KEYS, f"there is neither {name}.normals nor its depth with truth.cameras")
    return {key: reason for key, reason in notes.items() if key in rule.keys}


def _image_scores(
    rule: Convention,
    renders: Renders,
    truth: Truth,
    mask: Mask,
    index: int,
    wanted: Sequence[str],
    network: Lpips | None,
    pixels_per_degree: float,
) -> dict[str, float]:
    window = truth.window(index)
    preds, target = (_through_bits(images[index][window], rule.bits) for images in (renders.colours, truth.photos))
    result: dict[str, float] = {}
    if "psnr" in wanted:
        result["psnr"] = metrics.psnr(preds, target, mask, data_range=DATA_RANGE, convention=rule.psnr)
    if "ssim" in wanted:
        result["ssim"] = metrics.ssim(preds, target, mask, data_range=DATA_RANGE, convention=rule.ssim)
    if "flip" in wanted:
        result["flip"] = metrics.flip(preds, target, mask, pixels_per_degree=pixels_per_degree)
    if "lpips" in wanted and network is not None:
        result["lpips"] = lpips(preds, target, mask, network, convention=rule.lpips)
    return result


def _through_bits(image: NDArray[Any], bits: str | None) -> NDArray[Any]:
    if bits is None:
        return image
    stretched = np.clip(image.astype(np.float64), 0, 1) * 255
    return (np.floor(stretched + 0.5) if bits == "round" else np.floor(stretched)) / 255


def _geometry_scores(
    rule: Convention,
    renders: Renders,
    truth: Truth,
    mask: Mask,
    index: int,
    wanted: Sequence[str],
    extent: SceneExtent | None,
) -> dict[str, float]:
    result: dict[str, float] = {}
    window = truth.window(index)
    depth, pseudo = (
        None if each.depth is None else each.depth[index][window].astype(np.float64) for each in (renders, truth)
    )
    surface = pseudo
    if pseudo is not None and rule.clipped_depth and extent is not None:
        surface = np.where(pseudo < extent.limit, pseudo, np.inf)  # no normal where it is cut
        pseudo = np.minimum(pseudo, extent.limit)
    if depth is not None and pseudo is not None:
        if "depth_mse" in wanted:  # uncut, a pixel without a true surface has no depth to compare with
            both = mask & np.isfinite(pseudo) & np.isfinite(depth)
            result["depth_mse"] = metrics.depth_mse(depth, pseudo, both)
        if "disparity_mae" in wanted:
            result["disparity_mae"] = metrics.disparity_mae(depth, pseudo, mask)
    if any(key in wanted for key in NORMAL_KEYS):
        first, second = (
            view_normals(None if views.normals is None else views.normals[index][window], each, truth.cameras, index)
            for views, each in ((renders, depth), (truth, surface))
        )
        if first is not None and second is not None:
            if surface is not None and truth.normals is not None:  # given ones know nothing of a limit
                second = np.where(np.isfinite(surface)[..., None], second, np.nan)
            result |= metrics.normal_errors(first, second, mask)
    return {key: value for key, value in result.items() if key in wanted}


def _mask_columns(
    rule: Convention, truth: Truth, mask: Mask, claimed: Mask, index: int, wanted: Sequence[str]
) -> dict[str, float]:
    result: dict[str, float] = {}
    visible = None if truth.visible is None else truth.visible[index][truth.window(index)]
    if "coverage" in wanted:
        if rule.coverage_of == "all":
            result["coverage"] = metrics.coverage(mask)
        elif visible is not None:
            seen = int(visible.sum())
            result["coverage"] = int((mask & visible).sum()) / seen if seen else float("nan")
    if visible is not None:
        agreement = metrics.mask_scores(claimed, visible)
        result |= {key: agreement[rule.dice if key == "dice" else key] for key in AGREEMENT_KEYS if key in wanted}
    return result


def _none_if_nan(value: Any) -> Any:
    return None if isinstance(value, float) and np.isnan(value) else value
