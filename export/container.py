"""Our ONNX files: a model body, then its manifest as the file's last field.

Protobuf messages concatenate: an ONNX model followed by one ``metadata_props`` entry is the same model with
that entry. So the body is hashed as bytes, the manifest that holds the hash follows it, and a reader
needs no ONNX parser to tell a whole file from a truncated or altered one. The entry ends the file:

    body | 0x72 | varint(length) | 0x0A varint(len key) key | 0x12 varint(len value) value
"""

from __future__ import annotations

import dataclasses
import hashlib
from pathlib import Path

from ..core.errors import InvalidArgument, InvalidFile
from ..core.io import write_bytes
from ..core.manifest import METADATA_KEY, Manifest

PRECISIONS = ("fp32", "fp16", "int8")
METADATA_TAG, KEY_TAG, VALUE_TAG = b"\x72", b"\x0a", b"\x12"  # fields 14, 1 and 2, length-delimited


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes(out) + bytes([value])


def _read_varint(data: bytes, at: int) -> tuple[int, int]:
    """Value and the position after it; IndexError past the end."""
    value = shift = 0
    while True:
        byte = data[at]
        value |= (byte & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if byte < 0x80:
            return value, at


def _entry_head(value_bytes: int) -> bytes:
    """Everything of the entry that stands before the value."""
    key = METADATA_KEY.encode()
    inner = KEY_TAG + _varint(len(key)) + key + VALUE_TAG + _varint(value_bytes)
    return METADATA_TAG + _varint(len(inner) + value_bytes) + inner


def seal(body: bytes, manifest: Manifest) -> bytes:
    """The whole file: ``body``, then ``manifest`` with the body's length and SHA-256 filled in."""
    digest = hashlib.sha256(body).hexdigest()
    value = dataclasses.replace(manifest, body_bytes=len(body), body_sha256=digest).to_json().encode()
    return body + _entry_head(len(value)) + value


def write_sealed(path: str | Path, body: bytes, manifest: Manifest) -> None:
    """Write :func:`seal` to a file, whole or not at all."""
    write_bytes(path, seal(body, manifest), fsync=True)


def unseal(data: bytes, *, origin: str) -> Manifest:
    """Check a whole file and return its manifest; ``origin`` names it in errors.

    Raises:
        ValueError: no manifest at the end (foreign or truncated), or a body that its hash does not match.
    """
    marker = KEY_TAG + _varint(len(METADATA_KEY)) + METADATA_KEY.encode() + VALUE_TAG
    at = data.rfind(marker)
    if at < 0:
        raise InvalidFile(
            f"{origin}: no {METADATA_KEY!r} entry: not an unghost ONNX model, or truncated ({len(data)} bytes)"
        )
    try:
        length, start = _read_varint(data, at + len(marker))
    except IndexError:
        raise InvalidFile(f"{origin}: truncated inside its manifest ({len(data)} bytes)") from None
    if start + length != len(data):
        what = "truncated inside its manifest" if start + length > len(data) else "bytes follow its manifest"
        raise InvalidFile(f"{origin}: {what} ({len(data)} bytes, {start + length} expected)")
    try:
        text = data[start:].decode("utf-8")
    except UnicodeDecodeError as error:
        raise InvalidFile(f"{origin}: its manifest is not UTF-8 ({error})") from None
    manifest = Manifest.from_json(text, origin=origin)
    body = data[: manifest.body_bytes]
    if data[len(body) : start] != _entry_head(length):
        raise InvalidFile(
            f"{origin}: its body has {start - len(_entry_head(length))} bytes, its manifest says {manifest.body_bytes}"
        )
    if hashlib.sha256(body).hexdigest() != manifest.body_sha256:
        raise InvalidFile(f"{origin}: the body does not match the SHA-256 in its manifest: altered or damaged")
    return manifest


def body_of(data: bytes, manifest: Manifest) -> bytes:
    """The model body of a whole file whose manifest :func:`unseal` gave."""
    return data[: manifest.body_bytes]


def precision_of(manifest: Manifest) -> str:
    """``"fp32"``, ``"fp16"`` or ``"int8"``: what ``training["export"]["precision"]`` says, fp32 where nothing does.

    Raises:
        ValueError: another precision.
    """
    export = manifest.training.get("export")
    precision = export.get("precision") if isinstance(export, dict) else "fp32"
    if precision not in PRECISIONS:
        raise InvalidArgument(f"{manifest.name}: precision must be one of {', '.join(PRECISIONS)}, got {precision!r}")
    return str(precision)
