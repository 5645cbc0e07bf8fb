"""Smaller and faster forms of an exported denoiser: fp16 weights, and static int8.

``fp16`` stores the weights in half precision, each behind a ``Cast`` that onnxruntime folds while it loads: half the
file, the speed and the activations of fp32. (Computing in half precision too was measured: onnxruntime's CPU provider
has no such convolutions and casts around each of them, 0.85 times as fast as fp32 for the same scores.)

``int8`` quantises from the first convolution to the last but one: weights per output channel and symmetric, activations
per tensor, ranges from calibration cubes. In float32 stay the last convolution and what leads to it alone (in int8 too
they cost .011 of the IoU of procedural cubes, and cost nothing of it so, at .95 of the speed), the shortcut from the
input to the output, the conditioning, the transposed convolutions (onnxruntime has none in int8) and the final
``Tanh``. Weights use seven of their eight bits: processors without VNNI add pairs of products in saturating 16-bit
arithmetic, and eight would give other numbers there.
"""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...core.errors import InvalidArgument, needs_extra
from ...core.manifest import Manifest
from ...core.schedule import TIMESTEPS
from ..container import PRECISIONS, body_of, precision_of, unseal, write_sealed
from ..runtime import read_file, read_manifest
from .parity import ParityInputs, check_inputs, compare, parity_inputs, session_denoiser

QUANTISED = ("Conv", "Add", "LeakyRelu", "Relu", "Pad", "Gather", "Reshape")  # operators that int8 may run through
MOVING = ("Pad", "Gather", "Reshape")  # of these, the ones that only move values
HALF_LEAST = 64  # smaller tensors stay float32: nothing to gain
CALIBRATION_BATCH = 8
PRE_PROCESSED = ("onnx.quant.pre_process", "onnxruntime.quant")  # onnxruntime's mark for a model that needs no tidying


def half_precision_body(body: bytes) -> bytes:
    """The model with its float32 weights stored as float16 and cast back where they are used.

    Raises:
        ValueError: a weight that float16 cannot hold (magnitude over 65504).
    """
    import onnx

    model = onnx.ModelProto.FromString(body)
    casts = []
    for item in model.graph.initializer:
        values = onnx.numpy_helper.to_array(item)
        if values.dtype != np.float32 or values.size < HALF_LEAST:
            continue
        worst = float(np.abs(values).max())
        if not worst <= float(np.finfo(np.float16).max):
            raise InvalidArgument(f"half_precision_body: {item.name} holds {worst:.3g}, float16 ends at 65504")
        name = item.name
        item.CopyFrom(onnx.numpy_helper.from_array(values.astype(np.float16), f"{name}_half"))
        casts.append(onnx.helper.make_node("Cast", [f"{name}_half"], [name], name=f"{name}_cast", to=1))
    nodes = [*casts, *model.graph.node]
    del model.graph.node[:]
    model.graph.node.extend(nodes)
    onnx.checker.check_model(model, full_check=True)
    return bytes(model.SerializeToString(deterministic=True))


def calibration_inputs(channels: Any, edge_fraction: Any, *, default_timestep: int) -> ParityInputs:
    """Inputs for :func:`int8_body`: every other cube at the model's own timestep, the rest spread over all of them.

    Args:
        channels: ``(N, C, 32, 32, 32)`` in [-1, 1], of the kind that the denoiser will meet.
        edge_fraction: ``(N,)`` > 0.
        default_timestep: of the manifest.

    Raises:
        ValueError: as :func:`.parity.check_inputs`.
    """
    count = len(channels)
    spread = np.linspace(0, TIMESTEPS - 1, count).round()
    times = np.where(np.arange(count) % 2, default_timestep, spread).astype(np.int64)
    inputs = ParityInputs(np.asarray(channels, np.float32), times, np.asarray(edge_fraction, np.float32))
    check_inputs(inputs, caller="calibration_inputs")
    return inputs


class _Reader:
    """Calibration batches, as onnxruntime asks for them."""

    def __init__(self, inputs: ParityInputs) -> None:
        self._feeds = self._cut(inputs)

    @staticmethod
    def _cut(inputs: ParityInputs) -> Iterator[dict[str, Any]]:
        for start in range(0, len(inputs.channels), CALIBRATION_BATCH):
            part = slice(start, start + CALIBRATION_BATCH)
            yield {name: np.ascontiguousarray(value[part]) for name, value in vars(inputs).items()}

    def get_next(self) -> dict[str, Any] | None:
        return next(self._feeds, None)


def _quantised_nodes(model: Any) -> list[str]:
    """Names of the nodes from the first convolution to the last but one, and what moves the values into the first."""
    nodes = list(model.graph.node)
    producer = {output: index for index, node in enumerate(nodes) for output in node.output}
    inputs = [[producer[name] for name in node.input if name in producer] for node in nodes]
    convolutions = {index for index, node in enumerate(nodes) if node.op_type == "Conv"}

    def ancestors(found: set[int]) -> set[int]:
        """All that ``found`` is computed from; nodes are in topological order."""
        above: set[int] = set()
        for index in reversed(range(len(nodes))):
            if index in found or index in above:
                above |= set(inputs[index])
        return above

    kept = convolutions & ancestors(convolutions)  # one that no other depends on gives the output: float
    before, after = kept | ancestors(kept), set(kept)
    for index in range(len(nodes)):
        if after & set(inputs[index]):
            after.add(index)
    chosen = before & after
    for index in reversed(range(len(nodes))):
        if index in chosen:
            chosen |= {source for source in inputs[index] if nodes[source].op_type in MOVING}
    return [nodes[index].name for index in sorted(chosen) if nodes[index].op_type in QUANTISED]


def int8_body(body: bytes, calibration: ParityInputs) -> bytes:
    """The model in static int8 (QDQ form), activation ranges from ``calibration``.

    Raises:
        ImportError: onnx is missing.
        ValueError: calibration inputs of wrong shapes, or a model of less than two convolutions.
    """
    import onnx
    from onnxruntime.quantization import QuantFormat, QuantType, quantize_static

    check_inputs(calibration, caller="int8_body")
    model = onnx.ModelProto.FromString(body)
    chosen = _quantised_nodes(model)
    if not chosen:
        raise InvalidArgument("int8_body: the model has no convolution to quantise (the last one stays in float32)")
    names = {value.name for value in model.graph.input}
    if names != set(vars(calibration)):
        raise InvalidArgument(
            f"int8_body: the model's inputs are {sorted(names)}, expected {sorted(vars(calibration))}"
        )
    onnx.helper.set_model_props(model, dict([PRE_PROCESSED]))
    with tempfile.TemporaryDirectory(prefix="unghost.") as folder:
        written = Path(folder) / "int8.onnx"
        quantize_static(
            model,
            written,
            _Reader(calibration),
            quant_format=QuantFormat.QDQ,
            per_channel=True,
            reduce_range=True,
            op_types_to_quantize=list(QUANTISED),
            nodes_to_quantize=chosen,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
        )
        quantised = onnx.load(written)
    quantised.ClearField("metadata_props")
    quantised.producer_name, quantised.producer_version = "unghost", ""
    del quantised.graph.value_info[:]
    onnx.checker.check_model(quantised, full_check=True)
    return bytes(quantised.SerializeToString(deterministic=True))


def body_in(precision: str, body: bytes, calibration: ParityInputs | None) -> bytes:
    """The float32 ``body`` in another precision; ``calibration`` is for int8 alone.

    Raises:
        ValueError: an unknown precision, or int8 without calibration inputs.
    """
    if precision not in PRECISIONS:
        raise InvalidArgument(f"body_in: precision must be one of {', '.join(PRECISIONS)}, got {precision!r}")
    if precision == "fp32":
        return body
    if precision == "fp16":
        return half_precision_body(body)
    if calibration is None:
        raise InvalidArgument("body_in: int8 needs calibration inputs")
    return int8_body(body, calibration)


def in_precision(manifest: Manifest, precision: str, facts: dict[str, Any]) -> Manifest:
    """The manifest of a file in another precision: ``training["export"]`` says which, and how it was made."""
    if precision == "fp32":
        return manifest
    return dataclasses.replace(manifest, training=manifest.training | {"export": {"precision": precision, **facts}})


def convert_onnx(
    onnx_path: str | Path,
    out_path: str | Path,
    *,
    precision: str,
    calibration: ParityInputs | None = None,
    source: str = "",
    verify_cubes: int = 0,
) -> Manifest:
    """Write an exported float32 file in another precision.

    Args:
        onnx_path: of :func:`.to_onnx.export_onnx`, in fp32.
        out_path: written whole or not at all.
        precision: ``"fp16"`` or ``"int8"`` (``"fp32"`` copies).
        calibration: inputs like those that the denoiser will meet; int8 alone needs them, some dozens suffice.
        source: what the calibration inputs are, for the manifest.
        verify_cubes: cubes to compare with the float32 file; 0 to skip. A file out of tolerance is not written.

    Returns:
        The manifest in the file: ``training["export"]`` holds ``precision``, the hash of the float32 body
        (``fp32_sha256``) and for int8 ``calibration`` and ``calibration_cubes``.

    Raises:
        ImportError: onnx is missing.
        ValueError: a foreign or damaged file, one not in fp32, or a result out of tolerance.
    """
    data = read_file(onnx_path)
    manifest = unseal(data, origin=str(onnx_path))
    if precision_of(manifest) != "fp32":
        raise InvalidArgument(f"convert_onnx: {onnx_path} is {precision_of(manifest)} already, an fp32 file is needed")
    body = body_of(data, manifest)
    with needs_extra("export", caller="convert_onnx"):
        converted = body_in(precision, body, calibration)
    facts: dict[str, Any] = {"fp32_sha256": manifest.body_sha256}
    if precision == "int8" and calibration is not None:
        facts |= {"calibration": source, "calibration_cubes": len(calibration.channels)}
    stated = in_precision(manifest, precision, facts)
    if verify_cubes:
        inputs = parity_inputs(verify_cubes, 0, channels=manifest.channels)
        report = compare(session_denoiser(converted, stated), session_denoiser(body, manifest), inputs)
        if not report["passed"]:
            raise InvalidArgument(f"convert_onnx: {precision} is too far from fp32: {report}")
    write_sealed(out_path, converted, stated)
    return read_manifest(out_path)


def export_precisions(
    checkpoint_path: str | Path,
    folder: str | Path,
    *,
    precisions: Sequence[str] = PRECISIONS,
    calibration: ParityInputs | None = None,
    source: str = "",
    verify_cubes: int = 8,
) -> dict[str, Path]:
    """Write a checkpoint, or its fp32 export, as ``NAME.onnx``, ``NAME.fp16.onnx`` and ``NAME.int8.onnx``.

    Args:
        checkpoint_path: ``NAME.safetensors``, or ``NAME.onnx`` in fp32.
        folder: for the files.
        precisions: which.
        calibration, source, verify_cubes: see :func:`convert_onnx`.

    Returns:
        The files by precision, in the order asked for.

    Raises:
        ImportError, ValueError: as :func:`.to_onnx.export_onnx` and :func:`convert_onnx`.
    """
    from .to_onnx import export_onnx

    unknown = [name for name in precisions if name not in PRECISIONS]
    if unknown or not precisions:
        raise InvalidArgument(f"export_precisions: precisions must be among {', '.join(PRECISIONS)}, got {precisions}")
    if "int8" in precisions and calibration is None:
        raise InvalidArgument("export_precisions: int8 needs calibration inputs")
    origin, target = Path(checkpoint_path), Path(folder)
    files = {
        name: target / (f"{origin.stem}.onnx" if name == "fp32" else f"{origin.stem}.{name}.onnx")
        for name in precisions
    }
    with tempfile.TemporaryDirectory(prefix="unghost.") as scratch:
        if origin.suffix == ".onnx":
            plain = origin
        else:
            plain = files.get("fp32", Path(scratch) / "fp32.onnx")
            export_onnx(origin, plain, verify_cubes=verify_cubes)
        for name, path in files.items():
            if path != plain:
                convert_onnx(
                    plain, path, precision=name, calibration=calibration, source=source, verify_cubes=verify_cubes
                )
    return files
