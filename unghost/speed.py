"""How fast a denoiser is, on cubes that look like its work."""

from __future__ import annotations

import statistics
import time
from typing import Any

import numpy as np

from .core.distances.signed import sphere
from .core.errors import InvalidArgument
from .core.frames import RESOLUTION, unit_lattice

WARM_UP = 3


def sample_channels(batch: int, channels: int, *, seed: int = 0) -> np.ndarray[Any, Any]:
    """Signed opacity of noisy balls, ``(batch, channels, 32, 32, 32)`` float32 in [-1, 1]."""
    rng = np.random.default_rng(seed)
    lattice = unit_lattice(RESOLUTION)
    cubes = [sphere(lattice - rng.uniform(-0.3, 0.3, 3), rng.uniform(0.15, 0.4)) for _ in range(batch)]
    noisy = np.stack(cubes)[:, None] + 0.05 * rng.normal(size=(batch, channels, *(RESOLUTION,) * 3))
    return np.asarray(np.tanh(-20.0 * noisy), dtype=np.float32)


def measure_speed(denoiser: Any, *, batch: int = 40, seconds: float = 5.0, seed: int = 0) -> dict[str, Any]:
    """Time single-step denoising; the output of every call is checked to be finite and in [-1, 1].

    Args:
        denoiser: one that takes numpy arrays (``kind == "numpy"``).
        batch: cubes a call, >= 1.
        seconds: how long to measure, > 0; at least five calls.
        seed: of the cubes.

    Returns:
        ``cubes_per_second`` and ``milliseconds`` a call (both from the median call), ``calls``, ``batch``.

    Raises:
        ValueError: an argument out of range, or an output that is not a denoiser's.
    """
    if batch < 1 or not seconds > 0:
        raise InvalidArgument(f"measure_speed: batch must be >= 1 and seconds > 0, got {batch} and {seconds}")
    channels = sample_channels(batch, len(denoiser.manifest.channels), seed=seed)
    durations: list[float] = []
    begun = 0.0
    for call in range(10**9):
        if call == WARM_UP:
            begun = time.perf_counter()
        start = time.perf_counter()
        x0_pred = denoiser(channels, denoiser.manifest.default_timestep, 0.1)
        durations.append(time.perf_counter() - start)
        if x0_pred.shape != (batch, 1, *(RESOLUTION,) * 3) or not (np.abs(x0_pred) <= 1.0 + 1e-5).all():
            raise InvalidArgument(f"measure_speed: x0_pred must be (N, 1, 32, 32, 32) in [-1, 1], got {x0_pred.shape}")
        if call >= WARM_UP + 4 and time.perf_counter() - begun > seconds:
            break
    median = statistics.median(durations[WARM_UP:])
    return {
        "cubes_per_second": batch / median,
        "milliseconds": 1000 * median,
        "calls": len(durations) - WARM_UP,
        "batch": batch,
    }
