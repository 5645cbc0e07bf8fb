"""Per-pixel uncertainty of renders, and how well it ranks errors."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ...core.lazy import attach

if TYPE_CHECKING:
    from .photometric import UNSEEN as UNSEEN
    from .photometric import photo_doubt as photo_doubt
    from .sparsification import sparsify as sparsify

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        ".photometric": ["UNSEEN", "photo_doubt"],
        ".sparsification": ["sparsify"],
    },
)
