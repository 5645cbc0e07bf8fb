"""What unghost is compared with: rivals' losses, Bayes' Rays, classical filters."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..core.lazy import attach

if TYPE_CHECKING:
    from .bayes_rays import LOWEST as LOWEST
    from .bayes_rays import deformation_uncertainty as deformation_uncertainty
    from .filters import Classical as Classical
    from .losses import Squash as Squash
    from .losses import depth_smoothness_loss as depth_smoothness_loss
    from .losses import distortion_loss as distortion_loss
    from .losses import free_space_loss as free_space_loss
    from .losses import scale_gradients as scale_gradients
    from .losses import sds_loss as sds_loss
    from .losses import sparsity_loss as sparsity_loss
    from .losses import squash_density as squash_density
    from .losses import total_variation_loss as total_variation_loss
    from .point_losses import ds_nerf_loss as ds_nerf_loss
    from .point_losses import expected_depth_loss as expected_depth_loss
    from .point_losses import floater_score_loss as floater_score_loss
    from .point_losses import line_of_sight_loss as line_of_sight_loss
    from .point_losses import nearest_point_loss as nearest_point_loss

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        ".bayes_rays": ["LOWEST", "deformation_uncertainty"],
        ".filters": ["Classical"],
        ".losses": [
            "Squash",
            "depth_smoothness_loss",
            "distortion_loss",
            "free_space_loss",
            "scale_gradients",
            "sds_loss",
            "sparsity_loss",
            "squash_density",
            "total_variation_loss",
        ],
        ".point_losses": [
            "ds_nerf_loss",
            "expected_depth_loss",
            "floater_score_loss",
            "line_of_sight_loss",
            "nearest_point_loss",
        ],
    },
)
