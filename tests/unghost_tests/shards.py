"""Small shards and networks for the tests of the prior."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from unghost.core.frames import unit_lattice
from unghost.core.shards.packing import pack_labels, quantize_signed
from unghost.core.shards.storage import write_shard
from unghost.prior.networks.restoration import NetworkConfig
from unghost.prior.training.config import TrainConfig

TINY = NetworkConfig(widths=(8, 8, 8), condition_width=8)


def make_pairs(count: int, seed: int) -> dict[str, np.ndarray]:
    """Soft spheres with blobs as ghosts; every fifth cube is clean."""
    lattice = unit_lattice()
    signed, labels = np.empty((count, 32, 32, 32)), np.empty((count, 32, 32, 32), np.uint8)
    severity = np.empty(count, np.float32)
    for index in range(count):
        rng = np.random.default_rng([seed, index])
        shell = np.abs(np.linalg.norm(lattice - rng.uniform(-0.2, 0.2, 3), axis=-1) - rng.uniform(0.2, 0.4))
        labels[index] = shell < 0.05
        severity[index] = 0.0 if index % 5 == 0 else rng.uniform(0.1, 1.0)
        opacity = labels[index].astype(float)
        if severity[index]:
            blob = np.linalg.norm(lattice - rng.uniform(-0.4, 0.4, 3), axis=-1) < 0.1
            opacity = np.maximum(0.9 * opacity, 0.5 * blob)
            labels[index][shell > 0.6] = 2
        signed[index] = 2.0 * opacity - 1.0
    return {
        "inputs": quantize_signed(signed),
        "labels": pack_labels(labels),
        "severity": severity,
        "edge_fraction": np.linspace(0.02, 0.3, count).astype(np.float32),
        "group": np.arange(count, dtype=np.int32),
    }


def make_context(count: int, seed: int) -> dict[str, np.ndarray]:
    """Surroundings and view counts without meaning or symmetry."""
    rng = np.random.default_rng([seed, 1])
    return {
        "surroundings": rng.integers(0, 256, (count, 16, 16, 16), dtype=np.uint8),
        "view_count": rng.integers(0, 40, (count, 32, 32, 32), dtype=np.uint8),
        "support": rng.integers(0, 256, (count, 32, 32, 32), dtype=np.uint8),
        "crossings": rng.integers(0, 256, (count, 32, 32, 32), dtype=np.uint8),
        "transmittance": rng.integers(0, 256, (count, 16, 16, 16), dtype=np.uint8),
    }


@pytest.fixture(scope="session")
def shard_paths(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Three shards: ``a`` (12 cubes), ``b`` (7), ``held_out`` (10); and ``seen`` (9) with surroundings and views."""
    root = tmp_path_factory.mktemp("shards")
    for seed, (name, count) in enumerate({"a": 12, "b": 7, "held_out": 10}.items()):
        write_shard(root / name, make_pairs(count, seed), {"seed": seed})
    write_shard(root / "seen", make_pairs(9, 5) | make_context(9, 5), {"seed": 5}, kind="harvest")
    return {name: root / name for name in ("a", "b", "held_out", "seen")}


@pytest.fixture
def tiny_config() -> TrainConfig:
    """Six fp32 steps of a tiny network, checkpoints every step on demand only."""
    return TrainConfig(
        network=TINY,
        steps=6,
        batch_size=3,
        precision="fp32",
        warmup_steps=1,
        checkpoint_seconds=1e6,
        validate_seconds=0.0,
        seed=3,
    )
