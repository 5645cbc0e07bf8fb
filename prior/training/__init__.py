"""Training a prior: batches, objective, loop, checkpoints, several processes."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ...core.lazy import attach

if TYPE_CHECKING:
    from .allocator import keep_freed_memory as keep_freed_memory
    from .batches import Mixture as Mixture
    from .batches import stored_channels as stored_channels
    from .blend import Online as Online
    from .config import TrainConfig as TrainConfig
    from .loop import train as train
    from .run_state import Trainer as Trainer
    from .validation import KEPT as KEPT
    from .validation import KeepCurve as KeepCurve
    from .validation import masked_iou as masked_iou

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        ".allocator": ["keep_freed_memory"],
        ".batches": ["Mixture", "stored_channels"],
        ".blend": ["Online"],
        ".config": ["TrainConfig"],
        ".loop": ["train"],
        ".run_state": ["Trainer"],
        ".validation": ["KEPT", "KeepCurve", "masked_iou"],
    },
)
