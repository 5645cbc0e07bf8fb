"""The evaluation protocols, for nerfbaselines."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ...core.lazy import attach

if TYPE_CHECKING:
    from .protocol import MASKS_VARIABLE as MASKS_VARIABLE
    from .protocol import PROTOCOLS as PROTOCOLS
    from .protocol import MaskedProtocol as MaskedProtocol

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        ".protocol": ["MASKS_VARIABLE", "MaskedProtocol", "PROTOCOLS"],
    },
)
