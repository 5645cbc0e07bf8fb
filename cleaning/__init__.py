"""Clean a trained density field: grid sampling, sliding-window inference, post-processing, keep masks. numpy only."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..core.lazy import attach

if TYPE_CHECKING:
    from .components import label_components as label_components
    from .denoiser_calls import check_denoiser as check_denoiser
    from .denoiser_calls import run_denoiser as run_denoiser
    from .grid_channels import light_channel as light_channel
    from .grid_channels import light_maps as light_maps
    from .grid_channels import view_channel as view_channel
    from .grid_channels import viewing_cameras as viewing_cameras
    from .keep_mask import KeepMask as KeepMask
    from .pipeline import Judgement as Judgement
    from .pipeline import clean as clean
    from .pipeline import judge as judge
    from .pitch_estimation import PitchEstimate as PitchEstimate
    from .pitch_estimation import estimate_pitch as estimate_pitch
    from .queries import field_device as field_device
    from .queries import make_query as make_query
    from .splats import CleanedSplats as CleanedSplats
    from .splats import box_of as box_of
    from .splats import clean_ply as clean_ply
    from .splats import clean_splats as clean_splats
    from .splats import pitch_of as pitch_of
    from .strength import choose_strength as choose_strength

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        ".components": ["label_components"],
        ".denoiser_calls": ["check_denoiser", "run_denoiser"],
        ".grid_channels": ["light_channel", "light_maps", "view_channel", "viewing_cameras"],
        ".keep_mask": ["KeepMask"],
        ".pipeline": ["Judgement", "clean", "judge"],
        ".pitch_estimation": ["PitchEstimate", "estimate_pitch"],
        ".queries": ["field_device", "make_query"],
        ".splats": ["CleanedSplats", "box_of", "clean_ply", "clean_splats", "pitch_of"],
        ".strength": ["choose_strength"],
    },
)
