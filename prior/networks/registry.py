"""Every network there is, by its configuration: the one place that knows them all."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeAlias

from ...core.errors import InvalidArgument
from ..diffusion.model import KIND as DIFFUSION
from ..diffusion.model import DiffusionConfig, DiffusionNet
from .restoration import NetworkConfig, RestorationNet, gflop
from .unet import KIND as UNET
from .unet import UNet, UNetConfig, unet_gflop

BackboneConfig: TypeAlias = NetworkConfig | UNetConfig
AnyConfig: TypeAlias = NetworkConfig | UNetConfig | DiffusionConfig
AnyNetwork: TypeAlias = RestorationNet | UNet | DiffusionNet

DEFAULT_TIMESTEPS = {"restoration": 900, "diffusion": 50}  # by family; the paper's range is 10 to 50

_TAGGED: dict[str, type[UNetConfig] | type[DiffusionConfig]] = {UNET: UNetConfig, DIFFUSION: DiffusionConfig}


def config_from_dict(values: Mapping[str, Any]) -> AnyConfig:
    """A network's configuration from parsed JSON; its ``kind`` tells which, and without one it is the restoration's.

    Raises:
        ValueError: unknown kind or keys, or values that the configuration refuses.

    Example:
        >>> from unghost.prior.networks.restoration import SIZES
        >>> config_from_dict(SIZES["s"].to_dict()) == SIZES["s"]
        True
    """
    if not isinstance(values, Mapping):
        raise InvalidArgument(f"config_from_dict: a network must be a table of keys and values, got {values!r:.80}")
    kind = values.get("kind")
    if kind is None:
        return NetworkConfig.from_dict(values)
    if kind not in _TAGGED:
        raise InvalidArgument(f"config_from_dict: kind must be one of {sorted(_TAGGED)} or absent, got {kind!r}")
    return _TAGGED[kind].from_dict(values)


def backbone_from_dict(values: Mapping[str, Any]) -> BackboneConfig:
    """The same where a diffusion would be one too many.

    Raises:
        ValueError: as :func:`config_from_dict`, or ``kind`` is ``"diffusion"``.

    Example:
        >>> from unghost.prior.networks.restoration import SIZES
        >>> backbone_from_dict(SIZES["s"].to_dict()) == SIZES["s"]
        True
    """
    config = config_from_dict(values)
    if isinstance(config, DiffusionConfig):
        raise InvalidArgument("backbone_from_dict: kind must name a backbone; the diffusion is chosen by the objective")
    return config


def build_network(config: AnyConfig) -> AnyNetwork:
    """A network with fresh weights from torch's generator.

    Example:
        >>> from unghost.prior.networks.restoration import SIZES
        >>> type(build_network(SIZES["xs"])).__name__
        'RestorationNet'
    """
    if isinstance(config, DiffusionConfig):
        return DiffusionNet(config)
    return UNet(config) if isinstance(config, UNetConfig) else RestorationNet(config)


def network_for(objective: str, config: BackboneConfig) -> AnyConfig:
    """What a run of ``objective`` trains: the backbone itself for ``"restoration"``, else a diffusion on it.

    Example:
        >>> from unghost.prior.networks.restoration import SIZES
        >>> [family(network_for(objective, SIZES["xs"])) for objective in ("restoration", "epsilon")]
        ['restoration', 'diffusion']
    """
    if objective == "restoration":
        return config
    return DiffusionConfig(objective, config)  # type: ignore[arg-type]


def family(config: AnyConfig) -> str:
    """The manifest's word for it: ``"diffusion"`` or ``"restoration"``.

    Example:
        >>> from unghost.prior.networks.restoration import SIZES
        >>> family(SIZES["xs"])
        'restoration'
    """
    return "diffusion" if isinstance(config, DiffusionConfig) else "restoration"


def network_gflop(config: AnyConfig) -> float:
    """Work for one cube in 10^9 operations (a multiply-add is two).

    Example:
        >>> from unghost.prior.networks.restoration import SIZES
        >>> network_gflop(SIZES["xs"]) < network_gflop(SIZES["m"])
        True
    """
    backbone = config.network if isinstance(config, DiffusionConfig) else config
    return unet_gflop(backbone) if isinstance(backbone, UNetConfig) else gflop(backbone)
