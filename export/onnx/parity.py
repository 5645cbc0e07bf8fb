"""How far an ONNX denoiser is from the checkpoint it was made from, and how far each precision may be."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.channels import (
    OPTIONAL_CHANNELS,
    SIGNED_OPACITY,
    VIEW_COUNT,
    coarse_channel,
    encode_surroundings,
    encode_view_count,
    stack_channels,
)
from ...core.errors import InvalidArgument, needs_extra
from ...core.frames import RESOLUTION, unit_lattice
from ...core.manifest import Denoiser, Manifest
from ...core.occupancy import EMPTY, OCCUPIED, occupancy_from_signed, signed_from_opacity
from ...core.schedule import TIMESTEPS
from ..container import precision_of

ERROR_TOLERANCE, FLIP_TOLERANCE = 1e-4, 1e-5


@dataclass(frozen=True)
class Tolerance:
    """Largest ``max_error`` and ``mean_error`` of ``x0_pred`` (in [-1, 1]), and ``flip_rate`` of voxels, that pass."""

    max_error: float
    mean_error: float
    flip_rate: float


TOLERANCES = {
    "fp32": Tolerance(ERROR_TOLERANCE, ERROR_TOLERANCE, FLIP_TOLERANCE),
    "fp16": Tolerance(0.02, 5e-4, 2e-4),
    "int8": Tolerance(2.0, 0.04, 0.02),  # single voxels may go anywhere; what counts is how many do
}  # on parity_inputs, most of which look like nothing a denoiser is made for; see docs/formats.md for what was measured


@dataclass(frozen=True)
class ParityInputs:
    """``channels (N, C, R, R, R)``, ``timestep (N,)``, ``edge_fraction (N,)``: what both sides are asked."""

    channels: NDArray[np.float32]
    timestep: NDArray[np.int64]
    edge_fraction: NDArray[np.float32]


def _opacity(rng: np.random.Generator, kind: int) -> NDArray[Any]:
    """One cube of opacity: empty, full, noise, bits, a soft ball, a ramp, a wall with fog, sparse salt."""
    shape = (RESOLUTION,) * 3
    lattice = unit_lattice()
    distance = np.linalg.norm(lattice - rng.uniform(-0.4, 0.4, 3), axis=-1)
    if kind == 0:
        return np.zeros(shape)
    if kind == 1:
        return np.ones(shape)
    if kind == 2:
        return rng.random(shape)
    if kind == 3:
        return (rng.random(shape) < rng.random()).astype(np.float64)
    if kind == 4:
        return 1.0 / (1.0 + np.exp(np.clip((distance - 0.3) * 60.0, -50, 50)))
    if kind == 5:
        return np.clip(lattice @ rng.normal(size=3) + 0.5, 0.0, 1.0)
    if kind == 6:
        return np.maximum(np.abs(lattice[..., 0] - rng.uniform(-0.4, 0.4)) < 0.06, 0.3 * np.exp(-8.0 * distance))
    return np.where(rng.random(shape) < 0.01, 1.0, 1e-6)


def _beside(rng: np.random.Generator, name: str, kind: int) -> NDArray[np.float32]:
    """One optional channel of a cube, ``(R, R, R)`` or coarser: views that grow from corner to corner, or shares."""
    if name == VIEW_COUNT:
        return encode_view_count(np.maximum(unit_lattice() @ rng.normal(0, 60, 3) + rng.uniform(0, 60), 0).astype(int))
    return encode_surroundings(coarse_channel(signed_from_opacity(_opacity(rng, kind))))


def parity_inputs(cubes: int, seed: int, *, channels: Sequence[str] = (SIGNED_OPACITY,)) -> ParityInputs:
    """Empty, full, random and structured cubes in turn, with timesteps 0 and 999 and edges 1e-6 to 10 among them.

    ``channels`` names what the denoiser takes; each optional one is unknown in one cube of four.
    """
    if cubes < 1:
        raise InvalidArgument(f"parity_inputs: cubes must be >= 1, got {cubes}")
    values = np.empty((cubes, len(channels), *(RESOLUTION,) * 3), np.float32)
    times, edges = np.empty(cubes, np.int64), np.empty(cubes, np.float32)
    for index in range(cubes):
        rng = np.random.default_rng([seed, index])
        signed = np.clip(signed_from_opacity(_opacity(rng, index % 8)), EMPTY, OCCUPIED)
        times[index] = (0, TIMESTEPS - 1, int(rng.integers(TIMESTEPS)))[index // 8 % 3]
        edges[index] = (0.05, 1e-6, 10.0, math.exp(rng.uniform(math.log(0.01), 0.0)))[index // 24 % 4]
        known = {
            name: _beside(rng, name, (index + 1) % 8)[None]
            for place, name in enumerate(OPTIONAL_CHANNELS)
            if name in channels and (index + 2 * place) % 4 != 3
        }
        values[index] = stack_channels(channels, signed[None], known)[0]
    return ParityInputs(values, times, edges)


def check_inputs(inputs: ParityInputs, *, caller: str) -> None:
    """Refuse inputs of which a denoiser would refuse some.

    Raises:
        ValueError: no cubes, wrong shapes or dtypes, values that are not finite or out of range.
    """
    count, cube = len(inputs.channels), (RESOLUTION,) * 3
    if count < 1 or inputs.channels.ndim != 5 or inputs.channels.shape[2:] != cube:
        raise InvalidArgument(
            f"{caller}: channels must have shape (N, C, 32, 32, 32), N >= 1, got {inputs.channels.shape}"
        )
    dtypes = (inputs.channels.dtype, inputs.timestep.dtype, inputs.edge_fraction.dtype)
    if dtypes != (np.dtype(np.float32), np.dtype(np.int64), np.dtype(np.float32)):
        raise InvalidArgument(f"{caller}: dtypes must be float32, int64, float32, got {', '.join(map(str, dtypes))}")
    if inputs.timestep.shape != (count,) or inputs.edge_fraction.shape != (count,):
        shapes = (inputs.timestep.shape, inputs.edge_fraction.shape)
        raise InvalidArgument(f"{caller}: timestep and edge_fraction must have shape ({count},), got {shapes}")
    if not (np.abs(inputs.channels) <= 1.0).all():
        raise InvalidArgument(f"{caller}: channels must be finite and in [-1, 1]")
    if not ((inputs.timestep >= 0) & (inputs.timestep < TIMESTEPS)).all():
        raise InvalidArgument(f"{caller}: timestep must lie in [0, {TIMESTEPS})")
    if not ((inputs.edge_fraction > 0) & np.isfinite(inputs.edge_fraction)).all():
        raise InvalidArgument(f"{caller}: edge_fraction must be finite and > 0")


def session_denoiser(body: bytes, manifest: Manifest) -> Denoiser:
    """A denoiser from a model that is not on disk yet."""
    import onnxruntime

    session = onnxruntime.InferenceSession(body, providers=["CPUExecutionProvider"])

    class _Session:
        kind = "numpy"

        def __init__(self) -> None:
            self.manifest = manifest

        def __call__(self, channels: Any, timestep: Any, edge_fraction: Any) -> Any:
            feed = {"channels": channels, "timestep": timestep, "edge_fraction": edge_fraction}
            return session.run(["x0_pred"], feed)[0]

    return _Session()


def _answer(denoiser: Denoiser, asked: tuple[NDArray[Any], ...]) -> NDArray[Any]:
    """``x0_pred`` of either kind of denoiser, as an array."""
    if denoiser.kind == "torch":
        import torch

        return np.asarray(denoiser(*(torch.from_numpy(value) for value in asked)).numpy())
    return np.asarray(denoiser(*asked))


def compare(exported: Denoiser, reference: Denoiser, inputs: ParityInputs) -> dict[str, Any]:
    """Run both and count.

    Returns:
        ``cubes``, ``max_error``, ``mean_error`` (of ``x0_pred``), ``flips`` and ``flip_rate`` (voxels on
        different sides of the decision), ``precision`` (of ``exported``), ``passed`` (within the precision's
        :data:`TOLERANCES`).
    """
    worst, total, flips, voxels = 0.0, 0.0, 0, 0
    for start in range(0, len(inputs.channels), 32):
        part = slice(start, start + 32)
        asked = (inputs.channels[part], inputs.timestep[part], inputs.edge_fraction[part])
        expected, found = _answer(reference, asked), _answer(exported, asked)
        error = np.abs(found.astype(np.float64) - expected)
        worst = max(worst, float(error.max()) if np.isfinite(error).all() else math.inf)
        total, voxels = total + float(error.sum()), voxels + error.size
        flips += int((occupancy_from_signed(found) != occupancy_from_signed(expected)).sum())
    precision = precision_of(exported.manifest)
    allowed = TOLERANCES[precision]
    passed = worst <= allowed.max_error and total / voxels <= allowed.mean_error and flips / voxels <= allowed.flip_rate
    return {
        "cubes": len(inputs.channels),
        "max_error": worst,
        "mean_error": total / voxels,
        "flips": flips,
        "flip_rate": flips / voxels,
        "precision": precision,
        "passed": passed,
    }


def verify(
    onnx_path: str | Path, checkpoint_path: str | Path, *, cubes: int = 256, seed: int = 0, threads: int | None = None
) -> dict[str, Any]:
    """Compare an ONNX file with its checkpoint in torch fp32 on the CPU; see :func:`compare` for the result.

    Raises:
        ImportError: torch or safetensors is missing.
        ValueError: either file is unreadable, or they take different channels.
    """
    with needs_extra("export", caller="verify"):
        from ...prior.checkpoint import load_model
    from ..runtime import OnnxDenoiser

    exported = OnnxDenoiser(onnx_path, threads=threads, providers=["CPUExecutionProvider"])
    reference = load_model(checkpoint_path)
    if exported.manifest.channels != reference.manifest.channels:
        raise InvalidArgument(
            f"verify: {onnx_path} takes {exported.manifest.channels}, {checkpoint_path} {reference.manifest.channels}"
        )
    inputs = parity_inputs(cubes, seed, channels=reference.manifest.channels)
    return compare(exported, reference, inputs)
