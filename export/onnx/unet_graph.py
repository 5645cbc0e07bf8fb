"""The paper's U-Net as an ONNX graph, layer by layer with 3D convolutions.

It is a reference, not a default: group norm, attention and sigmoids need operators beyond the allow-list
(:data:`UNET_OPERATORS`), which onnxruntime's CPU and CUDA providers run; others have not been tried.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ...core.frames import RESOLUTION
from .graph import OPERATORS, GraphBuilder

if TYPE_CHECKING:
    from ...prior.networks.unet import UNet, UNetConfig

UNET_OPERATORS = OPERATORS | {"MatMul", "ReduceMean", "Sigmoid", "Softmax"}


def _array(parameter: Any) -> NDArray[np.float32]:
    values: NDArray[np.float32] = parameter.detach().float().cpu().numpy()
    return values


class _UNetGraph(GraphBuilder):
    """One method for each kind of layer; grids are ``(N, C, D, D, D)``."""

    operators = UNET_OPERATORS

    def __init__(self, config: UNetConfig) -> None:
        super().__init__()
        self.config = config

    def conv3d(self, value: str, layer: Any) -> str:
        kernel, stride, pad = layer.kernel_size[0], layer.stride[0], layer.padding[0]
        inputs = [value, self.constant(_array(layer.weight)), self.constant(_array(layer.bias))]
        return self.node("Conv", *inputs, kernel_shape=[kernel] * 3, strides=[stride] * 3, pads=[pad] * 6)

    def silu(self, value: str) -> str:
        return self.node("Mul", value, self.node("Sigmoid", value))

    def group_norm(self, value: str, layer: Any, depth: int) -> str:
        """Over each group as one long row, in two passes, then the channels' own scale and shift."""
        groups, width, axis = layer.num_groups, layer.num_channels, self.constant([2], np.int64)
        rows = self.reshape(value, -1, groups, width // groups * depth**3)
        rows = self.node("Sub", rows, self.node("ReduceMean", rows, axis, keepdims=1))
        variance = self.node("ReduceMean", self.node("Mul", rows, rows), axis, keepdims=1)
        deviation = self.node("Sqrt", self.node("Add", variance, self.constant(layer.eps)))
        grid = self.reshape(self.node("Div", rows, deviation), -1, width, depth, depth, depth)
        scale, shift = (self.constant(_array(v).reshape(1, -1, 1, 1, 1)) for v in (layer.weight, layer.bias))
        return self.node("Add", self.node("Mul", grid, scale), shift)

    def linear(self, value: str, layer: Any) -> str:
        return self.gemm(value, _array(layer.weight), _array(layer.bias))

    def embed(self, features: str, layers: Any) -> str:
        return self.linear(self.silu(self.linear(features, layers[0])), layers[2])

    def block(self, value: str, layer: Any, embedding: str, depth: int) -> tuple[str, int]:
        hidden = self.conv3d(self.silu(self.group_norm(value, layer.norm1, depth)), layer.conv1)
        bias = self.reshape(self.linear(embedding, layer.bias), -1, layer.bias.out_features, 1, 1, 1)
        hidden = self.silu(self.group_norm(self.node("Add", hidden, bias), layer.norm2, depth))
        own = self.conv3d(value, layer.skip) if hasattr(layer.skip, "weight") else value
        return self.node("Add", own, self.conv3d(hidden, layer.conv2)), depth

    def attention(self, value: str, layer: Any, embedding: str, depth: int) -> tuple[str, int]:
        width, heads, tokens = layer.norm.num_channels, layer.heads, depth**3
        parts = self.conv3d(self.group_norm(value, layer.norm, depth), layer.query_key_value)
        parts = self.reshape(parts, -1, 3 * heads, width // heads, tokens)
        split = self.constant([heads] * 3, np.int64)
        query, key, feature = self.node("Split", parts, split, outputs=3, axis=1)
        query, feature = (self.node("Transpose", part, perm=[0, 1, 3, 2]) for part in (query, feature))
        scores = self.node("Mul", self.node("MatMul", query, key), self.constant((width // heads) ** -0.5))
        mixed = self.node("MatMul", self.node("Softmax", scores, axis=-1), feature)
        mixed = self.node("Transpose", mixed, perm=[0, 1, 3, 2])
        grid = self.reshape(mixed, -1, width, depth, depth, depth)
        return self.node("Add", value, self.conv3d(grid, layer.out)), depth

    def down(self, value: str, layer: Any, embedding: str, depth: int) -> tuple[str, int]:
        return self.conv3d(value, layer.conv), depth // 2

    def up(self, value: str, layer: Any, embedding: str, depth: int) -> tuple[str, int]:
        """Each voxel twice along each axis, by concatenation; then the convolution."""
        grid = self.reshape(value, -1, layer.conv.in_channels, depth, 1, depth, 1, depth, 1)
        for axis in (3, 5, 7):
            grid = self.node("Concat", grid, grid, axis=axis)
        grid = self.reshape(grid, -1, layer.conv.in_channels, *(2 * depth,) * 3)
        return self.conv3d(grid, layer.conv), 2 * depth

    def stage(self, value: str, layers: Any, embedding: str, depth: int) -> tuple[str, int]:
        kinds = {"Block": self.block, "Attention": self.attention, "Down": self.down, "Up": self.up}
        for layer in layers:
            value, depth = kinds[type(layer).__name__](value, layer, embedding, depth)
        return value, depth


def _embedding(graph: _UNetGraph, network: UNet) -> str:
    """The activated embedding of timestep and edge fraction, ``(N, E)``; features as in ``prior/networks/unet.py``."""
    from ...prior.networks import unet

    half, axis = network.config.base_width // 2, graph.constant([1], np.int64)
    time = graph.node("Unsqueeze", graph.node("Cast", "timestep", to=1), axis)
    rates = np.exp(-np.log(unet.MAX_PERIOD) * np.arange(half) / half)
    angles = graph.node("Mul", time, graph.constant(rates[None]))
    time = graph.node("Concat", graph.node("Cos", angles), graph.node("Sin", angles), axis=1)
    low, high = np.log(unet.EDGE_FRACTION_LEAST), np.log(unet.EDGE_FRACTION_MOST)
    one, two = graph.constant(1.0), graph.constant(2.0)
    edge = graph.node("Unsqueeze", graph.node("Log", "edge_fraction"), axis)
    edge = graph.node("Div", graph.node("Sub", edge, graph.constant(low)), graph.constant(high - low))
    edge = graph.node("Sub", one, graph.node("Relu", graph.node("Sub", one, graph.node("Relu", edge))))
    waves = np.pi * 2.0 ** np.arange(unet.EDGE_WAVES)
    angles = graph.node("Mul", edge, graph.constant(waves[None]))
    place = graph.node("Sub", graph.node("Mul", edge, two), one)
    edge = graph.node("Concat", place, graph.node("Cos", angles), graph.node("Sin", angles), axis=1)
    return graph.silu(graph.node("Add", graph.embed(time, network.time), graph.embed(edge, network.edge)))


def unet_model(network: UNet, *, tail: Callable[[GraphBuilder, str], None] | None = None) -> Any:
    """The network as an ONNX ``ModelProto`` without metadata.

    Args:
        network: of any configuration.
        tail: makes the node ``x0_pred`` from the last layer; None for ``tanh(raw / 2)``, a restoration network's.

    Inputs and output are those of :func:`unghost.export.onnx.planar.planar_model`, of one channel.
    """
    import onnx
    from onnx.helper import make_tensor_value_info

    from .planar import probability

    graph, depth = _UNetGraph(network.config), RESOLUTION
    embedding = _embedding(graph, network)
    value = graph.conv3d("channels", network.first)
    kept = [value]
    for stage in network.encoder:
        value, depth = graph.stage(value, stage, embedding, depth)
        kept.append(value)
    value, depth = graph.stage(value, network.middle, embedding, depth)
    for stage in network.decoder:
        value, depth = graph.stage(graph.node("Concat", value, kept.pop(), axis=1), stage, embedding, depth)
    raw = graph.conv3d(graph.silu(graph.group_norm(value, network.norm, depth)), network.last)
    (tail or probability)(graph, raw)
    cube = (1, *(RESOLUTION,) * 3)
    inputs = [
        make_tensor_value_info("channels", onnx.TensorProto.FLOAT, ["N", *cube]),
        make_tensor_value_info("timestep", onnx.TensorProto.INT64, ["N"]),
        make_tensor_value_info("edge_fraction", onnx.TensorProto.FLOAT, ["N"]),
    ]
    output = make_tensor_value_info("x0_pred", onnx.TensorProto.FLOAT, ["N", *cube])
    return graph.model(inputs, output, name="unghost_unet")
