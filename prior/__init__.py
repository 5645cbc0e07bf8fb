"""The learned prior: network, training, checkpoints (torch)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..core.lazy import attach

if TYPE_CHECKING:
    from .checkpoint import TorchDenoiser as TorchDenoiser
    from .checkpoint import load_model as load_model
    from .checkpoint import save_model as save_model

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        ".checkpoint": ["TorchDenoiser", "load_model", "save_model"],
    },
)
