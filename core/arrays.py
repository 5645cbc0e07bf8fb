"""Tell numpy arrays and torch tensors apart without importing torch."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np

from .errors import InvalidType

Array = Any  # a numpy array or a torch tensor; the docstring of each function says which


def is_tensor(array: Array) -> bool:
    """True for a torch tensor. Never imports torch: a tensor can only exist if it is loaded."""
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(array, torch.Tensor)


def namespace(array: Array) -> Any:
    """The module, ``numpy`` or ``torch``, whose ``exp``, ``where``, ``isnan`` … fit ``array``."""
    return sys.modules["torch"] if is_tensor(array) else np


def to_numpy(array: Array) -> np.ndarray[Any, Any]:
    """Copy-free where possible: a detached CPU numpy view of a tensor, or the array itself."""
    if is_tensor(array):
        result: np.ndarray[Any, Any] = array.detach().cpu().numpy()
        return result
    return np.asarray(array)


_HALF = ("torch.float16", "torch.bfloat16")


def upcast(density: Any) -> Any:
    """Convert a half-precision tensor to float32; leave float32 and float64 tensors as they are.

    Raises:
        TypeError: a tensor of integers or booleans.
    """
    if not density.is_floating_point():
        raise InvalidType(f"upcast: density must be a floating-point tensor, got {density.dtype}")
    return density.float() if str(density.dtype) in _HALF else density


def widest(tensor: Any) -> Any:
    """Convert a tensor to float64, or to float32 on devices that have no float64 (mps)."""
    return tensor.float() if tensor.device.type == "mps" else tensor.double()
