"""The verb ``sample``: cubes and pictures from a diffusion checkpoint."""

import json

import numpy as np
import pytest
import torch

from unghost import cli
from unghost.cli.sampling import draw_cube, sheet
from unghost.core.manifest import Manifest
from unghost.prior.checkpoint import save_model
from unghost.prior.diffusion.model import DiffusionConfig, DiffusionNet
from unghost.prior.diffusion.sampling import sample_cubes
from unghost.prior.networks.restoration import NetworkConfig, RestorationNet

TINY = NetworkConfig(widths=(8, 8, 8), condition_width=8)


def written_model(folder, objective):
    torch.manual_seed(0)
    path = folder / "model.safetensors"
    if objective == "restoration":
        save_model(path, RestorationNet(TINY), Manifest(name="r"))
    else:
        network = DiffusionNet(DiffusionConfig(objective, TINY))
        save_model(path, network, Manifest(name="tiny", family="diffusion", default_timestep=50))
    return path


@pytest.mark.slow
@pytest.mark.parametrize("objective", ["epsilon", "bernoulli"])
def test_writes_cubes_and_pictures(objective, tmp_path, capsys):
    path, out = written_model(tmp_path, objective), tmp_path / "drawn"
    words = ["sample", str(path), "--out", str(out), "--count", "3", "--steps", "2", "--seed", "5", "--batch-size", "2"]
    assert cli.main(words) == 0
    assert "3 cubes" in capsys.readouterr().out
    assert sorted(item.name for item in out.iterdir()) == [
        "cube-000.png",
        "cube-001.png",
        "cube-002.png",
        "cubes.npz",
        "sheet.png",
    ]
    with np.load(out / "cubes.npz") as stored:
        signed, occupancy, facts = stored["signed"], stored["occupancy"], json.loads(str(stored["facts"]))
    assert signed.shape == occupancy.shape == (3, 32, 32, 32)
    assert (occupancy == (signed > 0)).all()
    assert facts["objective"] == objective
    assert (facts["seed"], facts["steps"], facts["model"]) == (5, 2, "tiny")
    torch.manual_seed(0)
    network = DiffusionNet(DiffusionConfig(objective, TINY)).eval()
    again = sample_cubes(network, count=1, edge_fraction=0.1, seed=5, steps=2)[0, 0].numpy()
    assert (np.abs(signed[0] - again) > 1e-4).mean() < 1e-3
    assert (out / "sheet.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


@pytest.mark.parametrize(
    ("objective", "extra", "message"),
    [
        ("restoration", [], "is of family 'restoration'; only 'diffusion' can be sampled"),
        ("epsilon", ["--count", "0"], "--count and --batch-size must be >= 1, got 0"),
        ("epsilon", ["--steps", "1001"], "steps must lie in [1, 1000], got 1001"),
        ("epsilon", ["--edge-fraction", "-1"], "--edge-fraction must be finite and > 0, got -1.0"),
        ("bernoulli", ["--eta", "0"], "eta must be 1 for objective 'bernoulli', got 0.0"),
    ],
)
def test_what_the_user_can_mend_is_one_line(objective, extra, message, tmp_path, capsys):
    path = written_model(tmp_path, objective)
    assert cli.main(["sample", str(path), "--out", str(tmp_path / "drawn"), "--steps", "2", *extra]) == 2
    text = capsys.readouterr().err.splitlines()[-1]
    assert text.startswith("unghost sample: ")
    assert message in text
    assert not (tmp_path / "drawn").exists()


def test_a_cube_is_drawn_and_an_empty_one_is_a_room():
    occupancy = np.zeros((32, 32, 32), bool)
    room = draw_cube(occupancy)
    occupancy[8:24, 8:24, 8:24] = True
    picture = draw_cube(occupancy)
    assert picture.dtype == np.uint8
    assert picture.shape == room.shape
    assert (picture != room).any(-1).mean() > 0.1


def test_sheet_places_row_by_row():
    pictures = [np.full((10, 10, 3), value, np.uint8) for value in range(8)]
    page = sheet(pictures)
    assert page.shape == (24, 80, 3)  # two rows of six, four pixels between
    assert page[0, 14, 0] == 1
    assert page[14, 0, 0] == 6
    assert page[14, 28, 0] == 255  # nothing there
    assert (page[10:14] == 255).all()
