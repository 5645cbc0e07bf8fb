import numpy as np
import pytest

from unghost import load_denoiser
from unghost.denoisers import WEIGHTS, shipped_names

needs_weights = pytest.mark.skipif(not (WEIGHTS / "default.onnx").is_file(), reason="no weights in this checkout yet")


@pytest.mark.parametrize(
    ("name", "backend", "error", "words"),
    [
        ("absent", None, FileNotFoundError, "no file absent.onnx for 'absent'; shipped names: "),
        ("absent", "torch", FileNotFoundError, r"absent\.safetensors"),
        (
            "m",
            None,
            FileNotFoundError,
            r"no file m\.onnx for 'm' \(no longer shipped: 'default' replaces it\); shipped names: ",
        ),
        ("m", "torch", FileNotFoundError, r"m\.safetensors for 'm' \(no longer shipped: 'default' replaces it\)"),
        ("x/absent.onnx", None, FileNotFoundError, r"x/absent\.onnx"),
        ("default", "jax", ValueError, r"backend must be one of \['onnx', 'torch'\], got 'jax'"),
        ("a.onnx", "torch", ValueError, r"backend 'torch' reads \.safetensors files, got a\.onnx"),
    ],
)
def test_refusals(name, backend, error, words):
    with pytest.raises(error, match=words):
        load_denoiser(name, backend=backend)


@pytest.mark.parametrize("suffix", [".onnx", ".safetensors"])
@pytest.mark.parametrize("content", [b"", b"not a model at all", bytes(1000)])
def test_foreign_files_are_refused_by_name(tmp_path, suffix, content):
    path = tmp_path / f"foreign{suffix}"
    path.write_bytes(content)
    with pytest.raises(ValueError, match="foreign"):
        load_denoiser(path)


@needs_weights
def test_the_shipped_denoiser_by_both_engines():
    import torch

    assert "default" in shipped_names()
    light, full = load_denoiser(threads=1), load_denoiser(backend="torch")
    assert (light.kind, full.kind) == ("numpy", "torch")
    assert light.manifest.channels == full.manifest.channels == ("signed_opacity",)
    assert light.manifest.removal_threshold == full.manifest.removal_threshold
    empty = np.full((2, 1, 32, 32, 32), -1.0, dtype=np.float32)
    ours = light(empty, light.manifest.default_timestep, 0.1)
    theirs = full(torch.from_numpy(empty), full.manifest.default_timestep, 0.1)
    np.testing.assert_allclose(ours, theirs.numpy(), atol=1e-4)
    assert (ours < 0).mean() > 0.999  # empty stays empty


@needs_weights
def test_what_is_not_given_is_unknown():
    import torch

    light, full = load_denoiser("views", threads=1), load_denoiser("views", backend="torch")
    assert light.manifest.channels == full.manifest.channels == ("signed_opacity", "view_count")
    cubes = np.random.default_rng(0).uniform(-1, 1, (2, 1, 32, 32, 32)).astype(np.float32)
    told = np.concatenate([cubes, np.full_like(cubes, -1.0)], axis=1)
    np.testing.assert_array_equal(light(told, 900, 0.1), light(cubes, 900, 0.1))
    np.testing.assert_array_equal(full(torch.from_numpy(told), 900, 0.1), full(torch.from_numpy(cubes), 900, 0.1))
    np.testing.assert_allclose(light(cubes, 900, 0.1), full(torch.from_numpy(cubes), 900, 0.1), atol=1e-4)


@needs_weights
def test_the_shipped_files_are_small():
    for suffix in (".onnx", ".safetensors"):
        assert (WEIGHTS / f"default{suffix}").stat().st_size <= 4_000_000
