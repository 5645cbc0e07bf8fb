"""LPIPS (Zhang et al. 2018) under a mask. Optional: it needs trained weights, and never fetches them unasked.

``load_lpips`` gives the network or says plainly why there is none; whoever scores goes on with the other columns.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.errors import InvalidArgument, MissingExtra
from .checks import FloatArray, Mask, check_pair, choose

BACKBONES: Mapping[str, str] = MappingProxyType(  # the file torchvision's weights are stored under
    {"alex": "alexnet-owt-7be5be79.pth", "vgg": "vgg16-397923af.pth", "squeeze": "squeezenet1_1-b8a52dc0.pth"}
)
LPIPS_CONVENTIONS: Mapping[str, tuple[bool, bool]] = MappingProxyType(  # (blanked outside the mask, mean over the mask)
    {"filled": (False, True), "premasked_over_mask": (True, True), "premasked": (True, False)}
)


class LpipsUnavailable(MissingExtra):
    """LPIPS cannot be computed here; the message says what is missing and where it would have to be."""


@dataclass(frozen=True, eq=False)
class Lpips:
    """A perceptual distance and the name of what it rests on.

    Attributes:
        backbone: ``alex``, ``vgg``, ``squeeze``, or what a caller's own network is called. Scores of two backbones
            are different quantities.
        distance_map: ``(H, W, 3)`` twice, in [0, 1], to a distance at each pixel ``(H, W)``.
    """

    backbone: str
    distance_map: Callable[[FloatArray, FloatArray], NDArray[Any]]


def load_lpips(backbone: str, *, allow_download: bool = False) -> Lpips:
    """The published LPIPS of the ``lpips`` package on the CPU, spatial, on one of its three backbones.

    Args:
        backbone: a key of ``BACKBONES``. There is no default: ``alex`` and ``vgg`` get mixed up.
        allow_download: let torchvision fetch the backbone's weights if they are not in torch's cache.

    Raises:
        ValueError: unknown backbone.
        LpipsUnavailable: the package or the weights are missing; a subclass of ImportError.
    """
    file = choose("load_lpips", "backbone", backbone, BACKBONES)
    missing = [name for name in ("torch", "torchvision", "lpips") if importlib.util.find_spec(name) is None]
    if missing:
        raise LpipsUnavailable(
            f"load_lpips: LPIPS ({backbone}) needs the packages torch, torchvision and lpips; "
            f"missing: {', '.join(missing)} (pip install lpips torchvision). The other metrics do not need it."
        )
    import torch

    stored = Path(torch.hub.get_dir()) / "checkpoints" / file
    if not stored.is_file() and not allow_download:
        raise LpipsUnavailable(
            f"load_lpips: the weights of {backbone} are not on this machine and are not fetched unasked: put {file} "
            f"into torch's cache ({stored.parent}) or pass allow_download=True. The other metrics do not need it."
        )
    import lpips as package

    network = package.LPIPS(net=backbone, spatial=True, verbose=False).eval()

    def distance_map(first: FloatArray, second: FloatArray) -> NDArray[Any]:
        tensors = [torch.as_tensor(np.moveaxis(each, -1, 0)[None], dtype=torch.float32) for each in (first, second)]
        with torch.no_grad():
            distances = network(tensors[0], tensors[1], normalize=True)
        result: NDArray[Any] = distances[0, 0].numpy()
        return result

    return Lpips(backbone, distance_map)


def lpips(
    preds: NDArray[Any], target: NDArray[Any], mask: Mask, network: Lpips, *, convention: str = "filled"
) -> float:
    """Masked LPIPS; 0 is equal. In one of three named conventions that must not be compared.

    ``filled``: outside the mask the render is taken to be the target; mean of the map over the mask.
    ``premasked_over_mask``: both images black outside the mask, mean over the mask: the paper's published code,
    Bayes' Rays, the free-space prior. ``premasked``: black likewise, mean over all pixels: nerfbaselines.

    Args:
        preds, target: ``(H, W, 3)`` sRGB in [0, 1].
        mask: ``(H, W)`` bool.
        network: of :func:`load_lpips`, or the caller's own.
        convention: a key of ``LPIPS_CONVENTIONS``.

    Returns:
        NaN for an empty mask.

    Example:
        >>> import numpy as np
        >>> squares = Lpips("squares", lambda first, second: ((first - second) ** 2).mean(axis=-1))
        >>> target, everywhere = np.full((4, 4, 3), 0.5), np.ones((4, 4), dtype=bool)
        >>> round(lpips(target + 0.1, target, everywhere, squares), 4)
        0.01
    """
    check_pair("lpips", preds, target, mask, channels=True)
    blanked, over_mask = choose("lpips", "convention", convention, LPIPS_CONVENTIONS)
    if not mask.any():
        return float("nan")
    kept = mask[..., None]
    first = np.where(kept, preds, 0.0 if blanked else target).astype(np.float64)
    second = np.where(kept, target, 0.0 if blanked else target).astype(np.float64)
    distances = np.asarray(network.distance_map(first, second))
    if distances.shape != mask.shape:
        raise InvalidArgument(f"lpips: distance_map must give shape {mask.shape}, got {distances.shape}")
    return float(distances[mask].mean() if over_mask else distances.mean())
