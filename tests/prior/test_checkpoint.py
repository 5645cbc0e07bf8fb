import json
import math

import pytest
import torch
from safetensors.torch import save_file

from unghost.core.manifest import Manifest
from unghost.prior.checkpoint import TorchDenoiser, load_model, read_tensors, save_model, write_tensors
from unghost.prior.networks.restoration import NetworkConfig, RestorationNet

TINY = NetworkConfig(widths=(8, 8, 8), condition_width=8)


@pytest.fixture
def saved(tmp_path):
    torch.manual_seed(0)
    network = RestorationNet(TINY)
    save_model(tmp_path / "model.safetensors", network, Manifest(name="tiny", default_timestep=700))
    return network, tmp_path / "model.safetensors"


def make_inputs(count=2):
    return torch.rand(count, 1, 32, 32, 32, generator=torch.Generator().manual_seed(0)) * 2 - 1


def test_round_trip(saved):
    network, path = saved
    denoiser = load_model(path)
    assert denoiser.kind == "torch"
    assert denoiser.manifest == Manifest(name="tiny", default_timestep=700)
    assert denoiser.network.config == TINY
    assert not denoiser.network.training
    cubes = make_inputs()
    times, edges = torch.tensor([0, 999]), torch.tensor([0.1, 0.2])
    with torch.no_grad():
        assert torch.equal(denoiser(cubes, times, edges), network(cubes, times, edges))


def test_scalars_broadcast_and_no_gradient(saved):
    denoiser, cubes = load_model(saved[1]), make_inputs().requires_grad_()
    both = denoiser(cubes, torch.tensor([500, 500]), torch.tensor([0.1, 0.1]))
    assert torch.equal(denoiser(cubes, 500, 0.1), both)
    assert not both.requires_grad
    assert denoiser(make_inputs(0), 500, 0.1).shape == (0, 1, 32, 32, 32)


@pytest.mark.parametrize(
    ("timestep", "edge", "kind", "message"),
    [
        (1000, 0.1, ValueError, "timestep must lie in"),
        (-1, 0.1, ValueError, "timestep must lie in"),
        (0.5, 0.1, TypeError, "timestep must be an integer"),
        (5, 0.0, ValueError, "edge_fraction must be finite and > 0"),
        (5, math.nan, ValueError, "edge_fraction must be finite and > 0"),
        (torch.tensor([1, 2, 3]), 0.1, ValueError, "timestep must have shape"),
    ],
)
def test_denoiser_refuses(saved, timestep, edge, kind, message):
    with pytest.raises(kind, match=message):
        load_model(saved[1])(make_inputs(), timestep, edge)


def test_denoiser_refuses_nan(saved):
    with pytest.raises(ValueError, match="channels must be finite"):
        load_model(saved[1])(make_inputs() * math.nan, 5, 0.1)


def test_truncated_foreign_and_missing_files_are_refused(saved, tmp_path):
    data = saved[1].read_bytes()
    for length in (0, 4, 100, len(data) // 2, len(data) - 1):
        broken = tmp_path / "broken.safetensors"
        broken.write_bytes(data[:length])
        with pytest.raises(ValueError, match=r"broken\.safetensors is truncated or not a safetensors file"):
            load_model(broken)
    (tmp_path / "text.safetensors").write_text("hello, this is no model")
    with pytest.raises(ValueError, match="not a safetensors"):
        load_model(tmp_path / "text.safetensors")
    with pytest.raises(ValueError, match="does not exist"):
        load_model(tmp_path / "absent.safetensors")
    save_file({"weight": torch.zeros(3)}, tmp_path / "other.safetensors")
    with pytest.raises(ValueError, match="is not an unghost checkpoint"):
        load_model(tmp_path / "other.safetensors")


def test_weights_that_do_not_fit_or_are_not_finite(saved, tmp_path):
    tensors, metadata = read_tensors(saved[1])
    path = tmp_path / "changed.safetensors"
    write_tensors(path, {k: v for k, v in tensors.items() if k != "gain"}, metadata)
    with pytest.raises(ValueError, match="weights do not fit"):
        load_model(path)
    write_tensors(path, tensors | {"gain": torch.tensor(math.inf)}, metadata)
    with pytest.raises(ValueError, match="not finite in \\['gain'\\]"):
        load_model(path)
    write_tensors(path, tensors, metadata | {"unghost_network": json.dumps({"shape": 3})})
    with pytest.raises(ValueError, match="configuration is not readable"):
        load_model(path)


def test_manifest_and_network_must_agree_on_channels(tmp_path):
    manifest = Manifest(name="two", channels=("signed_opacity", "surroundings"))
    with pytest.raises(ValueError, match=r"names the channels .*surroundings.*, the network takes"):
        save_model(tmp_path / "model.safetensors", RestorationNet(TINY), manifest)
    assert not list(tmp_path.iterdir())
    with pytest.raises(ValueError, match="names the channels"):
        TorchDenoiser(RestorationNet(TINY), manifest)


def test_nothing_is_left_behind_and_same_weights_give_same_bytes(saved, tmp_path):
    network, path = saved
    first = path.read_bytes()
    save_model(path, network, Manifest(name="tiny", default_timestep=700))
    assert path.read_bytes() == first
    assert [item.name for item in tmp_path.iterdir()] == ["model.safetensors"]


def test_half_precision_is_half_the_file_and_the_same_model_rounded(tmp_path):
    torch.manual_seed(0)
    network = RestorationNet(TINY)
    manifest = Manifest(name="tiny", default_timestep=700)
    for name, half in (("full", False), ("half", True)):
        save_model(tmp_path / f"{name}.safetensors", network, manifest, half=half)
    sizes = [(tmp_path / f"{name}.safetensors").stat().st_size for name in ("full", "half")]
    assert sizes[1] < 0.75 * sizes[0]  # the header stays
    loaded = load_model(tmp_path / "half.safetensors")
    for key, value in network.state_dict().items():
        found = loaded.network.state_dict()[key]
        assert found.dtype == torch.float32
        torch.testing.assert_close(found, value.half().float(), rtol=0.0, atol=0.0)
    cubes = torch.rand(2, 1, 32, 32, 32) * 2 - 1
    exact = TorchDenoiser(network, manifest)(cubes, 700, 0.1)
    assert 0 < (loaded(cubes, 700, 0.1) - exact).abs().max() < 1e-2
