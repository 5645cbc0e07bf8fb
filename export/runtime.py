"""A denoiser from an ONNX file: numpy and onnxruntime, nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.channels import with_unknown
from ..core.errors import InvalidArgument, InvalidFile, InvalidType
from ..core.frames import RESOLUTION
from ..core.manifest import Manifest
from ..core.schedule import check_timestep
from .container import precision_of, unseal

PREFERRED = ("CUDAExecutionProvider", "CPUExecutionProvider")
CHUNK = 64  # cubes in one call of onnxruntime; bounds the memory of large batches


def read_manifest(path: str | Path) -> Manifest:
    """The manifest of an ONNX file, after checking the whole file against it.

    Example:
        >>> import unghost
        >>> read_manifest(Path(unghost.__file__).parent / "weights" / "default.onnx").channels
        ('signed_opacity',)
    """
    return unseal(read_file(path), origin=str(path))


def read_file(path: str | Path) -> bytes:
    """The bytes of a file; ValueError if there is none."""
    source = Path(path)
    if not source.is_file():
        raise InvalidFile(f"{source}: no such file")
    return source.read_bytes()


def choose_providers(asked: Sequence[str] | None, available: Sequence[str]) -> list[str]:
    """Execution providers in order: those asked for, or else CUDA where onnxruntime has it, then the CPU.

    Raises:
        ValueError: none, or one that ``available`` does not hold.

    Example:
        >>> choose_providers(None, ["CUDAExecutionProvider", "CPUExecutionProvider"])
        ['CUDAExecutionProvider', 'CPUExecutionProvider']
    """
    chosen = [name for name in PREFERRED if name in available] if asked is None else list(asked)
    missing = [name for name in chosen if name not in available]
    if missing or not chosen:
        raise InvalidArgument(f"OnnxDenoiser: providers {missing} are not available, onnxruntime has {list(available)}")
    return chosen


def _open(data: bytes, threads: int | None, providers: Sequence[str] | None, origin: str) -> Any:
    import onnxruntime

    chosen = choose_providers(providers, onnxruntime.get_available_providers())
    options = onnxruntime.SessionOptions()
    if threads is not None:
        if threads < 1:
            raise InvalidArgument(f"OnnxDenoiser: threads must be >= 1 or None, got {threads}")
        options.intra_op_num_threads = threads
    try:
        return onnxruntime.InferenceSession(data, options, providers=chosen)
    except Exception as error:  # onnxruntime's errors share no public base class
        raise InvalidFile(f"{origin}: onnxruntime cannot load it ({error})") from None


def _edge_fractions(edge_fraction: Any, count: int) -> NDArray[np.float32]:
    value = np.asarray(edge_fraction)
    if value.dtype.kind not in "fiu":
        raise InvalidType(f"OnnxDenoiser: edge_fraction must be real, got dtype {value.dtype}")
    if value.shape not in ((), (count,)):
        raise InvalidArgument(f"OnnxDenoiser: edge_fraction must have shape () or ({count},), got {value.shape}")
    edges = np.broadcast_to(value, (count,)).astype(np.float32)
    if not (np.isfinite(edges) & (edges > 0)).all():
        worst = edges[~(np.isfinite(edges) & (edges > 0))][0]
        raise InvalidArgument(f"OnnxDenoiser: edge_fraction must be finite and > 0 in float32, got {worst}")
    return edges


class OnnxDenoiser:
    """``(channels, timestep, edge_fraction) -> x0_pred`` on numpy arrays.

    Example:
        >>> import unghost
        >>> path = Path(unghost.__file__).parent / "weights" / "default.onnx"
        >>> denoiser = OnnxDenoiser(path, threads=1)
        >>> cubes = np.full((2, 1, 32, 32, 32), -1.0, np.float32)
        >>> denoiser(cubes, denoiser.manifest.default_timestep, 0.05).shape
        (2, 1, 32, 32, 32)
    """

    kind = "numpy"

    def __init__(self, path: str | Path, *, threads: int | None = None, providers: Sequence[str] | None = None) -> None:
        """Open and check a file.

        Args:
            path: of ``unghost.export.onnx.to_onnx.export_onnx`` or ``unghost.export.onnx.quantization.convert_onnx``:
            fp32, fp16
                or int8 (``precision`` says which), all with float32 inputs and outputs.
            threads: of onnxruntime, inside operators; None leaves it the choice.
            providers: execution providers in order; None for CUDA where there is one, then the CPU.

        Raises:
            ValueError: missing, truncated, foreign or altered file; unknown provider.
        """
        data = read_file(path)
        self.manifest = unseal(data, origin=str(path))
        self.precision = precision_of(self.manifest)
        self._session = _open(data, threads, providers, str(path))

    @property
    def providers(self) -> list[str]:
        """Execution providers in use, the first preferred."""
        names: list[str] = self._session.get_providers()
        return names

    def __call__(self, channels: Any, timestep: Any, edge_fraction: Any) -> NDArray[np.float32]:
        """Denoise.

        Args:
            channels: ``(N, C, 32, 32, 32)`` float32 in [-1, 1]; N may be 0. Given ``(N, 1, 32, 32, 32)``, the other
                channels are unknown.
            timestep: ``(N,)`` integers in [0, 1000), or one for all.
            edge_fraction: ``(N,)`` finite and > 0, or one for all: edge length over the scene's extent.

        Returns:
            ``x0_pred (N, 1, 32, 32, 32)`` float32 in [-1, 1].

        Raises:
            TypeError: channels not float32, timesteps not integers.
            ValueError: shapes, or values out of range.
        """
        if not isinstance(channels, np.ndarray) or channels.dtype != np.float32:
            found = getattr(channels, "dtype", type(channels).__name__)
            raise InvalidType(f"OnnxDenoiser: channels must be a float32 numpy array, got {found}")
        channels = with_unknown(channels, len(self.manifest.channels))
        cube = (len(self.manifest.channels), RESOLUTION, RESOLUTION, RESOLUTION)
        if channels.shape[1:] != cube or channels.ndim != 5:
            raise InvalidArgument(f"OnnxDenoiser: channels must have shape (N, {str(cube)[1:]}, got {channels.shape}")
        if not np.isfinite(channels).all():
            raise InvalidArgument(
                f"OnnxDenoiser: channels must be finite, got {int((~np.isfinite(channels)).sum())} others"
            )
        count = len(channels)
        times = check_timestep(timestep, caller="OnnxDenoiser")
        if times.shape not in ((), (count,)):
            raise InvalidArgument(f"OnnxDenoiser: timestep must have shape () or ({count},), got {times.shape}")
        times = np.broadcast_to(times, (count,))
        edges = _edge_fractions(edge_fraction, count)
        x0_pred = np.empty((count, 1, *cube[1:]), np.float32)
        for start in range(0, count, CHUNK):
            part = slice(start, start + CHUNK)
            feed = {
                "channels": np.ascontiguousarray(channels[part]),
                "timestep": np.ascontiguousarray(times[part]),
                "edge_fraction": edges[part],
            }
            x0_pred[part] = self._session.run(["x0_pred"], feed)[0]
        return x0_pred
