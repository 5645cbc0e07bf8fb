"""What a denoiser says about itself; the same JSON in safetensors and in ONNX metadata."""

from __future__ import annotations

import dataclasses
import json
import math
from dataclasses import dataclass
from typing import Any, Protocol

from .channels import check_channels
from .config import from_dict, to_dict
from .errors import InvalidArgument, InvalidFile
from .frames import RESOLUTION
from .schedule import TIMESTEPS

FORMAT = "unghost-denoiser"
FORMAT_VERSION = 1
METADATA_KEY = "unghost_manifest"


@dataclass(frozen=True)
class Manifest:
    """Everything a runtime must know of a denoiser.

    Attributes:
        name: of the model, for people.
        family: ``"restoration"`` (severity as timestep) or ``"diffusion"`` (the paper).
        channels: input channels in order, each in [-1, 1] (:mod:`unghost.core.channels`); the first is always
            ``signed_opacity`` (a bit is a special case of it).
        resolution: voxels along an edge.
        default_timestep: what the regularizer and ``clean`` use unless told.
        removal_threshold: ``x0_pred`` below which ``clean`` is advised to remove (0: the paper's rule). Score
            distillation has thresholds of its own.
        parameters: number of weights.
        body_bytes, body_sha256: length and hash of the ONNX file before its metadata; 0 and "" in checkpoints.
        training: free-form provenance (recipe, seed, steps, command).
    """

    name: str
    family: str = "restoration"
    channels: tuple[str, ...] = ("signed_opacity",)
    resolution: int = RESOLUTION
    default_timestep: int = 900
    removal_threshold: float = 0.0
    parameters: int = 0
    body_bytes: int = 0
    body_sha256: str = ""
    training: dict[str, Any] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "channels", check_channels(self.channels, caller="Manifest"))
        if not 0 <= self.default_timestep < TIMESTEPS:
            raise InvalidArgument(
                f"Manifest: default_timestep must lie in [0, {TIMESTEPS}), got {self.default_timestep}"
            )
        if not (math.isfinite(self.removal_threshold) and -1.0 <= self.removal_threshold <= 1.0):
            raise InvalidArgument(f"Manifest: removal_threshold must lie in [-1, 1], got {self.removal_threshold}")

    def to_json(self) -> str:
        """One JSON object, keys sorted."""
        body = to_dict(self) | {"format": FORMAT, "format_version": FORMAT_VERSION}
        return json.dumps(body, sort_keys=True)

    @classmethod
    def from_json(cls, text: str, *, origin: str) -> Manifest:
        """Parse; ``origin`` names the file in errors. Unknown keys and other formats are refused."""
        try:
            body = json.loads(text)
        except json.JSONDecodeError as error:
            raise InvalidFile(f"{origin}: the unghost manifest is not JSON ({error})") from None
        if not isinstance(body, dict) or body.pop("format", None) != FORMAT:
            raise InvalidFile(f"{origin}: not an unghost denoiser (format must be {FORMAT!r})")
        version = body.pop("format_version", None)
        if version != FORMAT_VERSION:
            raise InvalidFile(f"{origin}: manifest version {version!r}, this release reads {FORMAT_VERSION}")
        return from_dict(cls, body, caller=origin, what="manifest keys")


class Denoiser(Protocol):
    """``(channels (N, C, R, R, R), timestep (N,) or int, edge_fraction (N,) or float) -> x0_pred (N, 1, R, R, R)``.

    ``kind`` says what it takes and gives: ``"numpy"`` arrays or ``"torch"`` tensors.
    """

    manifest: Manifest
    kind: str

    def __call__(self, channels: Any, timestep: Any, edge_fraction: Any) -> Any:
        """Denoise; scalars broadcast over the batch."""
