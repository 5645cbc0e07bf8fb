import numpy as np
import pytest
import torch

from unghost.regularizer.queries import field_device, find_backend, make_query

PLACE = np.zeros(3)


def test_the_backend_is_found(kit):
    assert find_backend(lambda p: np.exp(-p[..., 0]), PLACE, caller="f") == "numpy"
    assert find_backend(lambda p: torch.exp(-p.norm(dim=-1)), PLACE, caller="f") == "torch"
    field = kit.field(torch.ones(2, 2, 2))
    assert find_backend(field, PLACE, caller="f") == "torch"
    assert find_backend(field.forward, PLACE, caller="f") == "torch"
    assert field_device(field.forward) == torch.device("cpu")
    assert field_device(lambda p: p) is None


def test_a_callable_that_takes_neither_says_why_twice():
    def broken(p):
        raise KeyError(type(p).__name__)

    with pytest.raises(ValueError, match=r"f: density_fn must accept.*KeyError: 'ndarray'.*KeyError: 'Tensor'"):
        find_backend(broken, PLACE, caller="f")
    with pytest.raises(TypeError, match="must be callable, got int"):
        find_backend(3, PLACE, caller="f")
    with pytest.raises(ValueError, match="backend must be None, 'numpy' or 'torch'"):
        make_query(lambda p: p, place=PLACE, backend="jax", caller="f")


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
def test_tensors_of_any_precision_come_back_as_float64(dtype):
    def fn(p):
        assert not torch.is_grad_enabled()
        return p[:, :1].to(dtype) * 2

    values = make_query(fn, place=PLACE, chunk=3, caller="f")(np.full((10, 3), 0.5))
    assert values.dtype == np.float64
    assert values.tolist() == [1.0] * 10


def test_chunks_are_bounded_and_empty_queries_ask_nothing():
    asked = []

    def fn(p):
        asked.append(p.shape)
        assert p.dtype == np.float32
        return p[:, 0]

    query = make_query(fn, place=PLACE, backend="numpy", chunk=4, caller="f")
    assert asked == []
    positions = np.arange(30, dtype=float).reshape(10, 3)
    assert (query(positions) == positions[:, 0]).all()
    assert asked == [(4, 3), (4, 3), (2, 3)]
    assert query(np.zeros((0, 3))).shape == (0,)


def test_a_wrong_shape_is_named():
    with pytest.raises(ValueError, match=r"f: density_fn must return shape \(10, 1\) or \(10,\)"):
        make_query(lambda p: p, place=PLACE, caller="f")(np.zeros((10, 3)))
    with pytest.raises(TypeError, match="must return an array or tensor, got list"):
        make_query(lambda p: [1.0], place=PLACE, caller="f")(np.zeros((1, 3)))
