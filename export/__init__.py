"""ONNX export and the torch-free runtime."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..core.lazy import attach

if TYPE_CHECKING:
    from .container import precision_of as precision_of
    from .runtime import OnnxDenoiser as OnnxDenoiser
    from .runtime import read_manifest as read_manifest

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        ".container": ["precision_of"],
        ".runtime": ["OnnxDenoiser", "read_manifest"],
    },
)
