import os
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from unghost.fields.adapters import nerf_pytorch
from unghost.fields.adapters.nerf_pytorch import load_nerf_pytorch, ndc_from_world

SHARED = Path(__file__).resolve().parents[4] / "shared" / "data" / "nerf_checkpoints"
absent = pytest.mark.skipif(not SHARED.is_dir(), reason="the shared data folder is absent")


def encode(x, count):
    """x, sin x, cos x, sin 2x, cos 2x, ...: appended one after the other."""
    parts = [x]
    for power in range(count):
        parts += [torch.sin(x * 2.0**power), torch.cos(x * 2.0**power)]
    return torch.cat(parts, dim=-1)


class First(nn.Module):
    """krrish94's network as its program runs it: no activation after the first layer."""

    def __init__(self, width=16, layers=4, skip=3, bands=6, bands_dir=4, views=True):
        super().__init__()
        self.dims, self.bands, self.bands_dir, self.views = 3 + 6 * bands, bands, bands_dir, views
        self.layer1 = nn.Linear(self.dims, width)
        self.joined = [0 < i != layers - 1 and i % skip == 0 for i in range(layers - 1)]
        self.layers_xyz = nn.ModuleList([nn.Linear(width + j * self.dims, width) for j in self.joined])
        if views:
            self.layers_dir = nn.ModuleList([nn.Linear(width + 3 + 6 * bands_dir, width // 2)])
            self.fc_alpha, self.fc_feat = nn.Linear(width, 1), nn.Linear(width, width)
            self.fc_rgb = nn.Linear(width // 2, 3)
        else:
            self.fc_out = nn.Linear(width, 4)

    def forward(self, positions, directions):
        xyz = encode(positions, self.bands)
        x = self.layer1(xyz)
        for joined, layer in zip(self.joined, self.layers_xyz):
            x = torch.relu(layer(torch.cat([x, xyz], dim=-1) if joined else x))
        if not self.views:
            return self.fc_out(x)
        y = torch.cat([torch.relu(self.fc_feat(x)), encode(directions, self.bands_dir)], dim=-1)
        return torch.cat([self.fc_rgb(torch.relu(self.layers_dir[0](y))), self.fc_alpha(x)], dim=-1)

    def checkpoint(self):
        return {"iter": 3, "model_coarse_state_dict": None, "model_fine_state_dict": self.state_dict()}


class Second(nn.Module):
    """yenchenlin's: an activation after every layer, the encoding joined in front, after layer number ``skip``."""

    def __init__(self, width=16, layers=4, skip=1, bands=10, bands_dir=4, views=True):
        super().__init__()
        self.dims, self.bands, self.bands_dir, self.skip, self.views = 3 + 6 * bands, bands, bands_dir, skip, views
        self.pts_linears = nn.ModuleList(
            [nn.Linear(self.dims, width)]
            + [nn.Linear(width + (i == skip) * self.dims, width) for i in range(layers - 1)]
        )
        self.views_linears = nn.ModuleList([nn.Linear(width + 3 + 6 * bands_dir, width // 2)])
        if views:
            self.alpha_linear, self.feature_linear = nn.Linear(width, 1), nn.Linear(width, width)
            self.rgb_linear = nn.Linear(width // 2, 3)
        else:
            self.output_linear = nn.Linear(width, 5)

    def forward(self, positions, directions):
        xyz = encode(positions, self.bands)
        x = xyz
        for i, layer in enumerate(self.pts_linears):
            x = torch.relu(layer(x))
            if i == self.skip:
                x = torch.cat([xyz, x], dim=-1)
        if not self.views:
            return self.output_linear(x)
        y = torch.cat([self.feature_linear(x), encode(directions, self.bands_dir)], dim=-1)
        return torch.cat([self.rgb_linear(torch.relu(self.views_linears[0](y))), self.alpha_linear(x)], dim=-1)

    def checkpoint(self):
        return {"global_step": 3, "network_fn_state_dict": self.state_dict(), "network_fine_state_dict": None}


def save(folder, model, *, config="no_ndc: true", seed=0, content=None):
    with torch.no_grad():
        generator = torch.Generator().manual_seed(seed)
        for parameter in model.parameters():  # variances that keep the signal alive through the layers
            width = parameter.shape[1] / 2 if parameter.ndim == 2 else 100
            parameter.copy_(torch.randn(parameter.shape, generator=generator) / width**0.5)
    path = folder / "checkpoint.ckpt"
    torch.save(model.checkpoint() if content is None else content, path)
    if config:
        (folder / "config.yml").write_text(f"dataset:\n  {config}\n  type: blender\n", encoding="utf-8")
    return path


def points(count=200):
    generator = torch.Generator().manual_seed(1)
    directions = torch.randn(count, 3, generator=generator)
    return torch.rand(count, 3, generator=generator) * 3 - 1.5, directions / directions.norm(dim=1, keepdim=True)


@pytest.mark.parametrize(
    ("model", "network"),
    [
        (First(), "fine"),
        (First(width=32, layers=6, skip=2, bands=10), "fine"),
        (First(views=False), "fine"),
        (Second(), "coarse"),
        (Second(skip=9), "coarse"),
        (Second(views=False), "coarse"),
    ],
    ids=["first", "first, joined", "first, no views", "second", "second, not joined", "second, no views"],
)
def test_it_is_the_network(tmp_path, model, network):
    field = load_nerf_pytorch(save(tmp_path, model), network=network)
    positions, directions = points()
    with torch.no_grad():
        expected = model(positions, directions)
        density = field.density_fn(positions)
        torch.testing.assert_close(density[:, 0], torch.relu(expected[:, 3]), rtol=1e-5, atol=1e-5)
        assert 0.0 < float((density > 0).float().mean()) < 1.0
        color = field.color(positions, directions)
        torch.testing.assert_close(color, torch.sigmoid(expected[:, :3]), rtol=1e-5, atol=1e-5)
    assert field(positions.reshape(10, 20, 3)).shape == (10, 20, 1)
    assert field.density_fn(torch.zeros(0, 3)).shape == (0, 1)


def test_chunks_and_gradients(tmp_path, monkeypatch):
    field = load_nerf_pytorch(save(tmp_path, First()))
    positions, directions = points()
    whole, color = field.density_fn(positions), field.color(positions, directions)
    monkeypatch.setattr(nerf_pytorch, "CHUNK", 7)
    torch.testing.assert_close(field.density_fn(positions), whole)
    torch.testing.assert_close(field.color(positions, directions), color)
    assert not whole.requires_grad  # frozen
    positions.requires_grad_()
    field.density_fn(positions).sum().backward()
    assert float(positions.grad.abs().sum()) > 0


def test_what_is_not_finite(tmp_path):
    found = load_nerf_pytorch(save(tmp_path, First())).density_fn(torch.tensor([[np.nan, 0, 0], [0, 0, 0]]))
    assert torch.isnan(found[:, 0]).tolist() == [True, False]


def test_a_position_may_be_left_out_of_the_encoding(tmp_path):
    model = First(bands=6)
    model.layer1 = nn.Linear(36, 16)
    field = load_nerf_pytorch(save(tmp_path, model))
    assert (field.with_position, field.bands.tolist()) == (False, [1, 2, 4, 8, 16, 32])


@pytest.mark.parametrize(
    ("config", "given", "ndc"),
    [
        ("no_ndc: true", None, False),
        ("no_ndc: false", None, True),
        ("no_ndc: True  # really", None, False),
        ("no_ndc: false", False, False),
        ("", True, True),
    ],
)
def test_coordinates(tmp_path, config, given, ndc):
    field = load_nerf_pytorch(save(tmp_path, First(), config=config), ndc=given)
    assert field.ndc is ndc
    assert field.aabb.tolist() == [[-1.0 if ndc else -1.5] * 3, [1.0 if ndc else 1.5] * 3]


def test_the_other_programs_configuration(tmp_path):
    path = save(tmp_path, First(), config="")
    (tmp_path / "config.txt").write_text("expname = fern\nno_ndc = True\n", encoding="utf-8")
    assert load_nerf_pytorch(path).ndc is False


@pytest.mark.parametrize("config", ["", "far: 6", "no_ndc: maybe", "no_ndc_too: true"])
def test_coordinates_that_nobody_names(tmp_path, config):
    with pytest.raises(ValueError, match="pass ndc=True"):
        load_nerf_pytorch(save(tmp_path, First(), config=config))


def test_frequencies_in_even_steps(tmp_path):
    field = load_nerf_pytorch(save(tmp_path, First(bands=3), config="no_ndc: true\n  log_sampling_xyz: false"))
    assert field.bands.tolist() == [1.0, 2.5, 4.0]


def changed(**changes):
    state = First().state_dict()
    for key, value in changes.items():
        name = key.replace("__", ".")
        if value is None:
            del state[name]
        else:
            state[name] = value
    return {"model_fine_state_dict": state}


@pytest.mark.parametrize(
    ("content", "rule"),
    [
        ({}, "holds no model_fine_state_dict or network_fine_state_dict"),
        ([1, 2], "holds no model_fine_state_dict"),
        ({"model_fine_state_dict": {}}, "holds no model_fine_state_dict"),
        ({"model_fine_state_dict": torch.zeros(3)}, "holds no model_fine_state_dict"),
        ({"model_fine_state_dict": {"conv.weight": torch.zeros(3, 3)}}, "neither layer1 nor pts_linears"),
        (changed(layer1__bias=None), "layer layer1 is missing"),
        (changed(layer1__weight=torch.zeros(16, 40)), "40 channels, which is no encoding"),
        (changed(layers_xyz__1__weight=torch.zeros(16, 20)), r"layers_xyz.1 is \(16, 20\)"),
        (changed(layers_xyz__1__weight=torch.zeros(16)), "layers_xyz.1 is missing or has no"),
        (changed(fc_alpha__weight=torch.zeros(2, 16), fc_alpha__bias=torch.zeros(2)), r"fc_alpha is \(2, 16\)"),
        (changed(fc_feat__weight=None), "fc_feat is missing"),
        (changed(layers_dir__0__weight=torch.zeros(8, 18)), "2 channels of a direction"),
        (changed(fc_alpha__weight=None, fc_alpha__bias=None), "fc_out is missing"),
        (changed(layer1__bias=torch.full((16,), np.nan)), "layer1.bias holds values that are not finite"),
        (changed(layer1__bias=torch.zeros(16, dtype=torch.int64)), "not a layer's weight or bias"),
        (changed(extra=torch.zeros(3)), "extra of model_fine_state_dict is not"),
    ],
)
def test_foreign(tmp_path, content, rule):
    path = save(tmp_path, First(), content=content)
    with pytest.raises(ValueError, match=rule) as caught:
        load_nerf_pytorch(path)
    assert str(path) in str(caught.value)


class Trap:
    def __reduce__(self):
        return os.mkdir, ("sprung",)


def test_nothing_in_it_is_executed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = save(tmp_path, First(), content={"model_fine_state_dict": Trap()})
    with pytest.raises(ValueError, match="torch cannot read it"):
        load_nerf_pytorch(path)
    assert not (tmp_path / "sprung").exists()


@pytest.mark.parametrize("keep", [0, 10, 2000, -1])
def test_cut_short(tmp_path, keep):
    path = save(tmp_path, First())
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(ValueError, match="is not a checkpoint of nerf-pytorch: torch cannot read it"):
        load_nerf_pytorch(path)


def test_too_large(tmp_path, monkeypatch):
    path = save(tmp_path, First())
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("checkpoint/data/999", bytes(1 << 22))
    assert path.stat().st_size < 1 << 20
    monkeypatch.setattr(nerf_pytorch, "MOST_BYTES", 1 << 21)
    with pytest.raises(ValueError, match="bytes, more than 2097152"):
        load_nerf_pytorch(path)


def test_arguments(tmp_path):
    with pytest.raises(ValueError, match="network must be one of fine, coarse, got 'medium'"):
        load_nerf_pytorch(save(tmp_path, First()), network="medium")
    with pytest.raises(FileNotFoundError, match="no file"):
        load_nerf_pytorch(tmp_path / "none.ckpt")


def test_ndc_of_the_frustums_corners():
    """The NeRF paper, appendix C: the near plane's corners go to (+-1, +-1, -1), infinity to z = 1."""
    focal, width, height, near = 400.0, 640, 480, 2.0
    x, y = near * width / 2 / focal, near * height / 2 / focal
    found = ndc_from_world([[x, y, -near], [-x, -y, -near]], focal=focal, width=width, height=height, near=near)
    np.testing.assert_allclose(found, [[1, 1, -1], [-1, -1, -1]], atol=1e-12)
    along = np.outer([1.0, 2.0, 4.0, 1e12], [x, y, -near])  # one pixel of the middle camera: x and y stay
    found = ndc_from_world(along, focal=focal, width=width, height=height, near=near)
    np.testing.assert_allclose(found, [[1, 1, -1], [1, 1, 0], [1, 1, 0.5], [1, 1, 1]], atol=1e-9)
    with pytest.raises(ValueError, match="must have z < 0"):
        ndc_from_world([[0.0, 0.0, 0.0]], focal=1.0, width=1, height=1)


@pytest.mark.parametrize(
    ("name", "ndc"),
    [
        ("lego-lowres/checkpoint199999", False),
        ("drums-lowres/checkpoint199999", False),
        ("fern-lowres/checkpoint249999", True),
    ],
)
@absent
@pytest.mark.shared_data
def test_trained_ones(name, ndc):
    """The configuration says 8 layers of 256 (4 of 64); the file has 4 of 128."""
    field = load_nerf_pytorch(SHARED / f"{name}.ckpt")
    assert (field.ndc, field.layer1.out_features, len(field._names)) == (ndc, 128, 3)
    axis = (torch.arange(24) + 0.5) / 24 * 2 - 1
    grid = torch.cartesian_prod(axis, axis, axis) * float(field.aabb[1, 0])
    with torch.no_grad():
        density = field.density_fn(grid)[:, 0]
    occupied = grid[density > 10.0].numpy()
    share = len(occupied) / len(grid)
    if ndc:  # empty up to the leaves, solid behind them
        assert 0.25 < share < 0.5
        assert (grid[density > 10.0][:, 2] > -0.6).all()
    else:  # an object on a plate, nothing around it
        assert 0.005 < share < 0.06
        assert (np.abs(occupied) < 1.35).all()


@absent
@pytest.mark.shared_data
def test_lego_is_a_yellow_bulldozer():
    """What the network sees from four sides is yellow more often than blue, and stands on the plate at z = -0.3."""
    field = load_nerf_pytorch(SHARED / "lego-lowres" / "checkpoint199999.ckpt")
    axis = torch.linspace(-1.2, 1.2, 32)
    grid = torch.cartesian_prod(axis, axis, axis)
    with torch.no_grad():
        solid = grid[field.density_fn(grid)[:, 0] > 20.0]
        color = field.color(solid, -solid / solid.norm(dim=1, keepdim=True))
    assert float((color[:, 0] > color[:, 2]).float().mean()) > 0.8
    assert -0.5 < float(solid[:, 2].min()) < 0.0
