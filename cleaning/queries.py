"""Asking any density callable, numpy or torch, in bounded chunks. Never imports torch."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import is_tensor, to_numpy
from ..core.errors import InvalidArgument, InvalidType, MissingExtra
from ..core.occupancy import check_density_shape

Backend = Literal["numpy", "torch"]
Query = Callable[[NDArray[Any]], NDArray[np.float64]]

CHUNK = 1 << 18


def field_device(density_fn: Any) -> Any:
    """Device of the first parameter of the torch module behind a callable (itself, or a method's owner), or None.

    Example:
        >>> print(field_device(lambda positions: positions))
        None
    """
    owner = getattr(density_fn, "__self__", density_fn)
    torch = sys.modules.get("torch")
    if torch is None or not isinstance(owner, torch.nn.Module):
        return None
    first = next(owner.parameters(), None)
    return None if first is None else first.device


def _is_torch(density_fn: Any) -> bool:
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(getattr(density_fn, "__self__", density_fn), torch.nn.Module)


def _ask(density_fn: Callable[[Any], Any], positions: NDArray[Any], backend: Backend) -> Any:
    """One call, positions float32 of the backend's kind."""
    points = np.ascontiguousarray(positions, dtype=np.float32)
    if backend == "numpy":
        return density_fn(points)
    torch = sys.modules["torch"]
    with torch.no_grad():
        return density_fn(torch.from_numpy(points).to(field_device(density_fn) or "cpu"))


def find_backend(density_fn: Callable[[Any], Any], place: NDArray[Any], *, caller: str) -> Backend:
    """Which kind of positions a callable takes, found by asking it about one point ``place (3,)``.

    A torch module, or a method of one, takes tensors. Anything else is asked with a numpy array first; if
    that raises and torch is loaded, with a tensor.

    Raises:
        ValueError: neither works; the message quotes both errors, and the first is chained.
    """
    if not callable(density_fn):
        raise InvalidType(f"{caller}: density_fn must be callable, got {type(density_fn).__name__}")
    if _is_torch(density_fn):
        return "torch"
    points = np.asarray(place, dtype=np.float32).reshape(1, 3)
    try:
        _ask(density_fn, points, "numpy")
        return "numpy"
    except Exception as error:  # whatever a stranger's function may raise
        if "torch" not in sys.modules:
            raise
        first = error
    try:
        _ask(density_fn, points, "torch")
        return "torch"
    except Exception as second:
        raise InvalidArgument(
            f"{caller}: density_fn must accept positions of shape (N, 3); with a numpy array it raised "
            f"{type(first).__name__}: {first}; with a tensor, {type(second).__name__}: {second}"
        ) from first


def make_query(
    density_fn: Callable[[Any], Any],
    *,
    place: NDArray[Any],
    backend: Backend | None = None,
    chunk: int = CHUNK,
    caller: str,
) -> Query:
    """Wrap a density callable as ``positions (M, 3) -> density (M,) float64``, both numpy, unchecked values.

    Args:
        density_fn: takes float32 positions ``(M, 3)``, gives ``(M, 1)`` or ``(M,)``; arrays or tensors.
        place: ``(3,)`` a point it may be asked about.
        backend: what it takes; None to find out (:func:`find_backend`).
        chunk: most positions a call.
        caller: for errors.

    Raises:
        TypeError: from the query, what came back is no array or tensor of integers or floating-point numbers.
        ValueError: from the query, it is of another shape.

    Example:
        >>> query = make_query(lambda p: p[:, :1] + 1.0, place=np.zeros(3), caller="example")
        >>> query(np.array([[2.0, 0.0, 0.0]])).tolist()
        [3.0]
    """
    if backend not in (None, "numpy", "torch"):
        raise InvalidArgument(f"{caller}: backend must be None, 'numpy' or 'torch', got {backend!r}")
    if backend == "torch" and "torch" not in sys.modules:
        raise MissingExtra(f"{caller}: backend='torch' needs torch: pip install unghost[torch]")
    kind = backend or find_backend(density_fn, place, caller=caller)

    def query(positions: NDArray[Any]) -> NDArray[np.float64]:
        values = np.zeros(len(positions))
        for start in range(0, len(positions), chunk):
            part = positions[start : start + chunk]
            density = check_density_shape(_ask(density_fn, part, kind), part, caller=caller)
            values[start : start + chunk] = _real_numbers(density, caller=caller)
        return values

    return query


def _real_numbers(density: Any, *, caller: str) -> NDArray[Any]:
    """Densities as an array, bfloat16 raised, unless they are truth values, complex, text or objects."""
    if is_tensor(density) and density.is_floating_point():
        density = density.detach().double() if density.device.type != "mps" else density.detach().float()
    values = to_numpy(density)
    if values.dtype == np.bool_ or not np.can_cast(values.dtype, np.float64, "same_kind"):
        raise InvalidType(f"{caller}: density_fn must return integers or floating-point numbers, got {values.dtype}")
    return values
