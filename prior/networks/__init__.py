"""Network architectures: restoration network, the paper's U-Net, and their registry."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ...core.lazy import attach

if TYPE_CHECKING:
    from .context import LEAK as LEAK
    from .context import interpolation as interpolation
    from .registry import AnyNetwork as AnyNetwork
    from .registry import backbone_from_dict as backbone_from_dict
    from .registry import build_network as build_network
    from .registry import config_from_dict as config_from_dict
    from .registry import family as family
    from .registry import network_for as network_for
    from .registry import network_gflop as network_gflop
    from .restoration import FREQUENCIES as FREQUENCIES
    from .restoration import SIZES as SIZES
    from .restoration import NetworkConfig as NetworkConfig
    from .restoration import RestorationNet as RestorationNet
    from .restoration import parameter_count as parameter_count
    from .unet import UNet as UNet
    from .unet import UNetConfig as UNetConfig

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        ".context": ["LEAK", "interpolation"],
        ".registry": [
            "AnyNetwork",
            "backbone_from_dict",
            "build_network",
            "config_from_dict",
            "family",
            "network_for",
            "network_gflop",
        ],
        ".restoration": ["FREQUENCIES", "NetworkConfig", "RestorationNet", "SIZES", "parameter_count"],
        ".unet": ["UNet", "UNetConfig"],
    },
)
