"""Cube proposals, DSDS, visibility and clean(): everything applied to a density callable."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..core.lazy import attach

if TYPE_CHECKING:
    from .cubes import draw_cubes as draw_cubes
    from .density_regularizer import DensityRegularizer as DensityRegularizer
    from .losses import cubewise_mean as cubewise_mean
    from .losses import dsds_loss as dsds_loss
    from .losses import stable_mean as stable_mean
    from .removal import RemovalLoss as RemovalLoss
    from .settings import RegularizerSettings as RegularizerSettings
    from .view_grid import ViewGrid as ViewGrid
    from .visibility import ViewCounter as ViewCounter

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        ".cubes": ["draw_cubes"],
        ".density_regularizer": ["DensityRegularizer"],
        ".losses": ["cubewise_mean", "dsds_loss", "stable_mean"],
        ".removal": ["RemovalLoss"],
        ".settings": ["RegularizerSettings"],
        ".view_grid": ["ViewGrid"],
        ".visibility": ["ViewCounter"],
    },
)
