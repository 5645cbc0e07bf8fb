"""Find a denoiser by name or by file, and load it with the engine that is asked for."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from .core.errors import InvalidArgument, MissingExtra, MissingFile
from .core.manifest import Denoiser

WEIGHTS = Path(__file__).resolve().parent / "weights"
SUFFIXES = {"onnx": ".onnx", "torch": ".safetensors"}
SUCCESSORS = {"m": "default"}  # names that were shipped once -> what replaces them


def _load_onnx(path: Path, threads: int | None) -> Denoiser:
    from .export.runtime import OnnxDenoiser

    return OnnxDenoiser(path, threads=threads)


def _load_torch(path: Path, threads: int | None) -> Denoiser:
    try:
        from .prior.checkpoint import load_model
    except ModuleNotFoundError as error:
        if error.name not in ("torch", "safetensors"):
            raise
        raise MissingExtra(f"load_denoiser: backend 'torch' needs {error.name}: pip install unghost[torch]") from error
    if threads is not None:
        raise InvalidArgument("load_denoiser: threads is for backend 'onnx'; torch takes torch.set_num_threads")
    return load_model(path)


_LOADERS: dict[str, Callable[[Path, int | None], Denoiser]] = {"onnx": _load_onnx, "torch": _load_torch}


def shipped_names() -> list[str]:
    """Names that :func:`load_denoiser` knows without a path, sorted.

    Example:
        >>> shipped_names()
        ['default', 'evidence', 'views', 'xs']
    """
    return sorted({path.stem for suffix in SUFFIXES.values() for path in WEIGHTS.glob(f"*{suffix}")})


def load_denoiser(
    name_or_path: str | Path = "default", *, backend: str | None = None, threads: int | None = None
) -> Any:
    """Load the shipped denoiser, or one of your own.

    Args:
        name_or_path: a shipped name (``"default"``; ``"evidence"``, which takes cameras and their sparse points;
            ``"views"``, which takes view counts; ``"xs"``, a smaller one), or the path of an ``.onnx`` or
            ``.safetensors`` file.
        backend: ``"onnx"`` (numpy arrays in and out; no torch) or ``"torch"`` (tensors). None takes what
            the file's ending says, and ``"onnx"`` for a shipped name.
        threads: of onnxruntime; None leaves the choice to it.

    Returns:
        A :class:`unghost.core.manifest.Denoiser`: ``(channels (N, C, 32, 32, 32) in [-1, 1], timestep (N,),
        edge_fraction (N,)) -> x0_pred (N, 1, 32, 32, 32) in [-1, 1]``, with its ``manifest``.

    Raises:
        ValueError: unknown backend, a backend that does not fit the file, or a file that is not a denoiser.
        FileNotFoundError: no shipped weights of that name and no such file.
        ImportError: ``"torch"`` without the extra ``unghost[torch]``.

    Example:
        >>> denoiser = load_denoiser()
        >>> denoiser.manifest.channels
        ('signed_opacity',)
    """
    if backend is not None and backend not in _LOADERS:
        raise InvalidArgument(f"load_denoiser: backend must be one of {sorted(_LOADERS)}, got {backend!r}")
    path = Path(name_or_path)
    engine_of = {suffix: name for name, suffix in SUFFIXES.items()}
    if path.suffix in engine_of:
        implied = engine_of[path.suffix]
        if backend not in (None, implied):
            raise InvalidArgument(
                f"load_denoiser: backend {backend!r} reads {SUFFIXES[str(backend)]} files, got {path}"
            )
        backend = implied
    else:
        backend = backend or "onnx"
        path = WEIGHTS / f"{name_or_path}{SUFFIXES[backend]}"
    if not path.is_file():
        successor = SUCCESSORS.get(str(name_or_path))
        retired = f" (no longer shipped: {successor!r} replaces it)" if successor else ""
        raise MissingFile(
            f"load_denoiser: no file {path.name if path.parent == WEIGHTS else path} for {str(name_or_path)!r}"
            f"{retired}; shipped names: {', '.join(shipped_names()) or 'none'}, or give the path of an .onnx or "
            ".safetensors file"
        )
    return _LOADERS[backend](path, threads)
