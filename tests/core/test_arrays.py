import numpy as np
import torch

from unghost.core.arrays import is_tensor, namespace, to_numpy


def test_arrays_and_tensors_are_told_apart():
    assert is_tensor(torch.zeros(1))
    assert not is_tensor(np.zeros(1))
    assert namespace(torch.zeros(1)) is torch
    assert namespace([1, 2]) is np


def test_to_numpy_detaches_and_shares_memory():
    tensor = torch.zeros(2, requires_grad=True)
    view = to_numpy(tensor)
    assert isinstance(view, np.ndarray)
    assert np.shares_memory(view, tensor.detach().numpy())
    array = np.zeros(2)
    assert to_numpy(array) is array
