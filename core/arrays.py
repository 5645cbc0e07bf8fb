"""Tell numpy arrays and torch tensors apart without importing torch."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np

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
