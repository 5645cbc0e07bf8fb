import numpy as np
import onnx
import onnxruntime
import pytest
from onnx.helper import make_tensor_value_info

from unghost.export.onnx.graph import OPERATORS, OPSET, GraphBuilder


def test_equal_constants_are_stored_once_and_types_kept_apart():
    graph = GraphBuilder()
    assert graph.constant([1, 2], np.int64) == graph.constant([1, 2], np.int64)
    assert graph.constant([1, 2], np.int64) != graph.constant([1, 2])
    assert graph.constant([[1, 2]]) != graph.constant([1, 2])
    assert len(graph.initializers) == 3


def test_unknown_operators_are_refused():
    with pytest.raises(ValueError, match="operator Loop is not among"):
        GraphBuilder().node("Loop", "a")


def test_a_small_model_runs():
    graph = GraphBuilder()
    weight = np.arange(4, dtype=np.float32).reshape(1, 1, 2, 2)
    out = graph.conv("a", weight, np.ones(1, np.float32), stride=2)
    graph.node("Relu", out, name="b")
    shapes = [make_tensor_value_info(n, onnx.TensorProto.FLOAT, ["N", 1, s, s]) for n, s in (("a", 4), ("b", 2))]
    model = graph.model(shapes[:1], shapes[1], name="test")
    onnx.checker.check_model(model, full_check=True)
    assert model.opset_import[0].version == OPSET
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    found = session.run(["b"], {"a": np.ones((3, 1, 4, 4), np.float32)})[0]
    assert found.shape == (3, 1, 2, 2)
    assert np.all(found == 7.0)  # 0 + 1 + 2 + 3 + 1


def test_the_allow_list_holds_plain_operators_only():
    assert not OPERATORS & {"Loop", "If", "Scan", "NonZero", "GridSample", "Einsum"}
