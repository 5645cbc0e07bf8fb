"""Trained checkpoints of the two public "nerf-pytorch" programs as density fields. torch.

Read are the checkpoints of krrish94/nerf-pytorch (``FlexibleNeRFModel``) and of yenchenlin/nerf-pytorch (``NeRF``).
The shapes in the file say what the network is; of the configuration beside it only the coordinates count.
"""

from __future__ import annotations

import re
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from ...core.errors import InvalidArgument, InvalidFile, MissingFile

MOST_BYTES = 1 << 28  # of a checkpoint, unpacked; the usual one has 13 million
CHUNK = 1 << 15  # positions that pass through the network at once
WORLD_HALF_SIDE = 1.5  # the box in which the synthetic scenes of these programs lie

_STATES = {
    "fine": ("model_fine_state_dict", "network_fine_state_dict"),
    "coarse": ("model_coarse_state_dict", "network_fn_state_dict"),
}


class NerfPytorchField(nn.Module):
    """A frozen NeRF: density, and colour for pictures.

    Attributes:
        ndc: whether positions are normalised device coordinates. If so, a cube is a frustum in the world, and a
            density is per unit of NDC length, as the program renders it; :func:`ndc_from_world` says where a point is.
        bands: ``(B,)`` angular frequencies of the encoding.
        with_position: whether the encoding starts with the position itself.
    """

    bands: Tensor

    def __init__(self, state: Mapping[str, Tensor], *, ndc: bool, log_sampling: bool = True) -> None:
        super().__init__()
        self.ndc = ndc
        self._first = "layer1" if "layer1.weight" in state else "pts_linears.0"
        self._names = _trunk(state, self._first)
        for name in {key.rsplit(".", 1)[0] for key in state}:
            self._parameters_of(name, state)
        channels = state[f"{self._first}.weight"].shape[1]
        self.with_position, count = channels % 6 == 3, channels // 6
        self.register_buffer("bands", _bands(count, log_sampling))

    def _parameters_of(self, name: str, state: Mapping[str, Tensor]) -> None:
        weight, bias = state[f"{name}.weight"], state[f"{name}.bias"]
        linear = nn.Linear(weight.shape[1], weight.shape[0])
        linear.weight = nn.Parameter(weight.detach().float().clone(), requires_grad=False)
        linear.bias = nn.Parameter(bias.detach().float().clone(), requires_grad=False)
        self.add_module(name.replace(".", "_"), linear)

    @property
    def aabb(self) -> NDArray[np.float64]:
        """``(2, 3)``: [-1.5, 1.5]^3 of a world, [-1, 1]^3 (what the middle camera sees) of an NDC scene."""
        half = 1.0 if self.ndc else WORLD_HALF_SIDE
        return np.array([[-half] * 3, [half] * 3])

    def density_fn(self, positions: Tensor) -> Tensor:
        """Density ``(..., 1)``, >= 0, at ``positions (..., 3)``, everywhere what the network says.

        Per unit of the positions' coordinates. Positions that are not finite give NaN.
        """
        flat = positions.reshape(-1, 3)
        parts = [torch.relu(self._density(self._hidden(part))) for part in torch.split(flat, CHUNK)]
        return torch.cat(parts).reshape(*positions.shape[:-1], 1)

    def forward(self, positions: Tensor) -> Tensor:
        """:meth:`density_fn`: the field is its own density callable."""
        return self.density_fn(positions)

    def color(self, positions: Tensor, directions: Tensor) -> Tensor:
        """RGB ``(N, 3)`` in (0, 1) at ``positions (N, 3)`` seen along unit ``directions (N, 3)`` of the world."""
        parts = [
            torch.sigmoid(self._rgb(self._hidden(place), toward))
            for place, toward in zip(torch.split(positions, CHUNK), torch.split(directions, CHUNK))
        ]
        return torch.cat(parts)

    def _apply_layer(self, name: str, values: Tensor) -> Tensor:
        layer: nn.Module = getattr(self, name.replace(".", "_"))
        result: Tensor = layer(values)
        return result

    def _encode(self, vectors: Tensor, bands: Tensor, with_input: bool) -> Tensor:
        angles = vectors.float()[:, None, :] * bands[:, None]
        waves = torch.stack([angles.sin(), angles.cos()], dim=2).flatten(1)
        return torch.cat([vectors.float(), waves], dim=1) if with_input else waves

    def _hidden(self, positions: Tensor) -> Tensor:
        encoded = self._encode(positions, self.bands, self.with_position)
        theirs = self._first == "pts_linears.0"
        hidden = self._apply_layer(self._first, encoded)
        if theirs:  # the other program has no activation here
            hidden = torch.relu(hidden)
        for name, joined in self._names:
            if joined:
                hidden = torch.cat([encoded, hidden] if theirs else [hidden, encoded], dim=1)
            hidden = torch.relu(self._apply_layer(name, hidden))
        return hidden

    def _density(self, hidden: Tensor) -> Tensor:
        for name in ("fc_alpha", "alpha_linear"):
            if hasattr(self, name):
                return self._apply_layer(name, hidden)
        return self._apply_layer("fc_out" if hasattr(self, "fc_out") else "output_linear", hidden)[:, 3:4]

    def _rgb(self, hidden: Tensor, directions: Tensor) -> Tensor:
        if hasattr(self, "fc_alpha"):
            feature, last, head = torch.relu(self._apply_layer("fc_feat", hidden)), "layers_dir.0", "fc_rgb"
        elif hasattr(self, "alpha_linear"):
            feature, last, head = self._apply_layer("feature_linear", hidden), "views_linears.0", "rgb_linear"
        else:
            return self._apply_layer("fc_out" if hasattr(self, "fc_out") else "output_linear", hidden)[:, :3]
        width = getattr(self, last.replace(".", "_")).in_features - feature.shape[1]
        seen = self._encode(directions, _bands(width // 6, True).to(hidden.device), width % 6 == 3)
        return self._apply_layer(head, torch.relu(self._apply_layer(last, torch.cat([feature, seen], dim=1))))


def _bands(count: int, log_sampling: bool) -> Tensor:
    steps = torch.arange(count, dtype=torch.float32)
    return 2.0**steps if log_sampling else torch.linspace(1.0, 2.0 ** max(count - 1, 0), count)


def _trunk(state: Mapping[str, Tensor], first: str) -> list[tuple[str, bool]]:
    """The layers after the first, and whether each one is given the encoding again. Checks every shape."""
    if f"{first}.weight" not in state:
        raise InvalidFile("it has neither layer1 nor pts_linears.0")
    hidden, channels = _shape(state, first)
    if channels % 6 not in (0, 3) or channels < 3:
        raise InvalidFile(f"{first} reads {channels} channels, which is no encoding of a position")
    stem, start = ("layers_xyz", 0) if first == "layer1" else ("pts_linears", 1)
    layers = []
    index = start
    while f"{stem}.{index}.weight" in state:
        out, read = _shape(state, f"{stem}.{index}")
        if out != hidden or read not in (hidden, hidden + channels):
            raise InvalidFile(f"{stem}.{index} is {(out, read)} after a layer of {hidden} and {channels} channels")
        layers.append((f"{stem}.{index}", read != hidden))
        index += 1
    _check_heads(state, hidden, "fc" if first == "layer1" else "linear")
    return layers


def _check_heads(state: Mapping[str, Tensor], hidden: int, kind: str) -> None:
    alpha, feature, view, rgb, out = (
        ("fc_alpha", "fc_feat", "layers_dir.0", "fc_rgb", "fc_out")
        if kind == "fc"
        else ("alpha_linear", "feature_linear", "views_linears.0", "rgb_linear", "output_linear")
    )
    if f"{alpha}.weight" not in state:
        if _shape(state, out) not in ((4, hidden), (5, hidden)):
            raise InvalidFile(f"{out} is {_shape(state, out)} after a layer of {hidden}")
        return
    width, read = _shape(state, view)
    rules = {alpha: (1, hidden), feature: (hidden, hidden), rgb: (3, width)}
    for name, due in rules.items():
        if _shape(state, name) != due:
            raise InvalidFile(f"{name} is {_shape(state, name)}, must be {due}")
    if read < hidden or (read - hidden) % 6 not in (0, 3):
        raise InvalidFile(f"{view} reads {read - hidden} channels of a direction")


def _shape(state: Mapping[str, Tensor], name: str) -> tuple[int, int]:
    weight, bias = state.get(f"{name}.weight"), state.get(f"{name}.bias")
    if weight is None or bias is None or weight.ndim != 2 or bias.shape != weight.shape[:1] or 0 in weight.shape:
        raise InvalidFile(f"layer {name} is missing or has no (out, in) weight with its (out,) bias")
    return int(weight.shape[0]), int(weight.shape[1])


def _state(path: Path, network: str) -> dict[str, Tensor]:
    """The chosen network's tensors, nothing of the file executed."""
    unpacked = path.stat().st_size
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            unpacked = max(unpacked, sum(entry.file_size for entry in archive.infolist()))
    if unpacked > MOST_BYTES:
        raise InvalidFile(f"it has {unpacked} bytes, more than {MOST_BYTES}")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises half a dozen kinds for a file that is not its own
        raise InvalidFile(f"torch cannot read it ({str(error).splitlines()[0] if str(error) else error!r})") from None
    names = _STATES[network]
    found = content if isinstance(content, Mapping) else {}
    state = next((found[name] for name in names if found.get(name) is not None), None)
    if not isinstance(state, Mapping) or not state:
        raise InvalidFile(f"it holds no {' or '.join(names)}")
    tensors = {str(key).removeprefix("module."): value for key, value in state.items()}
    for key, value in tensors.items():
        if not (isinstance(value, Tensor) and value.is_floating_point() and key.endswith((".weight", ".bias"))):
            raise InvalidFile(f"{key} of {names[0]} is not a layer's weight or bias")
        if not bool(torch.isfinite(value).all()):
            raise InvalidFile(f"{key} holds values that are not finite")
    return tensors


def _configured(path: Path, key: str) -> bool | None:
    """The last ``key: true|false`` (or ``key = True``) of the configuration beside a checkpoint, None if unsaid."""
    for name in ("config.yml", "config.txt"):
        config = path.with_name(name)
        if config.is_file():
            text = config.read_text(encoding="utf-8", errors="replace")[: 1 << 16]
            found = re.findall(rf"^\s*{key}\s*[:=]\s*(true|false)\s*(?:#.*)?$", text, re.IGNORECASE | re.MULTILINE)
            return found[-1].lower() == "true" if found else None
    return None


def load_nerf_pytorch(
    path: str | Path, *, network: Literal["fine", "coarse"] = "fine", ndc: bool | None = None
) -> NerfPytorchField:
    """Read a checkpoint; nothing in it is executed.

    Args:
        path: the ``.ckpt`` or ``.tar`` file.
        network: which of the two.
        ndc: whether it was trained in normalised device coordinates. The checkpoint does not know; None asks
            the ``config.yml`` or ``config.txt`` beside it (``no_ndc``).

    Raises:
        FileNotFoundError: no such file.
        ValueError: a foreign, malformed or oversized file, values that are not finite, or nothing says which
            coordinates it was trained in.

    Example:
        >>> field = load_nerf_pytorch("lego-lowres/checkpoint199999.ckpt")  # doctest: +SKIP
        >>> mask = clean(field.density_fn, field.aabb)  # doctest: +SKIP
    """
    source = Path(path)
    if network not in _STATES:
        raise InvalidArgument(f"load_nerf_pytorch: network must be one of {', '.join(_STATES)}, got {network!r}")
    if not source.is_file():
        raise MissingFile(f"load_nerf_pytorch: no file {source}")
    if ndc is None:
        no_ndc = _configured(source, "no_ndc")
        if no_ndc is None:
            raise InvalidArgument(
                f"load_nerf_pytorch: no config.yml or config.txt beside {source} says no_ndc: pass ndc=True if it was "
                "trained in normalised device coordinates (forward-facing captures), else ndc=False"
            )
        ndc = not no_ndc
    try:
        state = _state(source, network)
        return NerfPytorchField(state, ndc=ndc, log_sampling=_configured(source, "log_sampling_xyz") is not False)
    except ValueError as error:
        raise InvalidFile(f"load_nerf_pytorch: {source} is not a checkpoint of nerf-pytorch: {error}") from None


def ndc_from_world(
    positions: NDArray[Any], *, focal: float, width: int, height: int, near: float = 1.0
) -> NDArray[np.float64]:
    """Normalised device coordinates ``(..., 3)`` of ``positions (..., 3)`` before a camera (NeRF, appendix C).

    Args:
        positions: in the middle camera's coordinates (OpenGL: it looks along -Z), in the units of ``near``; z < 0.
        focal, width, height: of the photos, pixels.
        near: distance of the near plane, which becomes z = -1; what is infinitely far becomes z = 1.

    Raises:
        ValueError: a position that is not before the camera.

    Example:
        >>> positions = np.array([[0.5, 0.0, -1.0], [0.0, 0.0, -1e9]])
        >>> ndc_from_world(positions, focal=8.0, width=16, height=12).round(3).tolist()
        [[0.5, 0.0, -1.0], [0.0, 0.0, 1.0]]
    """
    points = np.asarray(positions, dtype=np.float64)
    x, y, z = np.moveaxis(points, -1, 0)
    if not (z < 0).all():
        raise InvalidArgument(f"ndc_from_world: positions must have z < 0 (before the camera), got z = {np.max(z)}")
    return np.stack([-2.0 * focal / width * x / z, -2.0 * focal / height * y / z, 1.0 + 2.0 * near / z], axis=-1)
