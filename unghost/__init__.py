"""Take ghosts (floaters, fog, false surfaces) out of radiance fields.

>>> from unghost import DensityRegularizer, clean, load_denoiser

Importing this package loads nothing heavy: every name below arrives when it is first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from . import _moved
from .core.lazy import attach

if TYPE_CHECKING:
    from .cleaning.keep_mask import KeepMask as KeepMask
    from .denoisers import load_denoiser as load_denoiser
    from .facade import clean as clean
    from .regularizer.density_regularizer import DensityRegularizer as DensityRegularizer

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        ".cleaning.keep_mask": ["KeepMask"],
        ".denoisers": ["load_denoiser"],
        ".facade": ["clean"],
        ".regularizer.density_regularizer": ["DensityRegularizer"],
    },
    extras={".regularizer.density_regularizer": "torch"},
)
__all__ += ["__version__"]

_moved.install()
