"""The surroundings branch (``prior/networks/context.py``) as 2D convolutions over depth slices; see ``planar.py``."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ...core.channels import LEAST_KNOWN, REPEAT, UNKNOWN
from ...core.frames import RESOLUTION
from ...core.shards.storage import SURROUNDINGS_RESOLUTION
from .graph import GraphBuilder

Weights = NDArray[np.float32]
Stack = Callable[[GraphBuilder, str, int, int, range, int], str]


def _features(graph: GraphBuilder, channel: str) -> str:
    """``context_features``, slices before channels: ``(N, 1, 32, 32, 32)`` to ``(N, 16, 2, 16, 16)``."""
    whole, coarse = RESOLUTION, SURROUNDINGS_RESOLUTION
    numbers = ([0] * 3, [whole] * 3, [2, 3, 4], [REPEAT] * 3)
    taken = graph.node("Slice", channel, *(graph.constant(values, np.int64) for values in numbers))
    taken = graph.reshape(taken, -1, coarse, 1, coarse, coarse)
    least, known, gap = (graph.constant(v) for v in (LEAST_KNOWN, 1 / (1 - LEAST_KNOWN), 1 / (LEAST_KNOWN - UNKNOWN)))
    opacity = graph.node("Relu", graph.node("Mul", graph.node("Sub", taken, least), known))
    spread = graph.node("Mul", graph.node("Sqrt", opacity), graph.constant(2.0))
    unknown = graph.node("Relu", graph.node("Mul", graph.node("Sub", least, taken), gap))
    return graph.node("Concat", graph.node("Sub", spread, graph.constant(1.0)), unknown, axis=2)


def _central(graph: GraphBuilder, wide: str, width: int, part: slice, weights: Weights) -> str:
    """Interpolate the part about the cube: ``(N * 8, width, 8, 8)`` to the same shape over the cube."""
    grid, count = 8, part.stop - part.start
    numbers = ([part.start] * 3, [part.stop] * 3, [1, 3, 4])
    sliced = graph.reshape(wide, -1, grid, width, grid, grid)
    sliced = graph.node("Slice", sliced, *(graph.constant(values, np.int64) for values in numbers))
    rows = graph.reshape(graph.node("Transpose", sliced, perm=[0, 2, 1, 3, 4]), -1, count**3)
    fine = graph.node("Gemm", rows, graph.constant(weights))
    fine = graph.node("Transpose", graph.reshape(fine, -1, width, grid, grid * grid), perm=[0, 2, 1, 3])
    return graph.reshape(fine, -1, width, grid, grid)


def planar_context(
    graph: GraphBuilder,
    weights: dict[str, Weights],
    channel: str,
    *,
    stack: Stack,
    flatten: Callable[[Weights], Weights],
    activate: Callable[[GraphBuilder, str], str],
) -> tuple[str, str]:
    """Append the branch.

    Args:
        graph: to append to.
        weights: the network's state.
        channel: name of the surroundings ``(N, 1, 32, 32, 32)``.
        stack, flatten, activate: ``planar.py``'s ways to stack slices, to flatten a kernel, and its rectifier.

    Returns:
        names of what is added at 8^3 ``(N * 8, middle, 8, 8)``, and of the summary ``(N, width)``.
    """
    from ...prior.networks.context import interpolation

    enter, mix, down = (weights[f"context.{name}.weight"] for name in ("enter", "mix", "down"))
    enter_bias, mix_bias, down_bias = (weights[f"context.{name}.bias"] for name in ("enter", "mix", "down"))
    width, coarse = len(enter), SURROUNDINGS_RESOLUTION
    value = stack(graph, _features(graph, channel), coarse, 2 * coarse * coarse, range(-1, coarse - 1, 2), 4)
    value = graph.reshape(value, -1, 4 * 2, coarse, coarse)
    value = activate(graph, graph.conv(value, flatten(enter), enter_bias, stride=2))
    value = graph.reshape(stack(graph, value, 8, width * 64, range(-1, 7), 3), -1, 3 * width, 8, 8)
    wide = activate(graph, graph.conv(value, flatten(mix), mix_bias))
    small = graph.conv(graph.reshape(wide, -1, 2 * width, 8, 8), flatten(down), down_bias, stride=2)
    small = graph.reshape(activate(graph, small), -1, 4, width, 16)
    rows = graph.reshape(graph.node("Transpose", small, perm=[0, 2, 1, 3]), -1, 64)
    mean = graph.node("Gemm", rows, graph.constant(np.full((64, 1), 1 / 64)))
    part, matrix = interpolation()
    central = _central(graph, wide, width, part, matrix)
    beside = graph.conv(central, flatten(weights["context.project.weight"]))
    return beside, graph.reshape(mean, -1, width)
