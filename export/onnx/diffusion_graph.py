"""Any network of the prior as an ONNX graph; what a diffusion's last layer says becomes x0 at the end of it."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ...core.schedule import alphas_cumprod, flip_log_odds
from .graph import GraphBuilder

if TYPE_CHECKING:
    from ...prior.diffusion.model import DiffusionConfig
    from ...prior.networks.registry import AnyNetwork

Tail = Callable[[GraphBuilder, str], None]

TOLERANCE, UNET_TOLERANCE = 1e-4, 2e-3  # of x0_pred, ONNX against torch


def denoiser_model(network: AnyNetwork) -> Any:
    """A network as an ONNX ``ModelProto`` without metadata; inputs and output as in :func:`.planar.planar_model`.

    Of compact networks, diffusions among them, only operators from :data:`unghost.export.onnx.graph.OPERATORS` are
    used; the U-Net needs a few more, :data:`unghost.export.onnx.unet_graph.UNET_OPERATORS`.
    """
    from ...prior.diffusion.model import DiffusionNet
    from ...prior.networks.unet import UNet
    from .planar import planar_model
    from .unet_graph import unet_model

    if isinstance(network, DiffusionNet):
        tail = x0_tail(network.config)
        backbone = network.backbone
        return unet_model(backbone, tail=tail) if isinstance(backbone, UNet) else planar_model(backbone, tail=tail)
    return unet_model(network) if isinstance(network, UNet) else planar_model(network)


def export_tolerance(network: AnyNetwork) -> float:
    """How far ONNX and torch may be apart in fp32.

    A group norm divides what hardly varies, as an empty cube's features, by as little as ``sqrt(1e-5)``: the U-Net
    magnifies the rounding of the convolutions before it up to 316 times (4e-4 was seen, 1e-5 on cubes with content).
    """
    from ...prior.networks.unet import UNet

    return UNET_TOLERANCE if any(isinstance(part, UNet) for part in network.modules()) else TOLERANCE


def _at_timestep(graph: GraphBuilder, table: NDArray[np.float64]) -> str:
    """``table (1000,)`` at each cube's timestep, ``(N, 1, 1, 1, 1)``."""
    return graph.reshape(graph.node("Gather", graph.constant(table), "timestep", axis=0), -1, 1, 1, 1, 1)


def _clamped(graph: GraphBuilder, value: str) -> None:
    """The node ``x0_pred``: ``value`` clamped to [-1, 1] by two rectifiers, ``1 - relu(2 - relu(value + 1))``."""
    one, two = graph.constant(1.0), graph.constant(2.0)
    above = graph.node("Relu", graph.node("Add", value, one))
    graph.node("Sub", one, graph.node("Relu", graph.node("Sub", two, above)), name="x0_pred")


def _from_epsilon(graph: GraphBuilder, raw: str) -> None:
    kept = alphas_cumprod()
    noise = graph.node("Mul", _at_timestep(graph, np.sqrt(1.0 - kept)), raw)
    x0 = graph.node("Div", graph.node("Sub", "channels", noise), _at_timestep(graph, np.sqrt(kept)))
    _clamped(graph, x0)


def _from_shortcut(graph: GraphBuilder, raw: str) -> None:
    kept = alphas_cumprod()
    own = graph.node("Mul", _at_timestep(graph, np.sqrt(kept)), "channels")
    _clamped(graph, graph.node("Sub", own, graph.node("Mul", _at_timestep(graph, np.sqrt(1.0 - kept)), raw)))


def _from_logits(graph: GraphBuilder, raw: str) -> None:
    own = graph.node("Mul", _at_timestep(graph, flip_log_odds()), "channels")
    logits = graph.node("Add", raw, own)
    graph.node("Tanh", graph.node("Mul", logits, graph.constant(0.5)), name="x0_pred")


_TAILS: dict[str, Tail] = {"epsilon": _from_epsilon, "x0": _clamped, "bernoulli": _from_logits}


def x0_tail(config: DiffusionConfig) -> Tail:
    """What turns the last layer of a diffusion into ``x0_pred``; see ``prior/diffusion/model.py``."""
    return _from_shortcut if config.shortcut else _TAILS[config.objective]
