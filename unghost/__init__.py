"""Take ghosts (floaters, fog, false surfaces) out of radiance fields.

>>> from unghost import DensityRegularizer, clean, load_denoiser  # doctest: +SKIP

Importing this package loads nothing heavy: every name below arrives when it is first used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .cleaning import clean as clean
    from .denoisers import load_denoiser as load_denoiser
    from .regularizer.keep_mask import KeepMask as KeepMask
    from .regularizer.regularizer import DensityRegularizer as DensityRegularizer

__version__ = "0.1.0"
__all__ = ["DensityRegularizer", "KeepMask", "__version__", "clean", "load_denoiser"]

_HOME = {
    "DensityRegularizer": ".regularizer.regularizer",
    "KeepMask": ".regularizer.keep_mask",
    "clean": ".cleaning",
    "load_denoiser": ".denoisers",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'unghost' has no attribute {name!r}")
    value = getattr(import_module(_HOME[name], __name__), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOME})
