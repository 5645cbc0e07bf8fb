import json

import pytest

from unghost.core.manifest import Manifest

GOLDEN = (
    '{"body_bytes": 0, "body_sha256": "", "channels": ["signed_opacity"], "default_timestep": 900, '
    '"family": "restoration", "format": "unghost-denoiser", "format_version": 1, "name": "m", "parameters": 0, '
    '"removal_threshold": 0.0, "resolution": 32, "training": {}}'
)


def test_golden_text_and_round_trip():
    assert Manifest("m").to_json() == GOLDEN
    full = Manifest("n", channels=("signed_opacity", "view_count"), removal_threshold=-0.3, training={"seed": 1})
    assert Manifest.from_json(full.to_json(), origin="x") == full


def changed(**entries):
    return json.dumps(json.loads(GOLDEN) | entries)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{", "file.onnx: the unghost manifest is not JSON"),
        ("[]", "file.onnx: not an unghost denoiser"),
        (changed(format="other"), "not an unghost denoiser"),
        (changed(format_version=2), "manifest version 2, this release reads 1"),
        (changed(surprise=1), r"unknown manifest keys \['surprise'\]"),
        (changed(channels=["view_count"]), "channels must start with 'signed_opacity'"),
        (changed(channels=["signed_opacity", "color"]), "channels must start with"),
        (changed(channels=[]), "channels must start with"),
        (changed(default_timestep=1000), r"default_timestep must lie in \[0, 1000\), got 1000"),
        (changed(removal_threshold=1.5), r"removal_threshold must lie in \[-1, 1\], got 1.5"),
        ('{"format": "unghost-denoiser", "format_version": 1}', "file.onnx: .*name"),
    ],
)
def test_refusals(text, words):
    with pytest.raises(ValueError, match=words):
        Manifest.from_json(text, origin="file.onnx")
