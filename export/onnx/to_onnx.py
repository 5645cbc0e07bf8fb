"""Write a checkpoint as a single-step ONNX denoiser."""

from __future__ import annotations

from pathlib import Path

from ...core.errors import InvalidArgument, needs_extra
from ...core.manifest import Manifest
from ..container import write_sealed


def export_onnx(checkpoint_path: str | Path, out_path: str | Path, *, verify_cubes: int = 8) -> Manifest:
    """Export with a free batch dimension, opset 18, and the manifest as the file's metadata.

    Inputs ``channels (N, C, 32, 32, 32) float32`` in [-1, 1], ``timestep (N,) int64``, ``edge_fraction (N,)
    float32``; output ``x0_pred (N, 1, 32, 32, 32) float32``. The graph is the planar twin of the network
    (``export/onnx/planar.py``; of the paper's U-Net a plain one, ``export/onnx/unet_graph.py``). It is compared with
    torch before a file appears under ``out_path``.

    Args:
        checkpoint_path: of ``unghost.prior.checkpoint.save_model``.
        out_path: written whole or not at all.
        verify_cubes: random cubes to compare; 0 to skip.

    Returns:
        The manifest in the file.

    Raises:
        ImportError: torch, safetensors or onnx is missing.
        ValueError: an unreadable checkpoint, or outputs that differ by more than 1e-4 (2e-3 for a U-Net).
    """
    with needs_extra("export", caller="export_onnx"):
        import onnx

        from ...prior.checkpoint import load_model
        from .diffusion_graph import denoiser_model, export_tolerance
    denoiser = load_model(checkpoint_path)
    model = denoiser_model(denoiser.network)
    onnx.checker.check_model(model, full_check=True)
    body = model.SerializeToString(deterministic=True)
    if verify_cubes:
        from .parity import compare, parity_inputs, session_denoiser

        inputs = parity_inputs(verify_cubes, 0, channels=denoiser.manifest.channels)
        report = compare(session_denoiser(body, denoiser.manifest), denoiser, inputs)
        allowed = export_tolerance(denoiser.network)
        if not report["max_error"] <= allowed:
            raise InvalidArgument(
                f"export_onnx: ONNX and torch differ by {report['max_error']:.2e}, more than {allowed:g}"
            )
    write_sealed(out_path, body, denoiser.manifest)
    from ..runtime import read_manifest

    return read_manifest(out_path)
