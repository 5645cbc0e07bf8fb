"""Weights on disk (safetensors, nothing pickled) and as a denoiser."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..core.channels import with_unknown
from ..core.errors import InvalidArgument, InvalidFile, InvalidType, needs_extra
from ..core.io import write_bytes
from ..core.manifest import METADATA_KEY, Manifest
from ..core.schedule import TIMESTEPS
from .networks.registry import AnyNetwork, build_network, config_from_dict

CONFIG_KEY = "unghost_network"


def _ordered(data: bytes) -> bytes:
    """The same safetensors file with its header's keys sorted: equal contents, equal bytes, equal hashes."""
    end = 8 + int.from_bytes(data[:8], "little")
    header = json.dumps(json.loads(data[8:end]), sort_keys=True, separators=(",", ":")).encode()
    header += b" " * (-len(header) % 8)
    return len(header).to_bytes(8, "little") + header + data[end:]


def write_tensors(path: str | Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> None:
    """Write a safetensors file, whole or not at all; equal contents give equal bytes."""
    with needs_extra("torch", caller="write_tensors"):
        from safetensors.torch import save
    plain = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    write_bytes(path, _ordered(save(plain, dict(metadata))), fsync=True)


def read_tensors(path: str | Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Tensors and metadata of a safetensors file.

    Raises:
        ValueError: missing, truncated, or another kind of file.
    """
    with needs_extra("torch", caller="read_tensors"):
        from safetensors import SafetensorError, safe_open
    source = Path(path)
    if not source.is_file():
        raise InvalidFile(f"read_tensors: {source} does not exist or is not a file")
    try:
        with safe_open(source, framework="pt") as opened:
            metadata = dict(opened.metadata() or {})
            return {name: opened.get_tensor(name) for name in opened.keys()}, metadata  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise InvalidFile(f"read_tensors: {source} is truncated or not a safetensors file ({error})") from None


class TorchDenoiser:
    """A network as a denoiser: evaluation mode, no gradient, tensors in and out, on the network's device."""

    kind = "torch"

    def __init__(self, network: AnyNetwork, manifest: Manifest) -> None:
        if manifest.channels != network.config.channels:
            raise InvalidArgument(
                f"TorchDenoiser: the manifest names the channels {manifest.channels}, "
                f"the network takes {network.config.channels}"
            )
        self.network = network.eval().requires_grad_(False)
        self.manifest = manifest

    def to(self, device: torch.device | str) -> TorchDenoiser:
        """The same denoiser, its weights moved to ``device``."""
        self.network.to(device)
        return self

    @torch.no_grad()
    def __call__(self, channels: Tensor, timestep: Any, edge_fraction: Any) -> Tensor:
        """Denoise.

        Args:
            channels: ``(N, C, 32, 32, 32)`` in [-1, 1]; given ``(N, 1, 32, 32, 32)``, the others are unknown.
            timestep: ``(N,)`` integers in [0, 1000), or one for all.
            edge_fraction: ``(N,)`` > 0, or one for all.

        Returns:
            ``x0_pred (N, 1, 32, 32, 32)`` float32 in [-1, 1], on the device of ``channels``.

        Raises:
            TypeError: timesteps that are not integers.
            ValueError: shapes, or values out of range.
        """
        device = next(self.network.parameters()).device
        channels = with_unknown(channels, len(self.manifest.channels))
        count = (len(channels),)
        times = torch.as_tensor(timestep, device=device)
        if times.is_floating_point() or times.dtype == torch.bool:
            raise InvalidType(f"TorchDenoiser: timestep must be an integer, got dtype {times.dtype}")
        if bool(((times < 0) | (times >= TIMESTEPS)).any()):
            raise InvalidArgument(
                f"TorchDenoiser: timestep must lie in [0, {TIMESTEPS}), got {times.min()} .. {times.max()}"
            )
        edges = torch.as_tensor(edge_fraction, device=device, dtype=torch.float32)
        if not bool((torch.isfinite(edges) & (edges > 0)).all()):
            raise InvalidArgument("TorchDenoiser: edge_fraction must be finite and > 0")
        if not bool(torch.isfinite(channels).all()):
            raise InvalidArgument("TorchDenoiser: channels must be finite")
        times = times.expand(count) if times.ndim == 0 else times
        edges = edges.expand(count) if edges.ndim == 0 else edges
        x0_pred: Tensor = self.network(channels.to(device, torch.float32), times, edges).to(channels.device)
        return x0_pred


def save_model(path: str | Path, network: AnyNetwork, manifest: Manifest, *, half: bool = False) -> None:
    """Write weights, manifest and network configuration as one safetensors file, atomically.

    With ``half`` the weights are stored as float16, rounded to it: half the file. :func:`load_model` computes in
    float32 with either.
    """
    if manifest.channels != network.config.channels:
        raise InvalidArgument(
            f"save_model: the manifest names the channels {manifest.channels}, "
            f"the network takes {network.config.channels}"
        )
    metadata = {METADATA_KEY: manifest.to_json(), CONFIG_KEY: json.dumps(network.config.to_dict(), sort_keys=True)}
    stored = {name: value.half() if half else value for name, value in network.state_dict().items()}
    write_tensors(path, stored, metadata)


def network_from_tensors(tensors: Mapping[str, Tensor], metadata: Mapping[str, str], *, origin: str) -> AnyNetwork:
    """Build the network that ``metadata`` describes and fill it; ``origin`` names the file in errors."""
    if CONFIG_KEY not in metadata:
        raise InvalidFile(f"{origin}: not an unghost checkpoint (its header has no {CONFIG_KEY!r})")
    try:
        config = config_from_dict(json.loads(metadata[CONFIG_KEY]))
    except (ValueError, TypeError) as error:
        raise InvalidFile(f"{origin}: its network configuration is not readable ({error})") from None
    network = build_network(config)
    try:
        network.load_state_dict(dict(tensors))
    except RuntimeError as error:
        raise InvalidFile(f"{origin}: its weights do not fit its configuration ({error})") from None
    bad = [name for name, value in tensors.items() if not bool(torch.isfinite(value).all())]
    if bad:
        raise InvalidFile(f"{origin}: weights are not finite in {bad}")
    return network


def load_model(path: str | Path, *, device: torch.device | str = "cpu") -> TorchDenoiser:
    """Read a file of :func:`save_model` as a denoiser.

    Raises:
        ValueError: missing, truncated or foreign file, or weights that do not fit.
    """
    tensors, metadata = read_tensors(path)
    if METADATA_KEY not in metadata:
        raise InvalidFile(f"load_model: {path} is not an unghost checkpoint (its header has no {METADATA_KEY!r})")
    manifest = Manifest.from_json(metadata[METADATA_KEY], origin=str(path))
    network = network_from_tensors(tensors, metadata, origin=str(path))
    if manifest.channels != network.config.channels:
        raise InvalidFile(f"{path}: its manifest and its network disagree on the channels")
    return TorchDenoiser(network.to(device), manifest)
