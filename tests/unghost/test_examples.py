"""Every example runs as it stands."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

ROOT = Path(__file__).resolve().parents[2]
CHECKPOINTS = ROOT.parent / "shared" / "data" / "nerf_checkpoints"
WITH_A_PATH = {"nerf_pytorch"}  # examples that need a file of the reader's own
EXAMPLES = [path for path in sorted((ROOT / "examples").glob("*.py")) if path.stem not in WITH_A_PATH]
AT_LEAST = {  # per cent of the ghosts gone, and of the rest kept, as the example prints them
    "instant_ngp": (95, 95),
    "numpy_callable": (95, 95),
    "signed_distance": (95, 95),
    "splats": (80, 98),
}


def run(name, *arguments, folder):
    done = subprocess.run(
        [sys.executable, "-W", "error", ROOT / "examples" / f"{name}.py", *arguments],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=580,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Runs each example once: what it printed, and the folder that it ran in."""
    done = {}

    def once(name):
        if name not in done:
            folder = tmp_path_factory.mktemp(name)
            done[name] = run(name, folder=folder), folder
        return done[name]

    return once


@pytest.mark.slow
@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_runs(path, runs):
    printed, _ = runs(path.stem)
    if path.stem == "two_lines":
        left, kept = (float(share) for share in re.findall(r"([\d.]+)%", printed.splitlines()[-1]))
        assert left < 5
        assert kept > 98
    else:
        gone, kept = (float(share) for share in re.search(r"([\d.]+)% of .* ([\d.]+)% of", printed).groups())
        assert gone >= AT_LEAST[path.stem][0]
        assert kept >= AT_LEAST[path.stem][1]


@pytest.mark.slow
def test_the_cleaned_splats_open_elsewhere(runs):
    from plyfile import PlyData

    _, folder = runs("splats")
    before, after = (PlyData.read(str(folder / f"made_here{end}.ply"))["vertex"].data for end in ("", "_clean"))
    assert after.dtype.names == before.dtype.names
    assert 0.8 * len(before) < len(after) < len(before)


def half_space(folder, *, no_ndc):
    """A checkpoint of nerf-pytorch, its weights written by hand: a floor (z < -0.5), in NDC a wall (z > 0.5)."""
    eye, alpha = torch.eye(6), torch.zeros(1, 6)
    alpha[0, 5 if no_ndc else 4] = 400.0  # of relu(-z) or relu(z)
    layer1 = torch.zeros(6, 3 + 6 * 6)
    for axis in range(3):
        layer1[2 * axis, axis], layer1[2 * axis + 1, axis] = 1.0, -1.0
    state = {
        "layer1.weight": layer1,
        "layer1.bias": torch.zeros(6),
        "layers_xyz.0.weight": eye,
        "layers_xyz.0.bias": torch.zeros(6),
        "fc_alpha.weight": alpha,
        "fc_alpha.bias": torch.tensor([-200.0]),
        "fc_feat.weight": eye,
        "fc_feat.bias": torch.zeros(6),
        "layers_dir.0.weight": torch.full((3, 6 + 27), 0.1),
        "layers_dir.0.bias": torch.zeros(3),
        "fc_rgb.weight": torch.eye(3),
        "fc_rgb.bias": torch.tensor([0.0, 1.0, -1.0]),
    }
    path = folder / "checkpoint.ckpt"
    torch.save({"iter": 0, "model_fine_state_dict": state}, path)
    (folder / "config.yml").write_text(f"dataset:\n  no_ndc: {str(no_ndc).lower()}\n", encoding="utf-8")
    return path


def scores(printed):
    return {
        key: [float(n) for n in re.findall(rf"{key} ([\d.]+)", printed)] for key in ("floater_recall", "surface_kept")
    }


@pytest.mark.slow
@pytest.mark.parametrize("no_ndc", [True, False])
def test_a_nerf_made_by_hand(tmp_path, no_ndc):
    path = half_space(tmp_path, no_ndc=no_ndc)
    printed = run("nerf_pytorch", path, "--resolution", "32", "--width", "48", "--floaters", "4", folder=tmp_path)
    assert ("world" if no_ndc else "device") + " coordinates" in printed
    found = scores(printed)
    assert found["floater_recall"][0] > 0.5
    assert min(found["surface_kept"]) > 0.8
    assert (tmp_path / "nerf_pytorch.png").stat().st_size > 10_000


@pytest.mark.skipif(not CHECKPOINTS.is_dir(), reason="the shared data folder is absent")
@pytest.mark.shared_data
@pytest.mark.slow
def test_a_nerf_that_somebody_trained(tmp_path):
    path = CHECKPOINTS / "lego-lowres" / "checkpoint199999.ckpt"
    found = scores(run("nerf_pytorch", path, "--resolution", "64", "--width", "96", folder=tmp_path))
    assert found["floater_recall"][0] > 0.9
    assert np.mean(found["surface_kept"]) > 0.85
