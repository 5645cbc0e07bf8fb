"""The model's losses, without nerfstudio: stand-ins for its base class, cameras and pipeline."""

import types

import numpy as np
import pytest

pytest.importorskip("torch")

import torch
from unghost_tests import nerfstudio_stubs
from unghost_tests.colmap_models import motion, moved, write_model

from unghost.core.cameras import look_at

NAMES = [f"{number}.png" for number in range(6)]
POINTS = np.random.default_rng(4).normal(0, 0.2, size=(30, 3))


@pytest.fixture
def plug_in(monkeypatch):
    yield nerfstudio_stubs.import_model(monkeypatch)
    nerfstudio_stubs.forget_model()


@pytest.fixture
def capture(tmp_path):
    """A COLMAP model, and nerfstudio's pipeline that trains on all of its photos in another world."""
    pytest.importorskip("pycolmap")
    rng = np.random.default_rng(0)
    eyes = rng.normal(size=(6, 3)) * [1, 1, 0.2] + [0, 0, 2]
    poses = look_at(eyes, rng.normal(0, 0.1, size=(6, 3)))
    write_model(tmp_path / "sparse" / "0", poses, NAMES, POINTS, [range(6)] * len(POINTS))
    similarity = motion(rng, 0.4)
    similarity[:3, 3] = 0
    cameras = nerfstudio_stubs.theirs(
        moved(poses, similarity), intrinsics=(90.0, 90.0, 50.0, 37.5), width=100, height=75
    )
    photos = types.SimpleNamespace(cameras=cameras, image_filenames=[tmp_path / "images" / name for name in NAMES])
    return types.SimpleNamespace(datamanager=types.SimpleNamespace(train_dataset=photos))


def model_of(plug_in, **options):
    module, _ = plug_in
    model = module.UnghostNerfactoModel.__new__(module.UnghostNerfactoModel)
    model.config = module.UnghostNerfactoModelConfig(unghost_start=0, unghost_cubes=0, **options)
    vars(model.config).update(max_res=2048, log2_hashmap_size=19, disable_scene_contraction=False)
    level = torch.full((), 1.0, requires_grad=True)
    field = types.SimpleNamespace(density_fn=lambda places: level * torch.ones_like(places[:, :1]))
    box = types.SimpleNamespace(aabb=torch.tensor([[-1.0] * 3, [1.0] * 3]))
    vars(model).update(field=field, density_fns=[], scene_box=box, device=torch.device("cpu"), training=True)
    return model, level


@pytest.mark.slow
def test_sight_lines_of_the_model_beside_the_photos_are_a_loss(plug_in, capture):
    model, level = model_of(plug_in, unghost_visibility_weight=0.0, unghost_end_point_weight=0.0)
    model.get_training_callbacks(types.SimpleNamespace(pipeline=capture))
    losses = model.get_loss_dict({}, {})
    assert set(losses) == {"rgb_loss", "unghost_dsds", "unghost_visibility", "unghost_sight_lines"}
    losses["unghost_sight_lines"].backward()
    assert 0 < float(losses["unghost_sight_lines"].detach()) <= 0.03
    assert level.grad > 0  # less density, less loss
    assert model.regularizer.pitch == 4 / 256
    (line,) = plug_in[1].lines
    assert line.startswith("unghost: sight lines: 30 points with 180 observations by 6 cameras, of ")
    assert "leak-free" not in line  # all of its photos are trained on


def test_a_weight_of_0_reads_no_points(plug_in, capture):
    model, _ = model_of(plug_in, unghost_sight_line_weight=0.0, unghost_points="/nowhere")
    model.get_training_callbacks(types.SimpleNamespace(pipeline=capture))
    assert model.regularizer.lines is None
    assert plug_in[1].lines == []


def test_no_model_beside_the_photos_is_logged(plug_in, capture):
    photos = capture.datamanager.train_dataset
    photos.image_filenames = [f"/nowhere/a/b/c/images/{name}" for name in NAMES]
    model, _ = model_of(plug_in)
    model.get_training_callbacks(types.SimpleNamespace(pipeline=capture))
    assert model.regularizer.lines is None
    (line,) = plug_in[1].lines
    assert line.startswith("unghost: no sight lines: no COLMAP model with points beside the photos")
