"""Registry of metrics: label, unit, direction and decimals of every number that a results row carries.

Tables, pages and checks read it, so that one metric has one heading, one arrow and one number of decimals wherever it
is shown. What a row states besides (its settings, such as ``severity`` or ``threads``) is not a metric.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

from .errors import InvalidArgument

Better = Literal["higher", "lower", "none"]


@dataclass(frozen=True)
class Metric:
    """How one number is named, shown and compared.

    Attributes:
        key: of a results row.
        label: heading of a table's column, with the unit where it is shown.
        better: which direction is better; ``none`` for a description, such as coverage.
        decimals: digits after the point.
        unit: ``dB``, ``s``, …; empty for shares and other pure numbers.
        name: for sentences, without the unit; the label unless given.
        conventions: names of the published ways to compute it, where there are several. Scores of two of them do not
            compare.
    """

    key: str
    label: str
    better: Better
    decimals: int = 3
    unit: str = ""
    name: str = ""
    conventions: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.name:
            object.__setattr__(self, "name", self.label)

    @property
    def sign(self) -> int:
        """1 if higher is better, -1 if lower is, 0 if neither."""
        return {"higher": 1, "lower": -1, "none": 0}[self.better]


IMAGES = (
    Metric("psnr", "PSNR, dB", "higher", 2, "dB", name="PSNR", conventions=("pooled", "per_channel", "all_pixels")),
    Metric(
        "ssim",
        "SSIM",
        "higher",
        conventions=("map_mean", "premasked", "premasked_over_mask", "premasked_whole_windows", "inside_mask"),
    ),
    Metric("lpips", "LPIPS", "lower", conventions=("filled", "premasked_over_mask", "premasked")),
    Metric("flip", "FLIP", "lower"),
)
GEOMETRY = (
    Metric("depth_mse", "depth MSE", "lower", unit="scene unit²"),
    Metric("disparity_mae", "disparity MAE", "lower", unit="1/scene unit", name="disparity error"),
    Metric("disparity_median", "disparity error, median", "lower", unit="1/scene unit"),
    Metric("normal_mean_deg", "normals, mean °", "lower", 1, "°"),
    Metric("normal_median_deg", "normals, median °", "lower", 1, "°"),
    Metric("normal_pct_30", "normals within 30°", "higher"),
)
MASKS = (
    Metric("coverage", "coverage", "none", conventions=("all", "visible")),
    Metric("dice", "Dice", "higher", conventions=("dice", "pixel_accuracy")),
    Metric("mask_precision", "of what is claimed, seen", "higher"),
    Metric("mask_recall", "of what was seen, claimed", "higher"),
    Metric("psnr_common", "PSNR on common pixels", "higher", 2, "dB"),
    Metric("coverage_common", "coverage of those", "none"),
    Metric("psnr_visible", "PSNR on visible pixels", "higher", 2, "dB"),
    Metric("at_coverage", "coverage compared at", "none"),
    Metric("ause", "AUSE, own order", "lower"),
    Metric("ause_by_spread", "AUSE, by spread of depth", "lower"),
    Metric("ause_by_photos", "AUSE, by photo doubt", "lower"),
    Metric("images", "views", "none", 0),
    Metric("images_scored", "views with a pixel scored", "none", 0),
    Metric("views_scored", "views with a pixel scored", "none", 0),
    Metric("runs", "runs", "none", 0),
)
CUBES = (
    Metric("iou", "IoU", "higher"),
    Metric("iou_before", "IoU before", "none"),
    Metric("iou_clean", "IoU, untouched", "higher"),
    Metric("iou_p5", "IoU, fifth percentile", "higher"),
    Metric("iou_at_best", "IoU at the best timestep", "higher"),
    Metric("floater_recall", "ghosts removed", "higher"),
    Metric("floater_precision", "of the removed, ghosts", "higher"),
    Metric("ghosts_removed", "ghosts removed", "higher"),
    Metric("recall_blob", "clusters removed", "higher"),
    Metric("recall_haze", "haze removed", "higher"),
    Metric("recall_needle", "needles removed", "higher"),
    Metric("surface_kept", "surface kept", "higher"),
    Metric("holes_filled", "holes filled", "higher"),
    Metric("free_space_error", "free-space error", "lower", 4, name="opacity left in free space"),
    Metric("opacity_unseen", "opacity where no camera looks", "lower"),
    Metric("cells_added", "cells added, share of the surface", "lower"),
    Metric("cells_missing", "cells missing", "none", 0),
    Metric("cells_that_differ", "cells that differ", "lower", 0),
    Metric("disagreement", "disagreement", "lower"),
    Metric("distance", "distance to the capture", "lower"),
    Metric("empty_share", "cubes that are empty", "none"),
    Metric("cubes", "cubes", "none", 0),
    Metric("groups", "groups of cubes", "none", 0),
    Metric("true_voxels", "true voxels", "none", 0),
    Metric("ghost_voxels", "ghost voxels", "none", 0),
    Metric("splats", "splats", "none", 0),
)
COST = (
    Metric("seconds", "seconds", "lower", 1, "s"),
    Metric("cpu_seconds", "CPU seconds", "lower", 0, "s"),
    Metric("seconds_beside", "seconds beside", "lower", 1, "s"),
    Metric("seconds_of_queries", "seconds of queries", "lower", 1, "s"),
    Metric("milliseconds", "ms", "lower", 1, "ms"),
    Metric("milliseconds_regularized", "ms a regularized step", "lower", 1, "ms"),
    Metric("milliseconds_of_them", "ms of those, regularizer", "lower", 1, "ms"),
    Metric("megabytes", "MB", "lower", 2, "MB"),
    Metric("ratio", "ratio to the first of its kind", "lower", 2, ""),
    Metric("peak_megabytes", "peak MB", "lower", 0, "MB"),
    Metric("parameters", "parameters", "none", 0),
    Metric("gflop", "GFLOP a cube", "lower", 2, "GFLOP"),
    Metric("calls", "calls", "none", 0),
    Metric("windows", "windows", "none", 0),
    Metric("cubes_per_second", "cubes/s", "higher", 0, "1/s"),
    Metric("torch_cubes_per_second", "cubes/s, torch", "higher", 0, "1/s"),
    Metric("loader_cubes_per_second", "cubes/s, loader", "higher", 0, "1/s"),
    Metric("network_cubes_per_second", "cubes/s, network", "higher", 0, "1/s"),
    Metric("training_cubes_per_second", "cubes/s, training", "higher", 0, "1/s"),
    Metric("tests_per_second", "tests/s", "higher", 0, "1/s"),
    Metric("loader_over_network", "loader over network", "higher", 2),
    Metric("times_alone", "times the step alone", "lower", 2),
    Metric("times_the_room", "times the room alone", "lower", 2),
)
CHECKS = (
    Metric("contraction_error", "contraction error", "lower"),
    Metric("largest_difference", "largest difference", "lower"),
    Metric("max_error", "largest error", "lower"),
    Metric("mean_error", "mean error", "lower"),
    Metric("flips", "voxels that flip", "lower", 0),
    Metric("flip_rate", "share of voxels that flip", "lower"),
    Metric("rgb_loss", "colour loss", "lower"),
    Metric("timestep_best", "best timestep", "none", 0),
)
CAPTURES = tuple(
    Metric(f"{key}{end}", label + more, "none", decimals, unit)
    for key, label, decimals, unit in (
        ("translation_to_nearest", "distance to the nearest photo", 2, "scene unit"),
        ("rotation_to_nearest_deg", "turned from the nearest photo, °", 0, "°"),
    )
    for end, more in (("", ""), ("_largest", ", largest"))
)
CUT = ("psnr", "ssim", "disparity_mae", "normal_mean_deg")  # metrics of views cut to a coverage
ORDERS = {  # of the pixels that are given up
    "": "",
    "_by_spread": ", all cut by spread of depth",
    "_by_photos": ", all cut by photo doubt",
    "_at_best": ", knob and order at their best",
}
AT = (0.3, 0.4, 0.5)  # fixed coverages
KEPT = (98, 95, 90)  # percent of the true voxels


def _derived() -> Iterator[Metric]:
    """Metrics at equal coverage, their means over coverages, and ghosts removed while a share of the truth stays."""
    for base in (metric for metric in (*IMAGES, *GEOMETRY) if metric.key in CUT):
        label = base.label.removesuffix(f", {base.unit}")
        name = base.name if base in GEOMETRY else f"masked {base.name}"
        for order, more in ORDERS.items():
            where = f" at equal coverage{more}"
            yield Metric(
                f"{base.key}_at_coverage{order}", label + where, base.better, base.decimals, base.unit, name + where
            )
            mean = f", mean{more}" if order else ", mean over equal coverages"
            shown = f", mean over coverages{more}"
            yield Metric(f"{base.key}_area{order}", label + shown, base.better, base.decimals, base.unit, name + mean)
    for coverage in AT:
        yield Metric(f"psnr_at_{coverage:g}", f"PSNR at coverage {coverage:g}", "higher", 2, "dB")
    for kept in KEPT:
        label = f"ghosts removed, .{kept} kept"
        yield Metric(f"ghosts_removed_{kept}", label, "higher", 2)
        yield Metric(f"ghosts_removed_{kept}_per_group", f"{label} in each group", "higher", 2)


METRICS: Mapping[str, Metric] = MappingProxyType(
    {each.key: each for each in (*IMAGES, *GEOMETRY, *MASKS, *CUBES, *COST, *CHECKS, *CAPTURES, *_derived())}
)


def get_metric(key: str) -> Metric:
    """The registered metric of a key.

    Raises:
        ValueError: an unknown key; the message lists the known ones.

    Example:
        >>> psnr = get_metric("psnr")
        >>> psnr.label, psnr.better, psnr.decimals
        ('PSNR, dB', 'higher', 2)
    """
    if key not in METRICS:
        raise InvalidArgument(f"get_metric: key must be one of {', '.join(METRICS)}, got {key!r}")
    return METRICS[key]


def format_value(value: float | None, key: str) -> str:
    """A metric's value with its decimals, without the unit; a dash for None.

    Example:
        >>> format_value(21.976, "psnr"), format_value(None, "ssim")
        ('21.98', '–')
    """
    return "–" if value is None else f"{value:.{get_metric(key).decimals}f}"
