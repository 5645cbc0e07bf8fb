"""What every denoiser must do: analytic ones here, and all that are shipped, with every engine."""

from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from unghost.cleaning.pipeline import clean
from unghost.core.channels import CHANNEL_NAMES
from unghost.core.manifest import Manifest
from unghost.denoisers import load_denoiser, shipped_names
from unghost.regularizer.density_regularizer import DensityRegularizer

NAMES = [
    "analytic-numpy",
    "analytic-torch",
    "all_channels-onnx",
    "all_channels-torch",
    *[f"{name}-{kind}" for name in shipped_names() for kind in ("onnx", "torch")],
]


@pytest.fixture(scope="module")
def all_channels(tmp_path_factory):
    """A small network of all channels with fresh weights, by both engines."""
    from unghost.export.onnx.to_onnx import export_onnx
    from unghost.prior.checkpoint import save_model
    from unghost.prior.networks.restoration import NetworkConfig, RestorationNet

    folder = tmp_path_factory.mktemp("all_channels")
    torch.manual_seed(0)
    network = RestorationNet(NetworkConfig(channels=CHANNEL_NAMES, widths=(8, 16, 8), condition_width=8))
    save_model(folder / "m.safetensors", network, Manifest("all channels", channels=CHANNEL_NAMES))
    export_onnx(folder / "m.safetensors", folder / "m.onnx")
    return SimpleNamespace(onnx=load_denoiser(folder / "m.onnx"), torch=load_denoiser(folder / "m.safetensors"))


@cache
def shipped(name, backend):
    return load_denoiser(name, backend=backend)


@pytest.fixture(params=NAMES)
def denoiser(request, kit):
    name, _, kind = request.param.rpartition("-")
    if name == "analytic":
        make = kit.numpy_denoiser if kind == "numpy" else kit.torch_denoiser
        return make(lambda channels: np.clip(channels * 1.5, -1, 1))
    if name == "all_channels":
        return getattr(request.getfixturevalue("all_channels"), kind)
    return shipped(name, kind)


def ask(denoiser, channels, timestep, fraction):
    """Call with arrays whatever the kind; numpy out."""
    if denoiser.kind == "numpy":
        return denoiser(channels, timestep, fraction)
    with torch.no_grad():
        return denoiser(torch.from_numpy(channels), torch.from_numpy(timestep), torch.from_numpy(fraction)).numpy()


def inputs(denoiser, count, value=None):
    rng = np.random.default_rng(0)
    channels = rng.uniform(-1, 1, (count, len(denoiser.manifest.channels), 32, 32, 32)).astype(np.float32)
    if value is not None:
        channels[:] = value
    return channels, np.full(count, 500, np.int64), rng.uniform(0.02, 0.5, count).astype(np.float32)


def test_shape_type_and_inputs_unchanged(denoiser):
    given = inputs(denoiser, 3)
    before = [array.copy() for array in given]
    answer = ask(denoiser, *given)
    assert answer.shape == (3, 1, 32, 32, 32)
    assert answer.dtype == np.float32
    assert np.isfinite(answer).all()
    assert all((now == then).all() for now, then in zip(given, before))
    assert (ask(denoiser, *given) == answer).all()


def test_a_cube_of_a_batch_equals_the_cube_alone(denoiser):
    channels, timestep, fraction = inputs(denoiser, 5)
    timestep = np.array([0, 100, 500, 900, 999], dtype=np.int64)
    whole = ask(denoiser, channels, timestep, fraction)
    for index in (0, 3):
        part = slice(index, index + 1)
        alone = ask(denoiser, channels[part], timestep[part], fraction[part])
        np.testing.assert_allclose(alone, whole[part], atol=2e-4)


@pytest.mark.parametrize("value", [-1.0, 1.0, 0.0])
@pytest.mark.parametrize("timestep", [0, 999])
def test_uniform_cubes_at_extreme_times(denoiser, value, timestep):
    channels, steps, fraction = inputs(denoiser, 1, value=value)
    steps[:] = timestep
    assert np.isfinite(ask(denoiser, channels, steps, fraction)).all()


def test_an_empty_cube_stays_empty(denoiser):
    assert (ask(denoiser, *inputs(denoiser, 2, value=-1.0)) < denoiser.manifest.removal_threshold).mean() > 0.99


def test_scalars_broadcast(denoiser, kit):
    if isinstance(denoiser, kit.numpy_denoiser):
        pytest.skip("the analytic ones are only called with arrays")
    channels, timestep, fraction = inputs(denoiser, 2)
    fraction[:] = 0.1
    whole = ask(denoiser, channels, timestep, fraction)
    if denoiser.kind == "numpy":
        scalar = denoiser(channels, 500, 0.1)
    else:
        with torch.no_grad():
            scalar = denoiser(torch.from_numpy(channels), 500, 0.1).numpy()
    np.testing.assert_allclose(scalar, whole, atol=1e-6)


def test_manifest_round_trip(denoiser):
    assert Manifest.from_json(denoiser.manifest.to_json(), origin="test") == denoiser.manifest


@pytest.mark.slow
def test_it_drives_the_regularizer_and_clean(denoiser, kit, aabb, lone_camera):
    field = kit.field(np.pad(np.full((6, 6, 6), 40.0), 5))
    regularizer = DensityRegularizer(denoiser, aabb=aabb, cameras=lone_camera, field_pitch=0.125, cubes=2)
    loss = regularizer(field)["dsds"]
    assert torch.isfinite(loss)
    loss.backward()
    assert field.values.grad.abs().sum() > 0
    cameras = lone_camera if {"view_count", "transmittance"} & set(denoiser.manifest.channels) else None
    mask = clean(field, aabb, denoiser=denoiser, cameras=cameras, field_pitch=0.125)
    assert mask.cells.shape == (16, 16, 16)
