import dataclasses
import math
import subprocess
import sys
import textwrap

import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from unghost.core.manifest import Manifest
from unghost.export.container import PRECISIONS, write_sealed
from unghost.export.onnx.parity import TOLERANCES
from unghost.export.runtime import CHUNK, OnnxDenoiser, choose_providers, read_manifest


@pytest.fixture(scope="module", params=PRECISIONS)
def denoiser(precisions, request):
    """Every test that takes it is part of the contract of all precisions."""
    return OnnxDenoiser(precisions[request.param], threads=1)


def make_cubes(count, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, (count, 1, 32, 32, 32)).astype(np.float32)


def test_equals_torch(exported, denoiser):
    cubes, times, edges = make_cubes(3), np.array([0, 500, 999]), np.array([0.01, 0.1, 1.0], np.float32)
    with torch.no_grad():
        expected = exported.network(*(torch.from_numpy(value) for value in (cubes, times, edges))).numpy()
    found = denoiser(cubes, times, edges)
    assert found.dtype == np.float32
    assert denoiser.kind == "numpy"
    for name in ("name", "channels", "default_timestep", "removal_threshold", "family"):
        assert getattr(denoiser.manifest, name) == getattr(exported.manifest, name)
    np.testing.assert_allclose(found, expected, rtol=0, atol=TOLERANCES[denoiser.precision].max_error)
    if denoiser.precision == "fp32":
        assert denoiser.manifest == exported.manifest


def test_scalars_broadcast(denoiser):
    cubes = make_cubes(2)
    expected = denoiser(cubes, np.array([500, 500]), np.array([0.1, 0.1], np.float32))
    for timestep, edge in ((500, 0.1), (np.int32(500), np.float64(0.1)), (np.array(500), np.array(0.1))):
        assert np.array_equal(denoiser(cubes, timestep, edge), expected)


def test_empty_batch(denoiser):
    assert denoiser(make_cubes(0), 500, 0.1).shape == (0, 1, 32, 32, 32)
    assert denoiser(make_cubes(0), np.zeros(0, np.int64), np.zeros(0, np.float32)).shape == (0, 1, 32, 32, 32)


@pytest.mark.slow
def test_large_batches_are_cut_into_chunks(denoiser):
    cubes, count = make_cubes(CHUNK + 3), CHUNK + 3
    times = np.arange(count) * 999 // count
    edges = np.linspace(0.01, 1, count).astype(np.float32)
    whole = denoiser(cubes, times, edges)
    for index in (0, CHUNK - 1, CHUNK, count - 1):
        part = slice(index, index + 1)
        np.testing.assert_allclose(denoiser(cubes[part], times[part], edges[part]), whole[part], rtol=0, atol=1e-5)


def test_a_sample_of_a_batch_equals_the_sample_alone(denoiser):
    """Static ranges: what stands beside a cube must not change it, in int8 either."""
    cubes = make_cubes(4)
    together = denoiser(cubes, 500, 0.1)
    for index in range(4):
        np.testing.assert_allclose(denoiser(cubes[index : index + 1], 500, 0.1)[0], together[index], rtol=0, atol=1e-5)


def test_views_are_read_and_inputs_left_alone(denoiser):
    cubes = make_cubes(2)
    turned = cubes.transpose(0, 1, 4, 3, 2)
    kept = cubes.copy()
    found = denoiser(turned, 500, 0.1)
    assert np.array_equal(cubes, kept)
    assert np.array_equal(found, denoiser(np.ascontiguousarray(turned), 500, 0.1))


@pytest.mark.slow
@pytest.mark.parametrize("value", [-1.0, 1.0])
@pytest.mark.parametrize("timestep", [0, 999])
@pytest.mark.parametrize("edge", [1e-30, 1.0, 1e30])
def test_extremes_stay_in_range(denoiser, value, timestep, edge):
    x0_pred = denoiser(np.full((1, 1, 32, 32, 32), value, np.float32), timestep, edge)
    assert np.isfinite(x0_pred).all()
    assert np.abs(x0_pred).max() <= 1.0


@pytest.mark.parametrize(
    ("channels", "timestep", "edge", "kind", "message"),
    [
        (make_cubes(2).astype(np.float64), 5, 0.1, TypeError, "channels must be a float32 numpy array, got float64"),
        (torch.zeros(2, 1, 32, 32, 32), 5, 0.1, TypeError, "float32 numpy array"),
        ([[1.0]], 5, 0.1, TypeError, "float32 numpy array, got list"),
        (make_cubes(2)[:, 0], 5, 0.1, ValueError, r"shape \(N, 1, 32, 32, 32\), got \(2, 32, 32, 32\)"),
        (make_cubes(2)[..., :16], 5, 0.1, ValueError, "channels must have shape"),
        (make_cubes(2) * np.nan, 5, 0.1, ValueError, "channels must be finite, got 65536 others"),
        (make_cubes(2), 5.0, 0.1, TypeError, "timestep must be an integer"),
        (make_cubes(2), 1000, 0.1, ValueError, r"timestep must lie in \[0, 1000\)"),
        (make_cubes(2), -1, 0.1, ValueError, "timestep must lie in"),
        (make_cubes(2), np.array([1, 2, 3]), 0.1, ValueError, r"timestep must have shape \(\) or \(2,\), got \(3,\)"),
        (make_cubes(2), 5, 0.0, ValueError, "edge_fraction must be finite and > 0 in float32, got 0.0"),
        (make_cubes(2), 5, -0.1, ValueError, "edge_fraction must be finite and > 0"),
        (make_cubes(2), 5, math.inf, ValueError, "edge_fraction must be finite and > 0"),
        (make_cubes(2), 5, [0.1, math.nan], ValueError, "edge_fraction must be finite and > 0"),
        (make_cubes(2), 5, [0.1], ValueError, "edge_fraction must have shape"),
        (make_cubes(2), 5, "0.1", TypeError, "edge_fraction must be real"),
    ],
)
def test_bad_arguments(denoiser, channels, timestep, edge, kind, message):
    with pytest.raises(kind, match=message):
        denoiser(channels, timestep, edge)


@pytest.mark.parametrize("precision", PRECISIONS)
def test_bad_files(precision, precisions, tmp_path):
    data, path = precisions[precision].read_bytes(), tmp_path / "bad.onnx"
    with pytest.raises(ValueError, match=r"absent\.onnx: no such file"):
        OnnxDenoiser(tmp_path / "absent.onnx")
    with pytest.raises(ValueError, match="no such file"):
        OnnxDenoiser(tmp_path)
    for length in (0, 10, len(data) // 2, read_manifest(precisions[precision]).body_bytes, len(data) - 5):
        path.write_bytes(data[:length])
        with pytest.raises(ValueError, match=r"bad\.onnx: .*truncated"):
            OnnxDenoiser(path)
    changed = bytearray(data)
    changed[len(data) // 2] ^= 1
    path.write_bytes(changed)
    with pytest.raises(ValueError, match=r"bad\.onnx: the body does not match the SHA-256"):
        OnnxDenoiser(path)
    path.write_bytes(b"PK\x03\x04 something else entirely")
    with pytest.raises(ValueError, match="not an unghost ONNX model"):
        OnnxDenoiser(path)
    model = onnx.load(precisions[precision])
    model.ClearField("metadata_props")
    onnx.save(model, path)
    with pytest.raises(ValueError, match="not an unghost ONNX model"):
        OnnxDenoiser(path)


def test_a_sealed_body_that_is_no_model(tmp_path):
    write_sealed(tmp_path / "no_model.onnx", b"nothing like a model", Manifest(name="x"))
    with pytest.raises(ValueError, match=r"no_model\.onnx: onnxruntime cannot load it"):
        OnnxDenoiser(tmp_path / "no_model.onnx")


def test_threads_and_providers(exported):
    with pytest.raises(ValueError, match="threads must be >= 1 or None, got 0"):
        OnnxDenoiser(exported.onnx, threads=0)
    with pytest.raises(ValueError, match=r"providers \['NoSuchProvider'\] are not available"):
        OnnxDenoiser(exported.onnx, providers=["NoSuchProvider"])
    assert OnnxDenoiser(exported.onnx, providers=["CPUExecutionProvider"]).providers == ["CPUExecutionProvider"]
    cubes = make_cubes(1)
    one, two = (OnnxDenoiser(exported.onnx, threads=count)(cubes, 500, 0.1) for count in (1, 2))
    np.testing.assert_allclose(one, two, rtol=0, atol=1e-6)


def test_an_unknown_precision_is_refused(exported, tmp_path):
    data, manifest = exported.onnx.read_bytes(), exported.manifest
    strange = dataclasses.replace(manifest, training={"export": {"precision": "int3"}})
    write_sealed(tmp_path / "strange.onnx", data[: manifest.body_bytes], strange)
    with pytest.raises(ValueError, match="precision must be one of fp32, fp16, int8, got 'int3'"):
        OnnxDenoiser(tmp_path / "strange.onnx")


CUDA, CPU = "CUDAExecutionProvider", "CPUExecutionProvider"


@pytest.mark.parametrize(
    ("asked", "available", "expected"),
    [
        (None, [CPU], [CPU]),
        (None, ["TensorrtExecutionProvider", CUDA, "AzureExecutionProvider", CPU], [CUDA, CPU]),
        ([CPU], [CUDA, CPU], [CPU]),
        ([CPU, CUDA], [CUDA, CPU], [CPU, CUDA]),
    ],
)
def test_providers_are_chosen(asked, available, expected):
    assert choose_providers(asked, available) == expected


def test_impossible_providers_are_refused():
    for asked, available in (([CUDA], [CPU]), (None, ["AzureExecutionProvider"]), ([], [CPU])):
        with pytest.raises(ValueError, match="are not available, onnxruntime has"):
            choose_providers(asked, available)


def test_cuda_is_asked_for_where_it_is_reported(exported, monkeypatch):
    """The real path up to the session, which is the real one too, less the provider that is not built in here."""
    asked, honest = [], onnxruntime.InferenceSession

    def session(data, options, providers):
        asked.append(list(providers))
        built_in = onnxruntime.capi._pybind_state.get_available_providers()
        return honest(data, options, providers=[name for name in providers if name in built_in])

    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: [CUDA, CPU])
    monkeypatch.setattr(onnxruntime, "InferenceSession", session)
    denoiser = OnnxDenoiser(exported.onnx, threads=1)
    assert asked == [[CUDA, CPU]]
    assert np.isfinite(denoiser(make_cubes(1), 500, 0.1)).all()


@pytest.mark.skipif(CUDA not in onnxruntime.get_available_providers(), reason="onnxruntime without CUDA")
def test_cuda_gives_the_numbers_of_the_cpu(precisions):
    for path in precisions.values():
        fast, plain = OnnxDenoiser(path), OnnxDenoiser(path, providers=[CPU])
        assert fast.providers[0] == CUDA
        np.testing.assert_allclose(fast(make_cubes(4), 500, 0.1), plain(make_cubes(4), 500, 0.1), atol=0.02)


def test_the_number_of_threads_reaches_the_session(exported):
    for threads, expected in ((1, 1), (2, 2), (None, 0)):
        denoiser = OnnxDenoiser(exported.onnx, threads=threads)
        assert denoiser._session.get_session_options().intra_op_num_threads == expected


def test_runs_without_torch_and_onnx(exported):
    code = textwrap.dedent(
        f"""
        import sys
        for name in ("torch", "onnx", "safetensors", "scipy"):
            sys.modules[name] = None
        import numpy as np
        from unghost.export.runtime import OnnxDenoiser
        found = OnnxDenoiser({str(exported.onnx)!r}, threads=1)(np.zeros((1, 1, 32, 32, 32), np.float32), 500, 0.1)
        assert found.shape == (1, 1, 32, 32, 32)
        """
    )
    subprocess.run([sys.executable, "-c", code], check=True)
