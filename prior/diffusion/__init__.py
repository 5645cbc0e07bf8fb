"""Diffusion over occupancy cubes: formulas, model, objective, sampling."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ...core.lazy import attach

if TYPE_CHECKING:
    from .formulas import bernoulli_posterior as bernoulli_posterior
    from .formulas import clean_cubes as clean_cubes
    from .formulas import epsilon_from_x0 as epsilon_from_x0
    from .formulas import q_flip as q_flip
    from .formulas import q_sample as q_sample
    from .formulas import x0_from_epsilon as x0_from_epsilon
    from .model import DiffusionConfig as DiffusionConfig
    from .model import DiffusionNet as DiffusionNet
    from .noised import NoisedDenoiser as NoisedDenoiser
    from .sampling import sample_cubes as sample_cubes

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        ".formulas": [
            "bernoulli_posterior",
            "clean_cubes",
            "epsilon_from_x0",
            "q_flip",
            "q_sample",
            "x0_from_epsilon",
        ],
        ".model": ["DiffusionConfig", "DiffusionNet"],
        ".noised": ["NoisedDenoiser"],
        ".sampling": ["sample_cubes"],
    },
)
