"""Analytic denoisers, a voxel field, cameras: what the regularizer's tests share."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from unghost.core.cameras import Cameras
from unghost.core.manifest import Manifest


class NumpyDenoiser:
    """An analytic denoiser on arrays; counts what it is asked."""

    kind = "numpy"

    def __init__(self, predict, **manifest):
        self.predict = predict
        self.manifest = Manifest("analytic", **manifest)
        self.calls = []

    def __call__(self, channels, timestep, edge_fraction):
        assert isinstance(channels, np.ndarray)
        assert channels.dtype == np.float32
        self.calls.append((channels.copy(), np.asarray(timestep), np.asarray(edge_fraction)))
        return np.asarray(self.predict(channels), dtype=np.float32)


class TorchDenoiser(NumpyDenoiser):
    """The same on tensors."""

    kind = "torch"

    def __call__(self, channels, timestep, edge_fraction):
        assert isinstance(channels, torch.Tensor)
        assert not torch.is_grad_enabled()
        self.calls.append((channels.numpy().copy(), timestep.numpy(), edge_fraction.numpy()))
        return torch.from_numpy(np.asarray(self.predict(channels.numpy()), dtype=np.float32))


def identity(channels):
    return channels


def all_empty(channels):
    return np.full_like(channels, -1.0)


def all_full(channels):
    return np.full_like(channels, 1.0)


class VoxelField(torch.nn.Module):
    """A grid of densities, trilinear, cell-centred over a box."""

    def __init__(self, values, aabb=((-1.0,) * 3, (1.0,) * 3)):
        super().__init__()
        self.values = torch.nn.Parameter(torch.as_tensor(values, dtype=torch.float32))
        self.aabb = torch.tensor(aabb, dtype=torch.float32)
        self.asked = 0
        self.largest = 0

    def forward(self, positions):
        assert positions.ndim == 2
        self.asked += len(positions)
        self.largest = max(self.largest, len(positions))
        unit = 2 * (positions - self.aabb[0]) / (self.aabb[1] - self.aabb[0]) - 1
        grid = unit.flip(-1).view(1, -1, 1, 1, 3)
        found = torch.nn.functional.grid_sample(
            self.values[None, None], grid, align_corners=False, padding_mode="border"
        )
        return found.view(-1, 1)


@pytest.fixture
def aabb():
    return np.array([[-1.0] * 3, [1.0] * 3])


@pytest.fixture
def lone_camera():
    """At the origin, looking along -z, 90 degrees wide."""
    return Cameras.create(np.eye(4)[None], np.array([50.0, 50.0, 50.0, 50.0]), 100, 100)


@pytest.fixture
def kit():
    """The classes and functions above, without importing across test files."""

    return SimpleNamespace(
        numpy_denoiser=NumpyDenoiser,
        torch_denoiser=TorchDenoiser,
        field=VoxelField,
        identity=identity,
        all_empty=all_empty,
        all_full=all_full,
        functions={"identity": identity, "empty": all_empty, "full": all_full},
    )
