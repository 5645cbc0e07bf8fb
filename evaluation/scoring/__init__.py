"""Scores under named conventions: masks, views, curves over coverage, intervals, comparisons."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ...core.lazy import attach

if TYPE_CHECKING:
    from .comparison import choose_convention as choose_convention
    from .comparison import compare_methods as compare_methods
    from .comparison import in_words as in_words
    from .comparison import lacking_maps as lacking_maps
    from .conventions import DEFAULT_CONVENTION as DEFAULT_CONVENTION
    from .conventions import DEPTH_KEYS as DEPTH_KEYS
    from .conventions import NORMAL_KEYS as NORMAL_KEYS
    from .conventions import SceneExtent as SceneExtent
    from .conventions import evaluation_masks as evaluation_masks
    from .conventions import get_convention as get_convention
    from .curves import Curve as Curve
    from .curves import cut_to_coverage as cut_to_coverage
    from .depths import optical_depth as optical_depth
    from .depths import ray_depth as ray_depth
    from .engine import SceneScores as SceneScores
    from .engine import score_scene as score_scene
    from .engine import score_under_all as score_under_all
    from .engine import summarize as summarize
    from .intervals import Interval as Interval
    from .intervals import bootstrap_scenes as bootstrap_scenes
    from .pseudo_truth import PseudoTruth as PseudoTruth
    from .pseudo_truth import check_cameras as check_cameras
    from .pseudo_truth import load_pseudo_truth as load_pseudo_truth
    from .pseudo_truth import make_pseudo_truth as make_pseudo_truth
    from .renders import Method as Method
    from .renders import match_names as match_names
    from .renders import read_map as read_map
    from .renders import read_masks as read_masks
    from .renders import read_method as read_method
    from .renders import read_photos as read_photos
    from .views import Renders as Renders
    from .views import Truth as Truth
    from .views import pad_views as pad_views

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        ".comparison": ["choose_convention", "compare_methods", "in_words", "lacking_maps"],
        ".conventions": [
            "DEFAULT_CONVENTION",
            "DEPTH_KEYS",
            "NORMAL_KEYS",
            "SceneExtent",
            "evaluation_masks",
            "get_convention",
        ],
        ".curves": ["Curve", "cut_to_coverage"],
        ".depths": ["optical_depth", "ray_depth"],
        ".engine": ["SceneScores", "score_scene", "score_under_all", "summarize"],
        ".intervals": ["Interval", "bootstrap_scenes"],
        ".pseudo_truth": ["PseudoTruth", "check_cameras", "load_pseudo_truth", "make_pseudo_truth"],
        ".renders": ["Method", "match_names", "read_map", "read_masks", "read_method", "read_photos"],
        ".views": ["Renders", "Truth", "pad_views"],
    },
)
