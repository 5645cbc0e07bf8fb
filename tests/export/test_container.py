import contextlib
import hashlib

import onnx
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from unghost.core.manifest import METADATA_KEY, Manifest
from unghost.export.container import seal, unseal, write_sealed

MANIFEST = Manifest(name="test", training={"note": "ä"})


@settings(max_examples=50, deadline=None)
@given(st.binary(max_size=400), st.text(max_size=200))
def test_round_trip(body, note):
    manifest = Manifest(name="n", training={"note": note})
    found = unseal(seal(body, manifest), origin="here")
    assert (found.name, found.training) == (manifest.name, manifest.training)
    assert found.body_bytes == len(body)
    assert found.body_sha256 == hashlib.sha256(body).hexdigest()


@settings(max_examples=200, deadline=None)
@given(st.data())
def test_any_changed_byte_is_noticed(data):
    whole = seal(bytes(range(256)), MANIFEST)
    at = data.draw(st.integers(0, len(whole) - 1))
    value = data.draw(st.integers(0, 255).filter(lambda v: v != whole[at]))
    changed = whole[:at] + bytes([value]) + whole[at + 1 :]
    if at < 256:
        with pytest.raises(ValueError, match="here: the body does not match"):
            unseal(changed, origin="here")
        return
    with contextlib.suppress(ValueError):  # a letter of the manifest's free text may pass: the body is protected
        assert unseal(changed, origin="here").body_sha256 == hashlib.sha256(whole[:256]).hexdigest()


def test_every_truncation_is_noticed():
    whole = seal(b"body of the model", MANIFEST)
    for length in range(len(whole)):
        with pytest.raises(ValueError, match="here: "):
            unseal(whole[:length], origin="here")


def test_what_is_wrong_is_said():
    whole = seal(b"body of the model", MANIFEST)
    for data, message in (
        (b"", "no 'unghost_manifest' entry: not an unghost ONNX model, or truncated \\(0 bytes\\)"),
        (whole[:-1], "truncated inside its manifest"),
        (whole + b"!", "bytes follow its manifest"),
        (b"B" + whole[1:], "does not match the SHA-256"),
        (b"+" + whole, "its body has 18 bytes, its manifest says 17"),
        (whole[1:], "manifest says 17"),
    ):
        with pytest.raises(ValueError, match=message):
            unseal(data, origin="here")


def test_onnx_reads_the_entry_and_the_same_model():
    node = onnx.helper.make_node("Relu", ["a"], ["b"])
    values = [onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, ["N"]) for name in "ab"]
    body = onnx.helper.make_model(onnx.helper.make_graph([node], "g", values[:1], values[1:])).SerializeToString()
    whole = seal(body, MANIFEST)
    model = onnx.load_model_from_string(whole)
    assert {item.key: Manifest.from_json(item.value, origin="x").name for item in model.metadata_props} == {
        METADATA_KEY: "test"
    }
    assert model.SerializeToString() == whole  # the entry is where onnx itself would put it
    model.ClearField("metadata_props")
    assert model.SerializeToString() == body


def test_writing_leaves_nothing_else(tmp_path):
    write_sealed(tmp_path / "deep" / "model.onnx", b"body", MANIFEST)
    assert [item.name for item in (tmp_path / "deep").iterdir()] == ["model.onnx"]
    assert unseal((tmp_path / "deep" / "model.onnx").read_bytes(), origin="f").body_bytes == 4
