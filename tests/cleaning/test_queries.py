import re

import numpy as np
import pytest
import torch

from unghost.cleaning.queries import field_device, find_backend, make_query

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


@pytest.mark.parametrize("dtype", [np.uint8, np.int64, np.float16, np.longdouble])
@pytest.mark.parametrize("backend", ["numpy", "torch"])
def test_integers_and_all_floating_point_numbers_are_densities(dtype, backend):
    def fn(p):
        made = np.full(len(p), 3, dtype=dtype)
        return torch.from_numpy(made) if backend == "torch" and dtype is not np.longdouble else made

    values = make_query(fn, place=PLACE, backend=backend, caller="f")(np.zeros((2, 3)))
    assert values.dtype == np.float64
    assert values.tolist() == [3.0, 3.0]


@pytest.mark.parametrize(
    "made",
    [
        np.ones(2, dtype=complex),
        np.ones(2, dtype=bool),
        np.array(["1.0", "2.0"]),
        np.array([1.0, None], dtype=object),
        np.ones(2, dtype="timedelta64[s]"),
        torch.ones(2, dtype=torch.complex64),
        torch.ones(2, dtype=torch.bool),
    ],
    ids=lambda made: str(made.dtype),
)
def test_what_is_no_number_is_named(made):
    rule = "f: density_fn must return integers or floating-point numbers, got "
    with pytest.raises(TypeError, match=re.escape(rule + str(made.dtype).removeprefix("torch."))):
        make_query(lambda p: made, place=PLACE, backend="numpy", caller="f")(np.zeros((2, 3)))


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
