"""Training pairs harvested from badly constrained fields of synthetic scenes."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ...core.lazy import attach

if TYPE_CHECKING:
    from .config import HarvestConfig as HarvestConfig
    from .evidence import replace_evidence as replace_evidence
    from .labels import Truth as Truth
    from .run import harvest as harvest
    from .run import harvest_cubes as harvest_cubes

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        ".config": ["HarvestConfig"],
        ".evidence": ["replace_evidence"],
        ".labels": ["Truth"],
        ".run": ["harvest", "harvest_cubes"],
    },
)
