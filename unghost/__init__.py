"""Take ghosts (floaters, fog, false surfaces) out of radiance fields.

>>> from unghost import DensityRegularizer, clean, load_denoiser

Importing this package loads nothing heavy: every name below is imported when it is first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from . import _moved
from .core.lazy import attach

if TYPE_CHECKING:
    from .cleaning.keep_mask import KeepMask as KeepMask
    from .cleaning.pipeline import CleanSettings as CleanSettings
    from .cleaning.splats import CleanedSplats as CleanedSplats
    from .cleaning.strength import choose_strength as choose_strength
    from .core.cameras import Cameras as Cameras
    from .core.errors import UnghostError as UnghostError
    from .core.occupancy import OccupancyRule as OccupancyRule
    from .core.sight_lines import SightLines as SightLines
    from .core.sparse_points import SparsePoints as SparsePoints
    from .denoisers import load_denoiser as load_denoiser
    from .denoisers import shipped_names as shipped_names
    from .evaluation.captures.loading import Capture as Capture
    from .evaluation.captures.loading import load_cameras as load_cameras
    from .evaluation.captures.loading import load_capture as load_capture
    from .evaluation.scoring.evaluation import evaluate as evaluate
    from .evaluation.uncertainty.photometric import photo_doubt as photo_doubt
    from .facade.cleaning import clean as clean
    from .facade.cleaning import clean_splats as clean_splats
    from .facade.regularization import DensityRegularizer as DensityRegularizer
    from .fields.adapters.grids import grid_density_fn as grid_density_fn
    from .fields.adapters.grids import load_grid as load_grid
    from .fields.adapters.grids import save_grid as save_grid
    from .regularizer.removal import RemovalLoss as RemovalLoss
    from .regularizer.settings import RegularizerSettings as RegularizerSettings
    from .splats.ply import Gaussians as Gaussians
    from .splats.ply import read_splat_ply as read_splat_ply

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        ".cleaning.keep_mask": ["KeepMask"],
        ".cleaning.pipeline": ["CleanSettings"],
        ".cleaning.splats": ["CleanedSplats"],
        ".cleaning.strength": ["choose_strength"],
        ".core.cameras": ["Cameras"],
        ".core.errors": ["UnghostError"],
        ".core.occupancy": ["OccupancyRule"],
        ".core.sight_lines": ["SightLines"],
        ".core.sparse_points": ["SparsePoints"],
        ".denoisers": ["load_denoiser", "shipped_names"],
        ".evaluation.captures.loading": ["Capture", "load_cameras", "load_capture"],
        ".evaluation.scoring.evaluation": ["evaluate"],
        ".evaluation.uncertainty.photometric": ["photo_doubt"],
        ".facade.cleaning": ["clean", "clean_splats"],
        ".facade.regularization": ["DensityRegularizer"],
        ".fields.adapters.grids": ["grid_density_fn", "load_grid", "save_grid"],
        ".regularizer.removal": ["RemovalLoss"],
        ".regularizer.settings": ["RegularizerSettings"],
        ".splats.ply": ["Gaussians", "read_splat_ply"],
    },
    extras={".facade.regularization": "torch", ".regularizer.removal": "torch"},
)
__all__ += ["__version__"]

_moved.install()
