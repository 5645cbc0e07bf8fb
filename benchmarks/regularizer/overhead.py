"""What the regularizer adds to a step of our own field's training, on a capture's photos."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import torch

from unghost import load_denoiser
from unghost.evaluation.captures.loading import load_capture
from unghost.fields.radiance import RadianceField
from unghost.fields.training import train_field
from unghost.regularizer.density_regularizer import DensityRegularizer

from ..fit_cache import training_hooks
from ..progress import say

WARM, STEPS, DOWNSCALE = 60, 30, 8
WAYS: dict[str, dict[str, Any] | None] = {
    "alone": None,
    "visibility": {"dsds_weight": 0.0},
    "dsds and visibility": {},
    "dsds and visibility, every fifth step": {"every": 5},
}


def overhead_rows(
    source: Path, name: str, *, threads: int, warm: int = WARM, steps: int = STEPS
) -> list[dict[str, Any]]:
    """Seconds a step of ``steps`` from the same field, which has seen ``warm``; 4,096 rays, default settings."""
    capture = load_capture(source, downscale=DOWNSCALE)
    cameras, photos = capture.cameras, capture.images()
    torch.manual_seed(0)
    base = RadianceField()
    train_field(base, cameras, photos, steps=warm)
    rows: list[dict[str, Any]] = []
    for way, settings in WAYS.items():
        field, hooks = copy.deepcopy(base), dict[str, Any]()
        if settings is not None:
            regularizer = DensityRegularizer(
                load_denoiser(name, backend="onnx", threads=threads),
                aabb=field.aabb,
                cameras=cameras,
                field_pitch=field.field_pitch,
                **settings,
            )
            hooks = training_hooks(regularizer)
            regularizer(field.density_fn)  # what is built once is not counted
        record = train_field(field, cameras, photos, steps=steps, fine_tune=True, **hooks)
        seconds = record["seconds"] / record["steps"]
        rows.append(
            {
                "method": f"own field's step, {way}",
                "seconds": seconds,
                "times_alone": seconds / rows[0]["seconds"] if rows else 1.0,
                "steps": steps,
            }
        )
        say(f"{rows[-1]['method']}: {seconds:.3f} s, {rows[-1]['times_alone']:.2f} x")
    return rows
