"""Fit a radiance field of any kind (see :mod:`.kinds`) to photos."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from dataclasses import field as _field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..core.cameras import Cameras
from ..core.errors import InvalidArgument
from ..core.progress import progress_bar
from ..core.ray_distortion import distortion
from .kinds import TrainableField
from .rendering import Rendering, Sampling, render_rays

Regularizer = Callable[[TrainableField, int], "Tensor | None"]
Observer = Callable[[Tensor, Tensor], None]


@dataclass(frozen=True)
class TrainingConfig:
    """How to fit.

    Attributes:
        rays: rays a step (the paper: 4096).
        learning_rate, final_learning_rate: Adam's for a dense grid, decayed exponentially over the run; other
            kinds of field have theirs relative to it.
        fine_tune_learning_rate: held constant with ``fine_tune``.
        distortion_weight: of the mip-NeRF 360 distortion loss (nerfacto has it on by default).
        stages: (share of the run at which it begins, share of the final resolution), coarse to fine.
        sampling: where rays are sampled.
        skip_from, skip_below: from this share of the run on, space below this opacity a cell is skipped
            (looked at anew every 16 steps).
    """

    rays: int = 4096
    learning_rate: float = 0.1
    final_learning_rate: float = 0.01
    fine_tune_learning_rate: float = 0.03
    distortion_weight: float = 0.002
    stages: tuple[tuple[float, float], ...] = ((0.0, 0.4), (0.12, 0.65), (0.3, 1.0))
    sampling: Sampling = _field(default_factory=Sampling)
    skip_from: float = 0.15
    skip_below: float = 1e-3

    def rate_at(self, share: float) -> float:
        """Learning rate when ``share`` in [0, 1] of the run is done."""
        return float(self.learning_rate * (self.final_learning_rate / self.learning_rate) ** share)


def distortion_loss(rendering: Rendering) -> Tensor:
    """mip-NeRF 360, eq. 15, per ray ``(N,)``, on distances squashed to [0, 1) by ``t / (1 + t)``; O(samples)."""
    spread: Tensor = distortion(rendering.weights, rendering.edges / (1.0 + rendering.edges))
    return spread


def gather_rays(cameras: Cameras, images: NDArray[np.float32]) -> tuple[Tensor, Tensor, Tensor]:
    """All pixels of all photos: origins, unit directions, colours, each ``(pixels, 3)`` float32.

    Photos that differ in size lie in the upper left corners of ``images`` (:attr:`Cameras.canvas`).

    Raises:
        ValueError: ``images`` is not ``(N, height, width, 3)`` for the N cameras, or not floating point.

    Example:
        >>> cameras = Cameras.create(np.eye(3, 4)[None], np.array([8.0, 8.0, 4.0, 3.0]), 8, 6)
        >>> origins, directions, colors = gather_rays(cameras, np.zeros((1, 6, 8, 3), np.float32))
        >>> directions.shape, bool((directions[:, 2] < 0).all())  # one ray a pixel, looking along -z
        (torch.Size([48, 3]), True)
    """
    expected = (len(cameras), *cameras.canvas, 3)
    if images.shape != expected:
        raise InvalidArgument(f"gather_rays: images must have shape {expected}, got {images.shape}")
    if images.dtype.kind != "f":
        raise InvalidArgument(f"gather_rays: images must be floating point in [0, 1], got dtype {images.dtype}")
    rays = [cameras.rays(index) for index in range(len(cameras))]
    origins, directions = (np.concatenate([ray[part].reshape(-1, 3) for ray in rays]) for part in (0, 1))
    if cameras.same_size:
        pixels = images.reshape(-1, 3)
    else:
        views = [image[cameras.window(index)].reshape(-1, 3) for index, image in enumerate(images)]
        pixels = np.concatenate(views)
    starts, towards, colors = (
        torch.from_numpy(np.ascontiguousarray(item, dtype=np.float32)) for item in (origins, directions, pixels)
    )
    return starts, towards, colors


class _Progress:
    """Share of the run that is done, by steps or by seconds."""

    def __init__(self, steps: int | None, seconds: float | None) -> None:
        if steps is None and seconds is None:
            raise InvalidArgument("train_field: give steps or seconds (or both)")
        if steps is not None and steps < 1:
            raise InvalidArgument(f"train_field: steps must be >= 1, got {steps}")
        if seconds is not None and not seconds > 0:
            raise InvalidArgument(f"train_field: seconds must be > 0, got {seconds}")
        self.steps, self.seconds, self.start = steps, seconds, time.perf_counter()

    def __call__(self, step: int) -> float:
        by_step = step / self.steps if self.steps else 0.0
        by_time = (time.perf_counter() - self.start) / self.seconds if self.seconds else 0.0
        return max(by_step, by_time)


def _optimizer(field: TrainableField) -> torch.optim.Adam:
    groups = [{"params": parameters, "relative": relative} for parameters, relative in field.parameter_groups()]
    return torch.optim.Adam(groups, betas=(0.9, 0.99), eps=1e-12, fused=True)


def _set_stage(field: TrainableField, stages: tuple[tuple[float, float], ...], done: float) -> bool:
    """Refine the field if a stage has begun; True if its parameters are new."""
    return field.refine(max((stage for stage in stages if stage[0] <= done), key=lambda stage: stage[0])[1])


def _batch_loss(
    field: TrainableField,
    pixels: tuple[Tensor, Tensor, Tensor],
    config: TrainingConfig,
    generator: torch.Generator,
    occupied: Tensor | None,
    observer: Observer | None,
) -> tuple[Tensor, Tensor]:
    """Random rays rendered before random backgrounds: their mean squared error, and that with the distortion loss."""
    origins, directions, colors = pixels
    batch = torch.randint(len(origins), (config.rays,), generator=generator)
    rendering = render_rays(
        field, origins[batch], directions[batch], config.sampling, generator=generator, occupied=occupied
    )
    background = torch.rand(config.rays, 3, generator=generator)
    rgb = rendering.rgb + (1.0 - rendering.accumulation[:, None]) * background
    if observer is not None:
        observer(rendering.positions.reshape(-1, 3), rendering.density.detach().reshape(-1))
    photometric = torch.nn.functional.mse_loss(rgb, colors[batch])
    return photometric, photometric + config.distortion_weight * distortion_loss(rendering).mean()


def train_field(
    field: TrainableField,
    cameras: Cameras,
    images: NDArray[np.float32],
    *,
    steps: int | None = None,
    seconds: float | None = None,
    seed: int = 0,
    config: TrainingConfig | None = None,
    fine_tune: bool = False,
    regularizer: Regularizer | None = None,
    observer: Observer | None = None,
    progress: bool = False,
) -> dict[str, Any]:
    """Fit ``field`` in place to ``images (N, H, W, 3)`` in [0, 1].

    Args:
        steps, seconds: where to stop (whichever comes first); the learning rate decays towards it.
        seed: of the rays, their jitter and the backgrounds.
        fine_tune: keep the resolution, and the fine-tuning rate throughout.
        regularizer: called as ``regularizer(field, step)``; what it returns is added to the loss.
        observer: called with the positions ``(M, 3)`` and densities ``(M,)`` of the rendered samples.
        progress: draw a progress bar.

    Returns:
        ``steps``, ``seconds``, ``psnr`` (of the last hundred batches).

    Raises:
        ValueError: ``images`` do not fit the cameras, or ``steps`` or ``seconds`` is missing or not positive.
        FloatingPointError: the loss is not finite.

    Example:
        >>> from unghost.fields.radiance import RadianceConfig, RadianceField
        >>> cameras = Cameras.create(np.eye(3, 4)[None], np.array([8.0, 8.0, 4.0, 3.0]), 8, 6)
        >>> field = RadianceField(RadianceConfig(resolution=8, color_resolution=8))
        >>> photos = np.full((1, 6, 8, 3), 0.5, np.float32)
        >>> report = train_field(field, cameras, photos, steps=2, config=TrainingConfig(rays=16))
        >>> sorted(report), report["steps"]
        (['psnr', 'seconds', 'steps'], 2)
    """
    config = config or TrainingConfig()
    generator = torch.Generator().manual_seed(seed)
    pixels = gather_rays(cameras, images)
    done = _Progress(steps, seconds)
    stages = ((0.0, 1.0),) if fine_tune else config.stages
    _set_stage(field, stages, 0.0)
    optimizer = _optimizer(field)
    errors: list[float] = []
    bar = progress_bar(steps, unit="step", describe="fit", shown=progress)
    step = 0
    while (share := done(step)) < 1.0:
        if resampled := _set_stage(field, stages, share):
            optimizer = _optimizer(field)
        rate = config.fine_tune_learning_rate if fine_tune else config.rate_at(share)
        for group in optimizer.param_groups:
            group["lr"] = rate * group["relative"]
        if step % 16 == 0 or resampled:
            skipping = fine_tune or share >= config.skip_from
            occupied = field.occupied_nodes(config.skip_below) if skipping else None
        photometric, loss = _batch_loss(field, pixels, config, generator, occupied, observer)
        if regularizer is not None and (extra := regularizer(field, step)) is not None:
            loss = loss + extra
        errors.append(float(photometric.detach()))
        if not np.isfinite(errors[-1]):
            raise FloatingPointError(f"train_field: the loss is not finite at step {step}")
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        step += 1
        bar.update(1)
        if step % 20 == 0:
            bar.set_postfix_str(f"{-10 * np.log10(np.mean(errors[-100:])):.2f} dB")
    bar.close()
    psnr = float(-10 * np.log10(np.mean(errors[-100:]))) if errors else float("nan")
    return {"steps": step, "seconds": time.perf_counter() - done.start, "psnr": psnr}
