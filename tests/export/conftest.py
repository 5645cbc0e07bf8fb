"""Small checkpoints and their exports for the tests of the export."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch

from unghost.core.manifest import Manifest
from unghost.export.onnx.parity import ParityInputs
from unghost.export.onnx.quantization import calibration_inputs, export_precisions
from unghost.export.onnx.to_onnx import export_onnx
from unghost.prior.checkpoint import save_model
from unghost.prior.networks.restoration import NetworkConfig, RestorationNet
from unghost.speed import sample_channels


def lively_network(config: NetworkConfig, seed: int = 0) -> RestorationNet:
    """Random weights large enough that every part moves the output."""
    torch.manual_seed(seed)
    network = RestorationNet(config).eval()
    with torch.no_grad():
        for name, value in network.named_parameters():
            if name.endswith("bias"):
                value.normal_(0.0, 0.3)
        for block in network.blocks:
            block.second.weight.mul_(10.0)
        network.head.weight.mul_(30.0)
        if config.surroundings is not None:
            network.context.project.weight.mul_(10.0)
        network.gain.fill_(0.7)
    return network


@dataclass(frozen=True)
class Exported:
    """One network in both forms."""

    network: RestorationNet
    checkpoint: Path
    onnx: Path
    manifest: Manifest


@pytest.fixture(scope="session")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Exported:
    """The default architecture with random weights."""
    folder = tmp_path_factory.mktemp("export")
    network = lively_network(NetworkConfig())
    manifest = Manifest(name="random", default_timestep=640, removal_threshold=-0.25, training={"seed": 0})
    save_model(folder / "model.safetensors", network, manifest)
    written = export_onnx(folder / "model.safetensors", folder / "model.onnx")
    return Exported(network, folder / "model.safetensors", folder / "model.onnx", written)


@pytest.fixture(scope="session")
def make_lively() -> Callable[[NetworkConfig], RestorationNet]:
    """A network from a configuration; see :func:`lively_network`."""
    return lively_network


@pytest.fixture(scope="session")
def calibration() -> ParityInputs:
    """Noisy balls and shells."""
    return calibration_inputs(sample_channels(24, 1, seed=5), np.full(24, 0.1), default_timestep=640)


@pytest.fixture(scope="session")
def precisions(
    exported: Exported, calibration: ParityInputs, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, Path]:
    """The default architecture with random weights in every precision; :func:`exported`'s file for fp32."""
    folder = tmp_path_factory.mktemp("precisions")
    files = export_precisions(
        exported.checkpoint,
        folder,
        precisions=("fp16", "int8"),
        calibration=calibration,
        source="balls",
        verify_cubes=0,
    )
    return {"fp32": exported.onnx, **files}
