"""nerfstudio's cameras as ours, without nerfstudio: stand-ins with the attributes that are read."""

import numpy as np
import pytest

pytest.importorskip("torch")

import torch
from unghost_tests import nerfstudio_stubs
from unghost_tests.nerfstudio_stubs import CameraType


@pytest.fixture
def cameras_of(monkeypatch):
    yield nerfstudio_stubs.import_model(monkeypatch)[0].cameras_of
    nerfstudio_stubs.forget_model()


def theirs(kinds, bend):
    sizes = {"width": torch.tensor([32, 64][: len(kinds)]), "height": torch.tensor([24, 48][: len(kinds)])}
    poses = torch.eye(4)[None, :3].repeat(len(kinds), 1, 1)
    return nerfstudio_stubs.theirs(poses, intrinsics=(20, 21, 16, 12), kinds=kinds, bend=bend, **sizes)


def test_fisheyes_stay_fisheyes_and_sizes_become_the_first(cameras_of):
    bend = [[0.05, -0.01, 0.002, 0.0, 0.0, 0.0], [0.1, 0.0, 0.0, 0.0, 1e-3, 0.0]]
    found = cameras_of(theirs([CameraType.FISHEYE, CameraType.PERSPECTIVE], bend))
    assert found.fisheye.tolist() == [True, False]
    assert (found.width, found.height) == (32, 24)
    np.testing.assert_allclose(found.intrinsics, [[20, 21, 16, 12], [10, 10.5, 8, 6]])
    np.testing.assert_allclose(found.distortion, bend, atol=1e-8)


def test_other_kinds_are_refused(cameras_of):
    with pytest.raises(ValueError, match=r"perspective ones or fisheyes, got camera_type \[1, 3\]"):
        cameras_of(theirs([CameraType.PERSPECTIVE, CameraType.EQUIRECTANGULAR], [[0.0] * 6] * 2))
