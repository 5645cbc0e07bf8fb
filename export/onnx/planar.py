"""The restoration network as 2D convolutions over depth slices: same weights, same numbers, faster on CPUs.

onnxruntime's blocked layout covers 2D convolutions only. A 3x3x3 convolution over ``(N, C, D, H, W)`` is a
3x3 convolution over ``(N D, 3 C, H, W)`` whose input stacks each slice with its two neighbours, so the whole
network keeps slices on the batch axis:

    level   tensor                       what is on the channel axis
    32^3    (N * 8, 8 C, 32, 32)         8 slices: a group of four and two neighbours on either side
    16^3    (N * 8, 2 * fine, 16, 16)    a pair of slices
    8^3     (N * 8, middle, 8, 8)        one slice
    4^3     (N * 4, coarse, 4, 4)        one slice

Pairs at 16^3 make every change of level between 32^3 and 8^3 a strided convolution or a ``DepthToSpace``
without any transposition, and fill the 16-lane blocks in the head, which has eight outputs a slice.

Written by hand, because ``torch.onnx.export`` (2.13, either exporter) keeps the 3D convolutions: the default network in
fp32 denoises 449 cubes a second with this graph and 212 with the exported one (16 cubes a call, one thread, onnxruntime
1.31; torch itself 332), and their outputs differ by 2.3e-6 at most.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ...core.frames import RESOLUTION
from ...core.schedule import TIMESTEPS
from .graph import GraphBuilder
from .surroundings_branch import planar_context

if TYPE_CHECKING:
    from ...prior.networks.restoration import RestorationNet

Weights = NDArray[np.float32]
PAIRS = RESOLUTION // 4  # pairs of 16^3 slices, and slices at 8^3


def _activate(graph: GraphBuilder, value: str) -> str:
    from ...prior.networks.context import LEAK

    return graph.node("LeakyRelu", value, alpha=LEAK)


def _windows(graph: GraphBuilder, value: str, depth: int, row: int, starts: range, width: int) -> str:
    """Stack ``width`` neighbouring slices for each start: ``(N, depth, row)`` to ``(N, len(starts), width, row)``.

    Slices outside [0, depth) are zero: one zero slice is appended and gathered wherever it is needed.
    """
    padded = graph.node("Pad", graph.reshape(value, -1, depth, row), graph.constant([0, 0, 0, 0, 1, 0], np.int64))
    table = [[index if 0 <= index < depth else depth for index in range(start, start + width)] for start in starts]
    return graph.node("Gather", padded, graph.constant(table, np.int64), axis=1)


def _flat_kernel(weight: Weights) -> Weights:
    """``(out, in, kz, ky, kx)`` to ``(out, kz * in, ky, kx)``: slices outermost, as :func:`_windows` stacks them."""
    out, channels, depth, height, width = weight.shape
    return weight.transpose(0, 2, 1, 3, 4).reshape(out, depth * channels, height, width)


def _pair_kernel(weight: Weights, stride: int) -> Weights:
    """A kernel for one slice, ``(out, in, k, k, k)``, as one for two: ``(2 out, (k + stride) in, k, k)``."""
    out, channels, kernel = weight.shape[:3]
    pair = np.zeros((2, out, channels, kernel + stride, kernel, kernel), np.float32)
    pair[0, :, :, :kernel] = weight
    pair[1, :, :, stride:] = weight
    return _flat_kernel(pair.reshape(2 * out, channels, kernel + stride, kernel, kernel))


def _stem_kernel(weight: Weights) -> Weights:
    """Space-to-depth and 3x3x3, ``(out, 8 C, 3, 3, 3)``, as one 6x6x6 kernel of stride 2, ``(out, C, 6, 6, 6)``."""
    out, channels = weight.shape[0], weight.shape[1] // 8
    split = weight.reshape(out, channels, 2, 2, 2, 3, 3, 3).transpose(0, 1, 5, 2, 6, 3, 7, 4)
    return split.reshape(out, channels, 6, 6, 6)


def _up(graph: GraphBuilder, value: str, weight: Weights, bias: Weights) -> str:
    """``prior.network.Upsample``: ``(M, in, h, w)`` to ``(M, 2 out, 2 h, 2 w)``, a pair of slices on the channels.

    As one transposed convolution, for which onnxruntime needs half the time of ``Conv`` and ``DepthToSpace``.
    """
    channels = weight.shape[1]
    kernel = weight.reshape(2, 2, 2, -1, channels).transpose(4, 0, 3, 1, 2)  # (in, dz, out, dy, dx)
    inputs = [value, graph.constant(kernel.reshape(channels, -1, 2, 2)), graph.constant(np.tile(bias, 2))]
    return graph.node("ConvTranspose", *inputs, kernel_shape=[2, 2], strides=[2, 2])


def _condition(graph: GraphBuilder, weights: dict[str, Weights], pooled: str | None) -> str:
    """All biases of all blocks, ``(N, sum of widths)``; ``pooled`` is the summary of the surroundings, if any."""
    from ...prior.networks.restoration import EDGE_FRACTION_CENTER as center
    from ...prior.networks.restoration import EDGE_FRACTION_SPREAD as spread
    from ...prior.networks.restoration import FREQUENCIES as frequencies

    time = graph.node("Div", graph.node("Cast", "timestep", to=1), graph.constant(TIMESTEPS - 1.0))
    log = graph.node("Log", graph.node("Div", "edge_fraction", graph.constant(center)))
    edge = graph.node("Tanh", graph.node("Div", log, graph.constant(spread)))
    axis = graph.constant([1], np.int64)
    time, edge = (graph.node("Unsqueeze", value, axis) for value in (time, edge))
    waves = graph.constant(math.pi * 2.0 ** np.arange(-1, frequencies - 1)[None])
    angles = graph.node("Concat", graph.node("Mul", time, waves), graph.node("Mul", edge, waves), axis=1)
    summary = [] if pooled is None else [pooled]
    hidden = graph.node("Concat", time, edge, graph.node("Sin", angles), graph.node("Cos", angles), *summary, axis=1)
    for layer in (0, 2, 4):
        hidden = graph.gemm(hidden, weights[f"condition.{layer}.weight"], weights[f"condition.{layer}.bias"])
        hidden = graph.node("Relu", hidden) if layer < 4 else hidden
    return hidden


def _block(graph: GraphBuilder, weights: dict[str, Weights], name: str, value: str, bias: str, depth: int) -> str:
    """One residual block on ``(N * depth, C, depth, depth)``; ``bias (N, C)``."""
    width = weights[f"{name}.first.weight"].shape[0]
    row = width * depth * depth

    def convolve(value: str, part: str, bias: Weights | None) -> str:
        stacked = _windows(graph, value, depth, row, range(-1, depth - 1), 3)
        stacked = graph.reshape(stacked, -1, 3 * width, depth, depth)
        return graph.conv(stacked, _flat_kernel(weights[f"{name}.{part}.weight"]), bias)

    hidden = graph.reshape(convolve(value, "first", None), -1, depth, width, depth * depth)
    shifted = graph.node("Add", hidden, graph.reshape(bias, -1, 1, width, 1))
    return graph.node("Add", convolve(_activate(graph, shifted), "second", weights[f"{name}.second.bias"]), value)


def _spread(graph: GraphBuilder, signed: str) -> str:
    """``prior.network.voxel_features`` of signed opacity: ``2 sqrt(o) - 1``."""
    half = graph.constant(0.5)
    opacity = graph.node("Relu", graph.node("Add", graph.node("Mul", signed, half), half))
    root = graph.node("Mul", graph.node("Sqrt", opacity), graph.constant(2.0))
    return graph.node("Sub", root, graph.constant(1.0))


def _stem(graph: GraphBuilder, weights: dict[str, Weights], names: list[str], *, spread: bool) -> str:
    """Features (the first channel's if ``spread``) and first convolution of the aligned channels.

    Returns the name of ``(N * 8, 2 fine, 16, 16)``.
    """
    plane, channels = RESOLUTION**2, len(names)
    first, others = names[0], names[1:]
    features = _spread(graph, first) if spread else first
    if channels > 1:
        joined = graph.node("Concat", features, *others, axis=1)
        features = graph.node("Transpose", joined, perm=[0, 2, 1, 3, 4])
    stacked = _windows(graph, features, RESOLUTION, channels * plane, range(-2, RESOLUTION - 2, 4), 8)
    stacked = graph.reshape(stacked, -1, 8 * channels, RESOLUTION, RESOLUTION)
    kernel = _pair_kernel(_stem_kernel(weights["stem.weight"]), 2)
    stem = graph.conv(stacked, kernel, np.tile(weights["stem.bias"], 2), stride=2)
    return _activate(graph, stem)


def _head_kernel(weight: Weights) -> Weights:
    """``(8, C, 3, 3, 3)`` as ``(32, 2 C, 3, 3)``: what a pair of slices gives to slices 0, 1, -1 and 2 of the pair.

    Shifting the few outputs costs less than stacking the many inputs, as :func:`_windows` would.
    """
    out, channels = weight.shape[:2]
    kernel = np.zeros((4, out, 2, channels, 3, 3), np.float32)
    for row, target in enumerate((0, 1, -1, 2)):
        for source in (0, 1):
            if abs(source - target) <= 1:
                kernel[row, :, source] = weight[:, :, source - target + 1]
    return kernel.reshape(4 * out, 2 * channels, 3, 3)


def _head(graph: GraphBuilder, weights: dict[str, Weights], fine: str) -> str:
    """The last convolution ``(N, 1, 32, 32, 32)``, before the input's shortcut is added."""
    row = 8 * 16 * 16
    bias = np.concatenate([np.tile(weights["head.bias"], 2), np.zeros(16, np.float32)])
    parts = graph.reshape(graph.conv(fine, _head_kernel(weights["head.weight"]), bias), -1, 4 * PAIRS, row)
    padded = graph.node("Pad", parts, graph.constant([0, 0, 0, 0, 1, 0], np.int64))
    own = [4 * pair + half for pair in range(PAIRS) for half in (0, 1)]
    nothing = 4 * PAIRS
    other = [4 * (pair - 1) + 3 if half == 0 else 4 * (pair + 1) + 2 for pair in range(PAIRS) for half in (0, 1)]
    other = [index if 0 <= index < nothing else nothing for index in other]
    own, other = (graph.node("Gather", padded, graph.constant(table, np.int64), axis=1) for table in (own, other))
    out = graph.reshape(graph.node("Add", own, other), -1, 16, 16, 16)
    out = graph.node("DepthToSpace", out, blocksize=2, mode="CRD")
    return graph.reshape(out, -1, 1, RESOLUTION, RESOLUTION, RESOLUTION)


def probability(graph: GraphBuilder, logits: str) -> None:
    """The node ``x0_pred`` of a restoration network: ``tanh(logits / 2)``, that is 2 p - 1."""
    graph.node("Tanh", graph.node("Mul", logits, graph.constant(0.5)), name="x0_pred")


def planar_model(network: RestorationNet, *, tail: Callable[[GraphBuilder, str], Any] | None = None) -> Any:
    """The network as an ONNX ``ModelProto`` without metadata.

    With a ``tail`` the network reads its channels as they are (``RestorationNet.raw``), and the tail makes the node
    ``x0_pred`` from its last layer.

    Inputs ``channels (N, C, 32, 32, 32) float32``, ``timestep (N,) int64``, ``edge_fraction (N,) float32``;
    output ``x0_pred (N, 1, 32, 32, 32)``; N >= 1 is free.
    """
    import onnx
    from onnx.helper import make_tensor_value_info

    weights = {name: value.detach().float().cpu().numpy() for name, value in network.state_dict().items()}
    config, graph = network.config, GraphBuilder()
    _, middle_width, coarse_width = config.widths
    down, bottom, up = config.blocks
    count, names, beside, pooled = len(config.channels), ["channels"], None, None
    if count > 1:
        names = graph.node("Split", "channels", graph.constant([1] * count, np.int64), outputs=count, axis=1)
    if config.surroundings is not None:
        beside, pooled = planar_context(
            graph, weights, names[config.surroundings], stack=_windows, flatten=_flat_kernel, activate=_activate
        )
    condition = _condition(graph, weights, pooled)
    depths = [8] * down + [4] * bottom + [8] * up
    widths = [{8: middle_width, 4: coarse_width}[depth] for depth in depths]
    ends = np.cumsum([0, *widths])
    biases = [
        graph.node("Slice", condition, *(graph.constant([v], np.int64) for v in (start, end, 1)))
        for start, end in itertools.pairwise(ends)
    ]

    def run(value: str, first: int, count: int) -> str:
        for index in range(first, first + count):
            value = _block(graph, weights, f"blocks.{index}", value, biases[index], depths[index])
        return value

    fine = _stem(graph, weights, [names[index] for index in config.aligned], spread=tail is None)
    middle = graph.conv(fine, _flat_kernel(weights["down_middle.weight"]), weights["down_middle.bias"], stride=2)
    if beside is not None:
        middle = graph.node("Add", middle, beside)
    middle = run(middle, 0, down)
    pairs = graph.reshape(middle, -1, 2 * middle_width, 8, 8)
    coarse = graph.conv(pairs, _flat_kernel(weights["down_coarse.weight"]), weights["down_coarse.bias"], stride=2)
    coarse = run(coarse, down, bottom)
    lifted = _up(graph, coarse, weights["up_middle.mix.weight"], weights["up_middle.bias"])
    lifted = graph.reshape(lifted, -1, middle_width, 8, 8)
    middle = run(graph.node("Add", middle, lifted), down + bottom, up)
    lifted = _up(graph, middle, weights["up_fine.mix.weight"], weights["up_fine.bias"])
    fine = _activate(graph, graph.node("Add", fine, lifted))
    out = _head(graph, weights, fine)
    logits = graph.node("Add", out, graph.node("Mul", names[0], graph.constant(weights["gain"])))
    (tail or probability)(graph, logits)
    cube = (RESOLUTION,) * 3
    inputs = [
        make_tensor_value_info("channels", onnx.TensorProto.FLOAT, ["N", count, *cube]),
        make_tensor_value_info("timestep", onnx.TensorProto.INT64, ["N"]),
        make_tensor_value_info("edge_fraction", onnx.TensorProto.FLOAT, ["N"]),
    ]
    output = make_tensor_value_info("x0_pred", onnx.TensorProto.FLOAT, ["N", 1, *cube])
    return graph.model(inputs, output, name="unghost_restoration")
