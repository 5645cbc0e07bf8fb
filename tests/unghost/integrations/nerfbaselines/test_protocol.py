"""The adapter without nerfbaselines: what it makes of a prediction and a dataset, which are dictionaries of arrays."""

import re
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from unghost.core.cameras import Cameras
from unghost.evaluation.metrics import pixelwise as metrics
from unghost.evaluation.scoring.engine import score_scene
from unghost.evaluation.scoring.pseudo_truth import make_pseudo_truth
from unghost.evaluation.scoring.views import Renders
from unghost.integrations.nerfbaselines import protocol as nerfbaselines_protocol
from unghost.integrations.nerfbaselines.protocol import MASKS_VARIABLE, PROTOCOLS, Proper, VisibleOnly, WholeImage

SIZE = (14, 20)
NAME = "frames/7.png"


@pytest.fixture(autouse=True)
def no_masks(monkeypatch):
    monkeypatch.delenv(MASKS_VARIABLE, raising=False)


def images(seed=0):
    rng = np.random.default_rng(seed)
    photo = rng.integers(0, 256, (*SIZE, 3), dtype=np.uint8)
    return np.clip(photo + rng.normal(scale=9, size=photo.shape), 0, 255).astype(np.uint8), photo


def dataset(photo, mask=None, root="there/gt-color"):
    return {
        "images": [photo],
        "masks": None if mask is None else [mask],
        "image_paths": [NAME],
        "image_paths_root": str(root),
        "metadata": {"color_space": "srgb"},
    }


def half():
    mask = np.zeros(SIZE, dtype=bool)
    mask[:, :10] = True
    return mask


@pytest.mark.parametrize("kind", [bool, np.uint8, np.float32])
def test_the_datasets_mask_says_what_counts(kind):
    preds, photo = images()
    mask = half() if kind is bool else half().astype(kind) * (255 if kind is np.uint8 else 1)
    found = VisibleOnly().evaluate({"color": preds}, dataset(photo, mask))
    wanted = metrics.psnr(preds / 255, photo / 255, half(), data_range=1.0)
    assert found["psnr"] == pytest.approx(wanted, rel=1e-6)
    assert found["coverage"] == 0.5
    assert set(found) == {"psnr", "ssim", "flip", "coverage", "images_scored"}
    assert all(type(each) is float for each in found.values())
    whole = WholeImage().evaluate({"color": preds / 255}, dataset(photo, mask))
    assert whole["psnr"] == pytest.approx(metrics.psnr(preds / 255, photo / 255, np.ones(SIZE, bool), data_range=1.0))


def test_a_view_without_a_pixel_is_in_no_mean():
    preds, photo = images()
    protocol = VisibleOnly()
    empty = protocol.evaluate({"color": preds}, dataset(photo, np.zeros(SIZE, bool)))
    assert empty == {"coverage": 0.0, "images_scored": 0.0}
    scored = protocol.evaluate({"color": preds}, dataset(photo, half()))
    means = protocol.accumulate_metrics(iter([scored, empty]))
    assert means["psnr"] == scored["psnr"]
    assert means["coverage"] == 0.25
    assert means["images_scored"] == 1
    assert protocol.accumulate_metrics([]) == {"images_scored": 0.0}


def stored(tmp_path, monkeypatch):
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = [2.0, 0.0, 0.3]
    cameras = Cameras.create(poses, np.array([20.0, 20, 10, 7]), SIZE[1], SIZE[0])
    maps = make_pseudo_truth(cameras.select([0]), cameras.select([1, 2]), np.full((1, *SIZE), 2.0), names=["x/7.jpg"])
    maps.save(tmp_path / "masks.npz")
    monkeypatch.setenv(MASKS_VARIABLE, str(tmp_path / "masks.npz"))
    return maps


def test_the_stored_masks_give_every_metric_of_the_proper_convention(tmp_path, monkeypatch):
    maps = stored(tmp_path, monkeypatch)
    preds, photo = images()
    depth = np.full(SIZE, 2.1, dtype=np.float32)
    depth[:4] = np.inf
    found = Proper().evaluate({"color": preds, "depth": depth}, dataset(photo))
    renders = Renders(preds[None].astype(np.float32) / 255, depth[None])
    truth = maps.truth(photo[None].astype(np.float32) / 255, occlusion=False)
    wanted = score_scene(renders, truth, maps.extent, convention="proper").means()
    assert 0 < wanted["coverage"] < 1
    for key in ("psnr", "ssim", "flip", "depth_mse", "disparity_mae", "normal_mean_deg", "coverage", "dice"):
        assert found[key] == wanted[key], key
    assert "lpips" not in found


def test_depth_is_fetched_from_beside_the_colours(tmp_path, monkeypatch):
    stored(tmp_path, monkeypatch)
    preds, photo = images()
    depth = np.full(SIZE, 2.0, dtype="<f2")
    depth[:7] = 0  # nothing, for nerfbaselines
    path = tmp_path / "depth" / "frames" / "7.bin"
    path.parent.mkdir(parents=True)
    path.write_bytes(struct.pack("<ii", *SIZE) + depth.tobytes())
    found = Proper().evaluate({"color": preds}, dataset(photo, root=tmp_path / "gt-color"))
    known = Proper().evaluate({"color": preds, "depth": np.where(depth == 0, np.inf, depth)}, dataset(photo))
    assert found == known
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(ValueError, match=r"7\.bin is no depth map of nerfbaselines, or is truncated"):
        Proper().evaluate({"color": preds}, dataset(photo, root=tmp_path / "gt-color"))
    path.unlink()
    with pytest.raises(ValueError, match=r"'proper' needs renders\.depth"):
        Proper().evaluate({"color": preds}, dataset(photo, root=tmp_path / "gt-color"))


def test_what_it_cannot_score_is_refused(tmp_path, monkeypatch):
    preds, photo = images()
    with pytest.raises(ValueError, match=r"'visible_only' needs truth\.visible"):
        VisibleOnly().evaluate({"color": preds}, dataset(photo))
    with pytest.raises(ValueError, match="evaluate takes one image, got 2"):
        VisibleOnly().evaluate({"color": preds}, {**dataset(photo, half()), "images": [photo, photo]})
    with pytest.raises(ValueError, match="colours must be sRGB, got 'linear'"):
        WholeImage().evaluate({"color": preds}, {**dataset(photo), "metadata": {"color_space": "linear"}})
    with pytest.raises(ValueError, match="photos' shape"):
        WholeImage().evaluate({"color": preds[1:]}, dataset(photo))
    clear = np.dstack([preds, np.full(SIZE, 128, np.uint8)])
    with pytest.raises(ValueError, match="transparent"):
        WholeImage().evaluate({"color": clear}, dataset(photo))
    stored(tmp_path, monkeypatch)
    other = {**dataset(photo), "image_paths": ["frames/8.png"]}
    with pytest.raises(ValueError, match=rf"masks in {MASKS_VARIABLE} do not match the views: 1 of 1"):
        Proper().evaluate({"color": preds, "depth": np.ones(SIZE)}, other)


def test_every_protocol_has_a_name_and_is_registered():
    names = [each().get_name() for each in PROTOCOLS]
    assert names == [
        "unghost-whole-image",
        "unghost-visible-only",
        "unghost-proper",
        "unghost-paper-text",
        "unghost-paper-code",
    ]
    spec = Path(nerfbaselines_protocol.__file__).with_name("spec.py").read_text(encoding="utf-8")
    registered = re.findall(r'"(\w+)"', re.search(r"in \((.*?)\):", spec).group(1))
    assert registered == [each.__name__ for each in PROTOCOLS]
    ids = ["unghost" + re.sub("([A-Z])", lambda m: "-" + m.group(1).lower(), each) for each in registered]
    assert ids == names


def test_nothing_of_nerfbaselines_is_imported():
    program = "import sys; sys.modules['nerfbaselines'] = None; import unghost.integrations.nerfbaselines.protocol"
    subprocess.run([sys.executable, "-c", program], check=True, timeout=60)
