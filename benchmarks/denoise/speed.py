"""How fast the models of the reference measurement are, and how large; those that nobody has trained included."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from unghost import load_denoiser
from unghost.core.manifest import Manifest
from unghost.export.container import precision_of
from unghost.speed import measure_speed

from ..progress import say

BATCH, SECONDS = 40, 8.0
UNTRAINED = ("unet-epsilon", "l")  # as `train_diffusion.py` and `unghost train --size` name them


@dataclass(frozen=True)
class Model:
    """A model that is scored, and the files of it that can be timed.

    Attributes:
        name: of its rows.
        scored: the file that is scored.
        onnx: it, or what was exported from it and lies beside it.
        checkpoint: it, or what it was exported from in fp32 and lies beside it.
    """

    name: str
    scored: Path
    onnx: Path | None
    checkpoint: Path | None

    @classmethod
    def of(cls, name: str, file: str, weights: Path) -> Model:
        """From NAME=FILE; a name without a suffix is a shipped one."""
        scored = Path(file) if "." in file else weights / f"{file}.onnx"
        if scored.suffix == ".safetensors":
            onnx = scored.with_suffix(".onnx")
            return cls(name, scored, onnx if onnx.is_file() else None, scored)
        checkpoint = scored.with_suffix(".safetensors")  # NAME.int8.onnx has none: torch is not timed twice
        return cls(name, scored, scored, checkpoint if checkpoint.is_file() else None)


def speed_row(model: Model, threads: int, *, seconds: float | None = None, **about: Any) -> dict[str, Any]:
    """Cubes a second through onnxruntime and torch, one after the other with as many threads each."""
    seconds = SECONDS if seconds is None else seconds
    row: dict[str, Any] = {"method": model.name, "set": "speed", "threads": threads, **about}
    row["megabytes"] = model.scored.stat().st_size / 1e6
    if model.checkpoint is not None:
        in_torch = _InTorch(model.checkpoint, threads)
        row |= _facts(in_torch.manifest)
        row["torch_cubes_per_second"] = measure_speed(in_torch, batch=BATCH, seconds=seconds)["cubes_per_second"]
    if model.onnx is not None:
        runtime = load_denoiser(model.onnx, threads=threads)
        row |= _facts(runtime.manifest) | measure_speed(runtime, batch=BATCH, seconds=seconds)
    return row


def _facts(manifest: Manifest) -> dict[str, Any]:
    training = manifest.training
    return {
        "parameters": manifest.parameters,
        "gflop": training.get("gflop"),
        "channels": list(manifest.channels),
        "precision": precision_of(manifest),
    }


class _InTorch:
    """A checkpoint that takes and gives arrays."""

    def __init__(self, path: Path, threads: int) -> None:
        import torch

        torch.set_num_threads(threads)
        self._torch, self._denoiser = torch, load_denoiser(path)
        self.manifest = self._denoiser.manifest

    def __call__(self, channels: Any, timestep: Any, edge_fraction: Any) -> Any:
        return self._denoiser(self._torch.from_numpy(channels), timestep, edge_fraction).numpy()


def untrained_rows(names: tuple[str, ...], threads: int, seconds: float | None = None) -> list[dict[str, Any]]:
    """Speed rows, marked ``trained: false``, of networks with random weights: nothing else can be said of them."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for name in names:
            say(f"{name} has no weights: its speed alone")
            path = _random_weights(name, Path(folder) / f"{name}.safetensors")
            rows.append(speed_row(Model.of(name, str(path), path.parent), threads, seconds=seconds, trained=False))
    return rows


def _random_weights(name: str, checkpoint: Path) -> Path:
    import torch

    from unghost.export.onnx.to_onnx import export_onnx
    from unghost.prior.checkpoint import save_model
    from unghost.prior.networks.registry import build_network, family, network_for, network_gflop
    from unghost.prior.networks.restoration import SIZES

    from ..release.train_diffusion import RUNS

    config = network_for(RUNS[name].objective, RUNS[name].network) if name in RUNS else SIZES[name]
    torch.manual_seed(0)
    network = build_network(config)
    parameters = sum(weight.numel() for weight in network.parameters())
    training = {"gflop": network_gflop(config), "trained": False}
    manifest = Manifest(name, family=family(config), channels=config.channels, parameters=parameters, training=training)
    save_model(checkpoint, network, manifest)
    export_onnx(checkpoint, checkpoint.with_suffix(".onnx"))
    return checkpoint.with_suffix(".onnx")
