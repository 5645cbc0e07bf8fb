"""Evaluation of renders: captures, metrics, scoring under named conventions, uncertainty, reports."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..core.lazy import attach

if TYPE_CHECKING:
    from .scoring.conventions import SceneExtent as SceneExtent
    from .scoring.engine import SceneScores as SceneScores
    from .scoring.engine import score_scene as score_scene
    from .scoring.evaluation import evaluate as evaluate
    from .scoring.renders import Method as Method
    from .scoring.results import Results as Results
    from .scoring.views import Renders as Renders
    from .scoring.views import Truth as Truth

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        ".scoring.conventions": ["SceneExtent"],
        ".scoring.engine": ["SceneScores", "score_scene"],
        ".scoring.evaluation": ["evaluate"],
        ".scoring.renders": ["Method"],
        ".scoring.results": ["Results"],
        ".scoring.views": ["Renders", "Truth"],
    },
)
