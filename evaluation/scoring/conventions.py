"""Every published way to score the two-trajectory protocol, by name.

Scores of two of them differ by decibels on the very same renders
(:func:`unghost.evaluation.report.rows.format_conventions` prints by how much), so that a row carries its convention
and nothing puts two of them into one column.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from ...core.cameras import Cameras
from ...core.errors import InvalidArgument
from ..metrics.checks import Mask, choose
from ..metrics.masks import predicted_mask
from .protocol import depth_limit, depth_masks
from .views import Renders, Truth

IMAGE_KEYS = ("psnr", "ssim", "lpips")
DEPTH_KEYS = ("depth_mse", "disparity_mae")
NORMAL_KEYS = ("normal_mean_deg", "normal_median_deg", "normal_pct_30")
GEOMETRY_KEYS = (*DEPTH_KEYS, *NORMAL_KEYS)
AGREEMENT_KEYS = ("dice", "iou", "mask_precision", "mask_recall")


@dataclass(frozen=True)
class Convention:
    """What is masked, how each score is formed, and how scores are averaged.

    Attributes:
        name: the key.
        source: whose, and what of it had to be read into it.
        keys: the metrics it defines; nothing else is reported under its name.
        visible: the mask holds only pixels that a training view saw.
        depth_limit: and only pixels whose *predicted* depth is below: ``"scene"`` (twice the largest camera
            distance), ``"unit"`` (two of nerfstudio's units), or None: no such rule.
        accumulation: and only pixels whose predicted accumulation is at least this; None: no such rule.
        psnr, ssim, lpips: the metrics' own conventions.
        bits: ``"round"`` or ``"truncate"`` if colours pass through 8 bits first; None: they do not.
        clipped_depth: pseudo-ground-truth depth is cut at the scene's limit, and has no normal beyond.
        coverage_of: ``"all"`` pixels, or those ``"visible"``.
        dice: which score of the mask of what is claimed (see :func:`claimed_masks`) against what was seen is
            tabulated as Dice: ``"dice"`` or ``"pixel_accuracy"``.
        mean_over: ``"scenes"``: mean of the scenes' means; ``"images"``: of all images of all scenes.
    """

    name: str
    source: str
    keys: tuple[str, ...]
    visible: bool
    depth_limit: str | None
    accumulation: float | None = None
    psnr: str = "pooled"
    ssim: str = "map_mean"
    lpips: str = "filled"
    bits: str | None = None
    clipped_depth: bool = False
    coverage_of: str = "all"
    dice: str = "dice"
    mean_over: str = "scenes"


_RELEASED: dict[str, Any] = {
    "psnr": "per_channel",
    "ssim": "premasked_over_mask",
    "lpips": "premasked_over_mask",
}
_ALL = (
    Convention(
        "proper",
        "this project: nothing that is masked out is looked at; what is removed lowers the coverage beside it",
        (*IMAGE_KEYS, "flip", *GEOMETRY_KEYS, "coverage", *AGREEMENT_KEYS),
        visible=True,
        depth_limit="scene",
        ssim="inside_mask",
        clipped_depth=True,
    ),
    Convention(
        "paper_text",
        "Nerfbusters, section 3. 'Masked versions' of SSIM and LPIPS are not specified: taken as the mean of the "
        "whole images' map over the mask",
        (*IMAGE_KEYS, *GEOMETRY_KEYS, "coverage"),
        visible=True,
        depth_limit="scene",
        mean_over="images",
    ),
    Convention(
        "paper_code",
        "Nerfbusters, published scripts: 8-bit renders, images blanked before SSIM and LPIPS, unclipped pseudo "
        "depth, coverage of the visible pixels, depth limit 2 in nerfstudio's units",
        (*IMAGE_KEYS, *GEOMETRY_KEYS, "coverage"),
        visible=True,
        depth_limit="unit",
        bits="round",
        coverage_of="visible",
        **_RELEASED,
    ),
    Convention(
        "bayes_rays_masked",
        "Bayes' Rays, published evaluation with the visibility masks",
        (*IMAGE_KEYS, "coverage"),
        visible=True,
        depth_limit="unit",
        coverage_of="visible",
        **_RELEASED,
    ),
    Convention(
        "bayes_rays_unmasked",
        "Bayes' Rays, published evaluation without them: what no training view saw counts too",
        (*IMAGE_KEYS, "coverage"),
        visible=False,
        depth_limit="unit",
        **_RELEASED,
    ),
    Convention(
        "free_space_prior",
        "'Optimize the Unseen', published evaluation: the mask is the predicted accumulation alone, visibility enters "
        "coverage and Dice only; its 'Dice' is the share of pixels on which the masks agree",
        (*IMAGE_KEYS, "coverage", "dice"),
        visible=False,
        depth_limit=None,
        accumulation=0.98,
        coverage_of="visible",
        dice="pixel_accuracy",
        **_RELEASED,
    ),
    Convention(
        "nerfbaselines",
        "nerfbaselines' default protocol on images blanked by the paper's mask: 8 bits, everything averaged over all "
        "pixels",
        IMAGE_KEYS,
        visible=True,
        depth_limit="scene",
        psnr="all_pixels",
        ssim="premasked_whole_windows",
        lpips="premasked",
        bits="truncate",
    ),
)
CONVENTIONS: Mapping[str, Convention] = MappingProxyType({each.name: each for each in _ALL})
DEFAULT_CONVENTION = "proper"
_PLAIN = (
    Convention(
        "visible_only",
        "this project, for renders without depth: the pixels that the training photos saw, whatever was rendered "
        "there, so that coverage is the same for everybody",
        (*IMAGE_KEYS, "flip", "coverage"),
        visible=True,
        depth_limit=None,
        ssim="inside_mask",
    ),
    Convention(
        "whole_image",
        "everybody's: nothing is masked, neither what no training photo saw nor what was removed",
        (*IMAGE_KEYS, "flip", "coverage"),
        visible=False,
        depth_limit=None,
    ),
)
PLAIN_CONVENTIONS: Mapping[str, Convention] = MappingProxyType({each.name: each for each in _PLAIN})
"""Not the protocol's: what can be said of renders that come without depth, or of photos that come without masks."""


def get_convention(name: str) -> Convention:
    """The convention of that name, published or plain; an unknown name lists the choices."""
    return choose("get_convention", "name", name, {**CONVENTIONS, **PLAIN_CONVENTIONS})


@dataclass(frozen=True)
class SceneExtent:
    """The two lengths that conventions measure a scene by, in scene units.

    Attributes:
        limit: twice the largest distance between any two camera origins: the paper's text.
        unit: one of nerfstudio's units: the largest camera coordinate about the mean origin, which it scales to 1.
            The paper takes ``limit`` to be 2 of these; it is between 2 and 4 √3 of them.
    """

    limit: float
    unit: float

    def __post_init__(self) -> None:
        for name, value in (("limit", self.limit), ("unit", self.unit)):
            if not (np.isfinite(value) and value > 0):
                raise InvalidArgument(f"SceneExtent: {name} must be finite and > 0, got {value}")

    @classmethod
    def of(cls, train_cameras: Cameras, eval_cameras: Cameras) -> SceneExtent:
        """Of the cameras of both trajectories together; at least two distinct origins."""
        origins = np.concatenate([train_cameras.origins, eval_cameras.origins])
        limit = depth_limit(train_cameras, eval_cameras)
        return cls(limit, float(np.abs(origins - origins.mean(axis=0)).max()))

    def depth_limit(self, convention: Convention) -> float | None:
        """The predicted depth from which on a pixel does not count, in scene units; None: no such rule."""
        return {"scene": self.limit, "unit": 2.0 * self.unit, None: None}[convention.depth_limit]


def missing_maps(
    convention: Convention, renders: Renders, truth: Truth, *, extent_known: bool = True
) -> tuple[str, ...]:
    """Which maps the convention's mask, coverage or Dice need and the caller did not give; ``extent`` if that."""
    needs_visible = convention.visible or convention.coverage_of == "visible" or "dice" in convention.keys
    wanted: dict[str, tuple[bool, Any]] = {
        "truth.visible": (needs_visible, truth.visible),
        "renders.depth": (convention.depth_limit is not None, renders.depth),
        "renders.accumulation": (convention.accumulation is not None, renders.accumulation),
        "extent": (convention.depth_limit is not None, extent_known or None),
    }
    return tuple(name for name, (needed, values) in wanted.items() if needed and values is None)


def evaluation_masks(convention: Convention, renders: Renders, truth: Truth, extent: SceneExtent | None) -> Mask:
    """``(n, H, W)`` bool: the pixels that count under a convention.

    Raises:
        ValueError: a map that the convention needs, or the scene's extent, is missing (named).
    """
    lacking = missing_maps(convention, renders, truth, extent_known=extent is not None)
    if lacking:
        raise InvalidArgument(f"evaluation_masks: convention {convention.name!r} needs {', '.join(lacking)}")
    masks = claimed_masks(convention, renders, truth, extent)
    if convention.visible and truth.visible is not None:
        masks &= truth.visible
    return masks


def claimed_masks(convention: Convention, renders: Renders, truth: Truth, extent: SceneExtent | None) -> Mask:
    """``(n, H, W)`` bool: where the renders claim a surface, by the convention's rules, whether or not it was seen."""
    masks = np.ones(truth.photos.shape[:3], dtype=np.bool_)
    limit = None if extent is None else extent.depth_limit(convention)
    if limit is not None and renders.depth is not None:
        masks &= depth_masks(renders.depth, limit)
    if convention.accumulation is not None and renders.accumulation is not None:
        masks &= predicted_mask(renders.accumulation, threshold=convention.accumulation)
    inside = truth.inside()
    return masks if inside is None else masks & inside


def one_convention(caller: str, rows: Iterable[Mapping[str, Any]]) -> Any:
    """The convention that all rows share; two different ones are refused, both named.

    Args:
        caller: for the message.
        rows: each with a ``convention`` (None if absent) and, for the message, a ``method`` or a ``seed``.
    """
    first: tuple[Any, Any] | None = None
    for row in rows:
        here = row.get("convention"), row.get("method", row.get("seed", "?"))
        if first is None:
            first = here
        elif here[0] != first[0]:
            raise InvalidArgument(
                f"{caller}: conventions do not mix: {first[0]!r} (row {first[1]!r}) and {here[0]!r} (row {here[1]!r}) "
                "must not stand in one table or column"
            )
    return None if first is None else first[0]
