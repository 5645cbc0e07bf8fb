"""A few lines over ``onnx.helper`` to write graphs by hand: fresh names, constants, one method per operator."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.errors import InvalidArgument

OPSET = 18
IR_VERSION = 8
OPERATORS = frozenset(
    (
        "Add",
        "Cast",
        "Concat",
        "Conv",
        "ConvTranspose",
        "Cos",
        "DepthToSpace",
        "Div",
        "Gather",
        "Gemm",
        "LeakyRelu",
        "Log",
        "Mul",
        "Pad",
        "Relu",
        "Reshape",
        "Sin",
        "Slice",
        "Split",
        "Sqrt",
        "Sub",
        "Tanh",
        "Transpose",
        "Unsqueeze",
    )
)  # all that an exported model may use


class GraphBuilder:
    """Collects nodes and initialisers; every method returns the name of its output."""

    operators = OPERATORS  # a subclass that may use others says so

    def __init__(self) -> None:
        self.nodes: list[Any] = []
        self.initializers: list[Any] = []
        self._constants: dict[tuple[str, tuple[int, ...], bytes], str] = {}

    def constant(self, values: NDArray[Any] | Sequence[Any] | float, dtype: type = np.float32) -> str:
        """An initialiser; equal constants are stored once."""
        import onnx.numpy_helper

        array: NDArray[Any] = np.ascontiguousarray(np.asarray(values, dtype=dtype))
        key = (array.dtype.str, array.shape, array.tobytes())
        if key not in self._constants:
            self._constants[key] = f"constant_{len(self._constants)}"
            self.initializers.append(onnx.numpy_helper.from_array(array, self._constants[key]))
        return self._constants[key]

    def node(self, operator: str, *inputs: str, outputs: int = 1, name: str | None = None, **attributes: Any) -> Any:
        """Append one operator; its output's name, or a list of names if there are several."""
        import onnx.helper

        if operator not in self.operators:
            raise InvalidArgument(f"GraphBuilder: operator {operator} is not among {sorted(self.operators)}")
        stem = name or f"{operator.lower()}_{len(self.nodes)}"
        names = [stem] if outputs == 1 else [f"{stem}_{index}" for index in range(outputs)]
        self.nodes.append(onnx.helper.make_node(operator, list(inputs), names, name=stem, **attributes))
        return names[0] if outputs == 1 else names

    def reshape(self, value: str, *shape: int) -> str:
        """Reshape; one dimension may be -1."""
        return self.node("Reshape", value, self.constant(shape, np.int64))

    def conv(self, value: str, weight: NDArray[Any], bias: NDArray[Any] | None = None, *, stride: int = 1) -> str:
        """2D convolution; padding keeps (stride 1) or divides (stride s) the grid."""
        kernel = weight.shape[-1]
        pad = (kernel - stride) // 2 if stride > 1 else kernel // 2
        inputs = [value, self.constant(weight)] + ([] if bias is None else [self.constant(bias)])
        return self.node("Conv", *inputs, kernel_shape=[kernel] * 2, strides=[stride] * 2, pads=[pad] * 4)

    def gemm(self, value: str, weight: NDArray[Any], bias: NDArray[Any]) -> str:
        """``value @ weight.T + bias``."""
        return self.node("Gemm", value, self.constant(weight), self.constant(bias), transB=1)

    def model(self, inputs: Sequence[Any], output: Any, *, name: str) -> Any:
        """The finished ``ModelProto`` (without metadata)."""
        import onnx.helper

        graph = onnx.helper.make_graph(self.nodes, name, list(inputs), [output], self.initializers)
        model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", OPSET)])
        model.ir_version = IR_VERSION
        model.producer_name = "unghost"
        return model
