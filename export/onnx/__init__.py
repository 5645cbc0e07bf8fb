"""Write, quantise and verify ONNX files of a denoiser (needs onnx)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ...core.lazy import attach

if TYPE_CHECKING:
    from .parity import ParityInputs as ParityInputs
    from .parity import verify as verify
    from .quantization import calibration_inputs as calibration_inputs
    from .quantization import export_precisions as export_precisions
    from .to_onnx import export_onnx as export_onnx

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        ".parity": ["ParityInputs", "verify"],
        ".quantization": ["calibration_inputs", "export_precisions"],
        ".to_onnx": ["export_onnx"],
    },
)
