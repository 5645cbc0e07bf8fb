"""A small shard, its optional arrays too."""

import numpy as np
import pytest

from unghost.core.frames import CubeFrame
from unghost.core.shards.packing import pack_frame, pack_labels
from unghost.core.shards.storage import write_shard


def _arrays(count=2):
    voxels = np.arange(count * 32**3, dtype=np.uint64)
    return {
        "inputs": (voxels * 7 % 256).astype(np.uint8).reshape(count, 32, 32, 32),
        "labels": pack_labels((voxels % 3).astype(np.uint8).reshape(count, 32, 32, 32)),
        "severity": np.linspace(0, 1, count, dtype=np.float32),
        "edge_fraction": np.full(count, 0.25, dtype=np.float32),
        "group": np.arange(count, dtype=np.int32),
    }


def _optional():
    turned = CubeFrame(np.array([0.5, -1.0, 2.0]), 0.25, np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]))
    return {
        "surroundings": (np.arange(2 * 16**3) * 5 % 256).astype(np.uint8).reshape(2, 16, 16, 16),
        "view_count": (np.arange(2 * 32**3) * 3 % 256).astype(np.uint8).reshape(2, 32, 32, 32),
        "transmittance": (np.arange(2 * 16**3) * 7 % 256).astype(np.uint8).reshape(2, 16, 16, 16),
        "support": (np.arange(2 * 32**3) * 11 % 256).astype(np.uint8).reshape(2, 32, 32, 32),
        "crossings": (np.arange(2 * 32**3) * 13 % 256).astype(np.uint8).reshape(2, 32, 32, 32),
        "frames": np.stack([pack_frame(turned), pack_frame(None)]),
        "source": np.array([0, -1], dtype=np.int32),
    }


@pytest.fixture(scope="session")
def arrays():
    """Makes the arrays of ``count`` pairs, two unless told."""
    return _arrays


@pytest.fixture(scope="session")
def optional():
    """Makes the optional arrays of two pairs."""
    return _optional


@pytest.fixture
def shard(tmp_path, arrays):
    folder = tmp_path / "shard-00000"
    write_shard(folder, arrays(), {"recipe": "test", "seed": 3})
    return folder
